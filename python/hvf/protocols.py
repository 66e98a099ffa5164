"""What the planners ask of a model, and acting of episodes and agents: any object will do.

What must be there are a few attributes and methods; the protocols below name them.

Letters in shapes: ``B`` problems, ``M`` subgoal samples, ``K`` subgoals, ``L`` latent dimensions,
``D`` candidates per problem, ``H`` time steps, ``A`` action dimensions.

Frames are whatever a model finds convenient: a NumPy array of images, a tensor on a GPU, simulator
states, a class of its own. The planner only counts them, takes some of them by an index array and
hands them back to the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "Agent",
    "Decision",
    "Drawable",
    "Frames",
    "Images",
    "Indices",
    "Judging",
    "Locating",
    "Measuring",
    "Observer",
    "Policy",
    "Preparer",
    "Privileged",
    "Proposals",
    "Proposer",
    "Proposing",
    "Remembering",
    "RolloutSharer",
    "SubgoalModel",
    "SubgoalSource",
    "SubgoalSourceAnew",
    "Trials",
    "TrueSubgoals",
    "WorldModel",
]

Images: TypeAlias = NDArray[np.uint8]
"""Images, uint8 ``[N, H, W, 3]``."""
Indices: TypeAlias = NDArray[np.int64]
"""Numbers of trials, int64 ``[N]``."""


@runtime_checkable
class Frames(Protocol):
    """A batch of frames in a model's own memory.

    NumPy arrays and torch tensors are frames, their first axis being the batch.

    A class of frames may have a static method ``join``, which takes a list of batches and gives
    one, the frames of all of them in order: a search then asks for the segments of its samples, and
    of the searches beside it, in one call. Arrays and tensors of one dtype and shape need none.
    """

    def __len__(self) -> int:
        """Return the number of frames."""
        ...

    def __getitem__(self, index: NDArray[np.int64], /) -> Any:
        """Return the frames at ``index`` (int64 ``[N]``, repeats allowed) in that order."""
        ...


# The frames of a model are both what it takes and what its `observe` gives.
F_contra = TypeVar("F_contra", contravariant=True)
F_co = TypeVar("F_co", covariant=True)
# What a model prepares may be frames of another kind than those it is given.
F_in = TypeVar("F_in", contravariant=True)
F_out = TypeVar("F_out", covariant=True)


@runtime_checkable
class WorldModel(Protocol[F_contra]):
    """Predicts what actions lead to, and says how far that is from a goal.

    Optional beside it:

    * ``max_candidates``, the most candidates ``B * D`` that the model wants in one call (default
      65536). A call holds at least one problem; beyond that its actions never take more than
      256 MiB;
    * ``pads``, true for a model that is compiled for every shape it is called with: problems that
      are done drop out, so ``B`` shrinks from call to call; it is then filled up to a power of two
      (or the most for one call) with copies of the last problem, whose costs are not read;
    * the methods of :class:`RolloutSharer`, :class:`Observer` and :class:`Preparer`;
    * ``uses_seeds``, true for a stochastic model: :meth:`rollout_costs` is then called with one
      more keyword argument, ``seeds``, int64 ``[B, D]`` from 0 to 2**63 - 1, and
      ``shared_rollout_costs`` with ``seeds`` ``[D]``, arrays of the model's own. A model that
      draws the noise of candidate ``d`` of problem ``b`` from ``seeds[b, d]`` and nothing else
      has plans as reproducible as a deterministic one: to the last bit the same alone and in a
      batch, with rollouts shared or not, on any number of threads. In the first iteration,
      problems under one seed have the same candidates and the same ``seeds``.

    * ``native``, one of the worlds of ``hvf_core``: it is then planned with in this object's place,
      without the GIL, and only ``observe`` is still called here. A class that has both ``native``
      and costs of its own (or ``prepare``) says that they agree by defining ``native`` in its
      body, as a property or an attribute; a subclass that overrides the costs and not ``native``
      is refused with a ``TypeError``, and plans with its own costs once it sets ``native = None``.

    Actions lie within the box, unless the planner's ``clip=False``; what a larger action does is
    then the model's to say. A cost that is NaN ranks last: the worlds of ``hvf_core`` give it to a
    candidate whose actions are not finite.
    """

    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 ``[A]``."""
        ...

    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 ``[A]``, above ``action_low`` in every dimension."""
        ...

    def rollout_costs(
        self, starts: F_contra, goals: F_contra, actions: NDArray[np.float32]
    ) -> ArrayLike:
        """Score candidates.

        Args:
            starts: Frames ``[B]`` that the candidates start from.
            goals: Frames ``[B]`` that they should reach.
            actions: Float32 ``[B, D, H, A]``, C-contiguous and writable. The array is the
                model's own: it may be kept, overwritten, or shared with torch without a copy.

        Returns:
            Costs ``[B, D]``, float32 (other numbers are converted), lower is better. A NaN ranks
            last; a problem whose costs are all NaN ends the planning with a ``ValueError``. Any
            array that NumPy can read will do, and any tensor, on a GPU and requiring gradients
            too: it is taken to the host by its own ``detach`` and ``cpu``, or by DLPack.
        """
        ...


@runtime_checkable
class RolloutSharer(Protocol[F_contra]):
    """A world model that rolls one set of candidates out once and scores it for many goals."""

    def shared_rollout_costs(
        self, start: F_contra, goals: F_contra, actions: NDArray[np.float32]
    ) -> ArrayLike:
        """Score the same candidates for every goal.

        Args:
            start: One frame, ``[1]``.
            goals: Frames ``[B]``.
            actions: Float32 ``[D, H, A]``, the model's own.

        Returns:
            Costs ``[B, D]``, equal to what ``rollout_costs`` gives for ``B`` copies of ``start``
            and ``actions``; the planner relies on that for its results not to depend on sharing.
        """
        ...


@runtime_checkable
class Observer(Protocol[F_co]):
    """A world model that makes its frames from images."""

    def observe(self, images: NDArray[np.uint8]) -> F_co:
        """Return the frames for uint8 images ``[N, height, width, 3]``.

        Called for images given to a planner as start or goal, and for those that a generator
        decodes; models without it get the images as they are.
        """
        ...


@runtime_checkable
class Preparer(Protocol[F_in, F_out]):
    """A world model that does once per plan what depends on starts and goals only."""

    def prepare(self, starts: F_in, goals: F_in) -> tuple[F_out, F_out]:
        """Return the frames that stand for ``starts`` and ``goals`` while this plan is made.

        Called once before the first ``rollout_costs`` of each call of ``VisualMPC.plan`` and
        ``plan_batch``, and of each batch of segments in a search: the place to encode goals, or
        the features of starts, which ``rollout_costs`` would do anew in every iteration.

        Args:
            starts: Frames ``[B]``, or ``[1]``, one for all goals.
            goals: Frames ``[B]``.

        Returns:
            A tuple of as many starts and as many goals, frames of whatever kind: the planner
            counts them and takes some of them, as other frames, for ``rollout_costs`` and
            ``shared_rollout_costs``. The frame of goal ``b`` may hold what depends on the pair
            of start and goal ``b``.
        """
        ...


@runtime_checkable
class SubgoalModel(Protocol[F_contra]):
    """Draws images that are possible in a scene, from latents with a standard normal prior."""

    @property
    def latent_dim(self) -> int:
        """Latent dimensions of one image, ``L``."""
        ...

    def decode(self, scene: F_contra, latents: NDArray[np.float32]) -> Any:
        """Draw subgoals.

        Args:
            scene: One frame of the world model, ``[1]``: the start.
            latents: Float32 ``[M, K, L]``, the model's own.

        Returns:
            ``M * K`` frames, sample-major (frame ``m * K + k`` is subgoal ``k`` of sample ``m``):
            frames of the world model, or uint8 images ``[M * K, height, width, 3]``, or the
            frames of another world that have ``images``; the world model observes the latter two.
            An array of three axes is ``M * K`` frames, never one image.
        """
        ...


@runtime_checkable
class Judging(SubgoalModel[F_contra], Protocol):
    """A generator that knows how likely one frame follows another.

    What a search without plans asks (``HVF(segment_cost="likelihood")``).
    """

    def segment_costs(
        self, start: F_contra, goal: F_contra, latents: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Say how unlikely each segment is.

        Args:
            start: One frame of the world model, ``[1]``.
            goal: One frame, ``[1]``.
            latents: Float32 ``[M, K, L]``: what :meth:`decode` would draw subgoals of.

        Returns:
            Float32 ``[M, K + 1]``: from the start to the first subgoal, from each to the next, and
            from the last to the goal. Negative log-likelihoods (nats), or anything that grows with
            the time that a segment takes. NaN ranks last.
        """
        ...


@runtime_checkable
class Proposing(SubgoalModel[F_contra], Protocol):
    """A generator that says where in its latent subgoals on the way to a goal are likely.

    A search begins there in place of the standard normal prior (:class:`hvf_core.HVF`).
    """

    def proposals(
        self, start: F_contra, goal: F_contra, subgoals: int
    ) -> tuple[ArrayLike, ArrayLike] | None:
        """Propose subgoals, once a search.

        Args:
            start: One frame of the world model, ``[1]``.
            goal: One frame, ``[1]``.
            subgoals: how many, ``K``.

        Returns:
            Means and standard deviations (not negative) of a Gaussian over the latents of all,
            float32 ``[K, L]`` each; or None, for the prior.
        """
        ...


@runtime_checkable
class Proposals(Protocol):
    """Trained proposals for a generator that is not known yet."""

    def of(self, generator: Any) -> Proposing[Any]:
        """Return the generator with these proposals.

        Raises:
            ValueError: a generator that they are not for.
        """
        ...


@runtime_checkable
class Proposer(Protocol):
    """Proposes subgoals between two images, without a search."""

    def propose(self, start: Images, goal: Images, count: int) -> Images:
        """Return ``count`` subgoals in the order in which they are passed.

        Args:
            start: uint8 ``[H, W, 3]``.
            goal: uint8 ``[H, W, 3]``.
            count: how many, ``K``.

        Returns:
            uint8 ``[K, H, W, 3]``.
        """
        ...


@runtime_checkable
class Policy(Protocol):
    """Acts towards a goal image without a plan."""

    def act(self, observation: Images, goal: Images) -> NDArray[np.float32]:
        """Return the action, float32 ``[A]``, for two images uint8 ``[H, W, 3]``."""
        ...


@runtime_checkable
class Drawable(Protocol[F_contra]):
    """A world model whose frames are no images, but can be drawn for people."""

    def images(self, frames: F_contra) -> Images:
        """Return images of ``frames[N]``, uint8 ``[N, H, W, 3]``. Used in pictures only."""
        ...


@runtime_checkable
class Measuring(Protocol[F_contra]):
    """A world model with a distance of its own, which says when a subgoal is reached."""

    def distances(self, frames: F_contra, goals: F_contra) -> ArrayLike:
        """Return how far ``frames[N]`` are from ``goals[N]``, ``[N]``: 0 for the same.

        What acting compares with its threshold; without it, mean squared differences of images.
        """
        ...


@runtime_checkable
class Remembering(Protocol[F_co]):
    """A world model with context: it starts from several frames and the actions between them."""

    @property
    def context(self) -> int:
        """Frames that it wants, ``C``."""
        ...

    def observe_history(self, images: NDArray[np.uint8], actions: NDArray[np.float32]) -> F_co:
        """Return frames to start from, ``[N]``.

        Args:
            images: uint8 ``[N, C, H, W, 3]``, the last one being now. Where a trial has not been
                that long, its first image is repeated.
            actions: float32 ``[N, C - 1, A]``, what was done in between; zeros before the start.
        """
        ...


class Trials(Protocol):
    """``B`` episodes of a domain, side by side."""

    @property
    def goals(self) -> Images:
        """Goal images, uint8 ``[B, H, W, 3]``."""
        ...

    def __len__(self) -> int:
        """Return ``B``."""
        ...

    def observe(self, which: Indices) -> Images:
        """Return the images that the trials ``which`` see now, uint8 ``[N, H, W, 3]``."""
        ...

    def step(self, which: Indices, actions: NDArray[np.float32]) -> Mapping[int, str]:
        """Apply ``actions[N, A]`` to the trials ``which``.

        Returns:
            Those of them that cannot go on, with the reason: number of the trial to words.
        """
        ...

    def success(self, which: Indices) -> NDArray[np.bool_]:
        """Return whether the trials ``which`` are where they should be, ``[N]``."""
        ...


@runtime_checkable
class TrueSubgoals(Protocol):
    """Trials of a domain that knows what good subgoals are: an upper bound to compare with."""

    def true_subgoals(self, count: int) -> Images:
        """Return ground-truth subgoals, uint8 ``[B, count, H, W, 3]``."""
        ...


@runtime_checkable
class Privileged(Protocol):
    """Trials that can say more than what is seen; asked by simulators only."""

    def frames(self, which: Indices) -> Frames:
        """Return frames of the true simulator where the trials ``which`` are, ``[N]``."""
        ...


@runtime_checkable
class Locating(Protocol):
    """Trials that know where what acts is in the images: for pictures."""

    def positions(self, which: Indices) -> NDArray[np.float64]:
        """Return where it is now in the images of ``which``, pixels, float64 ``[N, 2]``.

        Column and row; the middle of the upper left pixel is (0, 0).
        """
        ...

    def target(self, trial: int) -> tuple[float, float, float] | None:
        """Return column, row and radius of where a trial should end; None if that is no place."""
        ...


@dataclass(frozen=True)
class Decision:
    """What an agent does.

    Attributes:
        actions: float32 ``[N, A]``.
        costs: predicted cost of the plans that they begin, float32 ``[N]``; None without plans.
    """

    actions: NDArray[np.float32]
    costs: NDArray[np.float32] | None = None


class SubgoalSource(Protocol):
    """Where an agent gets its subgoals from."""

    def __call__(self, trials: Trials, trial: int, seed: int) -> Frames:
        """Return the subgoals of one trial, in order: ``K`` images or frames of the world.

        Args:
            trials: all of them, not yet stepped.
            trial: number of the one.
            seed: of all randomness in the choice.
        """
        ...


@runtime_checkable
class SubgoalSourceAnew(SubgoalSource, Protocol):
    """A source that can be asked again on the way."""

    def anew(
        self, trials: Trials, trial: int, seed: int, count: int, start: Frames | None = None
    ) -> Frames:
        """Return ``count`` subgoals of one trial from where it is now, or fewer.

        Args:
            trials: all of them.
            trial: number of the one.
            seed: of all randomness in the choice.
            count: how many.
            start: where it is now, one frame of a world with context (:class:`Remembering`), made
                of what was seen and done; None for other worlds, and where the trial has just
                begun: what it shows says all.
        """
        ...


class Agent(Protocol):
    """Chooses subgoals at the start of a trial, or on the way, too, and an action at every step.

    What a trial aims at is numbered: its subgoals from 0, and the goal last.
    """

    def begin(self, trials: Trials) -> None:
        """Forget what was; ``trials`` are fresh."""
        ...

    def choose(self, trial: int, seed: int) -> Frames:
        """Choose the subgoals of a trial, in order; return them."""
        ...

    def choose_anew(self, trial: int, seed: int, count: int) -> Frames | None:
        """Choose ``count`` subgoals, or fewer, from where a trial is now; None to leave all be."""
        ...

    def act(
        self, which: Indices, observations: Images, aims: Indices, seeds: Sequence[int]
    ) -> Decision:
        """Decide for the trials ``which``: from ``observations[N]`` towards ``aims[N]``."""
        ...

    def acted(self, which: Indices, actions: NDArray[np.float32]) -> None:
        """Be told of the actions ``[N, A]`` that were taken."""
        ...

    def distances(
        self, which: Indices, observations: Images, aims: Indices, blur: float
    ) -> NDArray[np.floating]:
        """Return how far ``observations[N]`` are from ``aims[N]``, ``[N]``."""
        ...

    def images(self, frames: Frames) -> Images:
        """Return images of subgoals, for pictures."""
        ...
