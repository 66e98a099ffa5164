from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, SupportsIndex, TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Never, Self

__all__ = [
    "HVF",
    "MAZE_ACTION_LIMIT",
    "MAZE_AGENT_HALF",
    "MAZE_ARENA",
    "MAZE_GAP_HALF",
    "MAZE_GAP_LIMIT",
    "MAZE_GAP_RANGE",
    "MAZE_IMAGE_SIZE",
    "MAZE_LAYOUTS",
    "MAZE_REACH",
    "MAZE_SUCCESS_DISTANCE",
    "MAZE_VIEW",
    "MAZE_WALL_X",
    "KeypointFrames",
    "KeypointWorld",
    "LatentFrames",
    "LatentWorld",
    "LayerFrames",
    "LayerWorld",
    "MazeFrames",
    "MazeLayout",
    "MazeSubgoals",
    "MazeWorld",
    "Plan",
    "Plans",
    "SearchResult",
    "VisualMPC",
    "__version__",
    "image_cost",
    "maze_collect",
    "maze_episodes",
    "maze_locate",
    "maze_render",
    "maze_step",
    "maze_subgoals",
    "maze_success",
]

__version__: str

_Index: TypeAlias = SupportsIndex | Sequence[SupportsIndex] | NDArray[np.integer]

# --- maze ---------------------------------------------------------------------------------

MAZE_ACTION_LIMIT: float
MAZE_AGENT_HALF: float
MAZE_ARENA: float
MAZE_GAP_HALF: float
MAZE_GAP_LIMIT: float
MAZE_GAP_RANGE: float
MAZE_IMAGE_SIZE: int
MAZE_LAYOUTS: tuple[str, ...]
MAZE_REACH: float
MAZE_SUCCESS_DISTANCE: float
MAZE_VIEW: float
MAZE_WALL_X: tuple[float, float]

@final
class MazeLayout:
    """A maze of any layout: walls as boxes that may be turned and may have gaps.

    A state of a layout is a row ``(x, y, gap, ..)`` of ``2 + G`` numbers, metres: where the centres
    of the agent and of the gaps (along their walls) are.

    Args:
        name: Its name.
        walls: Float ``[W, 5]``, rows ``(x, y, half_x, half_y, angle)``: centre and half extents,
            metres, turn in degrees, anticlockwise.
        start: Where episodes start, ``(low x, high x, low y, high y)``, metres.
        goal: Where they aim.
        arena: Half-widths of the arena, up to 0.3 m, which is what the camera sees.
        gaps: Float ``[G, 4]``, rows ``(wall, half, low, high)`` in the order of their walls: an
            opening of half-width ``half`` across the wall's second axis, whose centre every episode
            draws from ``[low, high]``, from the wall's centre.

    Raises:
        ValueError: For numbers out of range, a wall outside the arena, a gap that the agent does
            not fit through, a start or goal that walls fill, a goal that cannot be reached.
    """

    def __new__(
        cls,
        name: str,
        walls: ArrayLike,
        start: ArrayLike,
        goal: ArrayLike,
        arena: ArrayLike | None = (0.3, 0.3),
        gaps: ArrayLike | None = (),
    ) -> Self: ...
    @staticmethod
    def preset(name: str) -> MazeLayout: ...
    @property
    def name(self) -> str: ...
    @property
    def arena(self) -> tuple[float, float]: ...
    @property
    def walls(self) -> NDArray[np.float64]: ...
    @property
    def gaps(self) -> NDArray[np.float64]: ...
    @property
    def start(self) -> tuple[float, float, float, float]: ...
    @property
    def goal(self) -> tuple[float, float, float, float]: ...
    @property
    def columns(self) -> int: ...
    def __eq__(self, other: object, /) -> bool: ...
    def __ne__(self, other: object, /) -> bool: ...
    def __hash__(self) -> int: ...
    def __reduce__(self) -> tuple[object, tuple[object, ...]]: ...

def maze_step(
    states: ArrayLike, actions: ArrayLike, layout: MazeLayout | None = None
) -> NDArray[np.float64]: ...
def maze_render(
    states: ArrayLike, size: SupportsIndex | None = 64, layout: MazeLayout | None = None
) -> NDArray[np.uint8]: ...
def maze_locate(
    images: NDArray[np.uint8], layout: MazeLayout | None = None
) -> NDArray[np.float64]: ...
def maze_episodes(
    seed: SupportsIndex,
    first: SupportsIndex,
    count: SupportsIndex,
    difficulty: Literal["easy", "medium", "hard"] | None = None,
    layout: MazeLayout | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...
def maze_subgoals(
    starts: ArrayLike,
    targets: ArrayLike,
    subgoals: SupportsIndex,
    layout: MazeLayout | None = None,
) -> NDArray[np.float64]: ...
def maze_collect(
    seed: SupportsIndex,
    first: SupportsIndex,
    count: SupportsIndex,
    steps: SupportsIndex,
    size: SupportsIndex | None = 64,
    layout: MazeLayout | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float64]]: ...
def maze_success(
    states: ArrayLike, targets: ArrayLike, layout: MazeLayout | None = None
) -> NDArray[np.bool_]: ...

# --- image costs --------------------------------------------------------------------------

def image_cost(
    a: NDArray[np.uint8] | NDArray[np.float32],
    b: NDArray[np.uint8] | NDArray[np.float32],
    mode: Literal["pairs", "all_pairs"] = "pairs",
    blur: float = 0.0,
) -> NDArray[np.float64]: ...

# --- planner ------------------------------------------------------------------------------

@final
class VisualMPC:
    """Visual model-predictive control: the cross-entropy method over actions.

    Draws ``samples`` candidates of ``horizon`` steps, keeps the ``elites`` with the lowest
    predicted cost and refits a diagonal Gaussian to them, until its largest variance falls below
    ``min_variance`` or ``iterations`` are used up (paper, section 3 and algorithm 1). Objects are
    immutable, compare and hash by value, and can be copied and pickled.

    Args:
        horizon: Model steps that a plan looks ahead (``H``).
        samples: Candidates per iteration (``D``).
        elites: Candidates that the distribution is refitted to (``D*``), at most ``samples``.
        iterations: Most iterations.
        min_variance: Variance below which a problem is done, in squared units of an action.
        action_repeat: Model steps that one drawn action is held for; divides ``horizon``.
        initial: First iteration's distribution: ``"uniform"`` over the action box, or
            ``"normal"`` (the paper's has mean 0 and deviation 1).
        initial_low: Lower corner of a part of the action box, ``[A]``, for ``"uniform"``.
        initial_high: Upper corner, ``[A]``. The original maze code drew ``x >= 0`` only, a hint
            that the goal is to the right.
        initial_mean: Mean of ``"normal"``, in units of an action.
        initial_std: Standard deviation of ``"normal"``.
        keep_elites: Best candidates that compete again in the next iteration, with the cost they
            had; at most ``elites``.
        warm_start_std: Standard deviation around a warm start, in units of an action.
        clip: Whether candidates drawn from a Gaussian (a refitted one, ``"normal"``, around a warm
            start) are clipped to the action box. The authors' released code does not: plans may
            then lie beyond the box, and what a model makes of such actions is its own affair
            (``MazeWorld`` clips them, ``KeypointWorld`` and ``LayerWorld`` extrapolate).
        best: Where the answer comes from: ``"all"``, the candidate with the lowest cost of all
            iterations, or ``"last"``, that of the last iteration that was run (kept elites
            included), as in the authors' released code.
        momentum: Share of the old mean, deviations and correlations that a refit keeps, from 0 to
            below 1 (iCEM's alpha).
        samples_decay: By how much each iteration has fewer samples than the one before, at least
            1: ``samples / samples_decay**i``, but no fewer than twice the elites (iCEM's gamma).
        temperature: Elites count by ``exp((best - cost) / temperature)`` in the refit (MPPI's
            lambda, in units of a cost); ``None`` for all alike.
        min_std: Least standard deviation of the refitted distribution, in units of an action. Above
            the root of ``min_variance`` no problem is done early.
        covariance: What the refit keeps of the elites' covariance: ``"diagonal"``, the variances,
            or ``"full"``, the correlations, too, for candidates of at most 256 dimensions.
        shrinkage: How far the correlations of ``"full"`` are shrunk towards none, from 1e-6 to 1;
            1 draws as ``"diagonal"`` does.
        noise_beta: How fast the power of the noise of drawn actions falls with its frequency over
            the time steps of a plan, ``f**-noise_beta``: 0 for white noise, 2 for iCEM's (Pinneri
            et al., 2020). Single actions are distributed as without. For at most 256 actions a
            plan, and ``"diagonal"``.
        shift_elites: Best candidates of its last iteration that a plan keeps; in a next plan with
            this as ``warm_start`` they take the place of as many samples of the first iteration,
            shifted by one step (iCEM). At most ``elites``.

    Raises:
        ValueError: An argument is out of range; the message names it.
        TypeError: An argument has the wrong type.
    """

    def __new__(
        cls,
        *,
        horizon: SupportsIndex = 5,
        samples: SupportsIndex = 200,
        elites: SupportsIndex = 40,
        iterations: SupportsIndex = 5,
        min_variance: float = 1e-3,
        action_repeat: SupportsIndex = 1,
        initial: Literal["uniform", "normal"] = "uniform",
        initial_low: Sequence[float] | NDArray[np.floating] | None = None,
        initial_high: Sequence[float] | NDArray[np.floating] | None = None,
        initial_mean: float = 0.0,
        initial_std: float = 1.0,
        keep_elites: SupportsIndex = 0,
        warm_start_std: float = 1.0,
        clip: bool = True,
        best: Literal["all", "last"] = "all",
        momentum: float = 0.0,
        samples_decay: float = 1.0,
        temperature: float | None = None,
        min_std: float = 0.0,
        covariance: Literal["diagonal", "full"] = "diagonal",
        shrinkage: float = 0.1,
        noise_beta: float = 0.0,
        shift_elites: SupportsIndex = 0,
    ) -> Self: ...
    def __hash__(self) -> int: ...
    def __getnewargs_ex__(self) -> tuple[tuple[()], dict[str, Any]]: ...
    @property
    def horizon(self) -> int: ...
    @property
    def samples(self) -> int: ...
    @property
    def elites(self) -> int: ...
    @property
    def iterations(self) -> int: ...
    @property
    def min_variance(self) -> float: ...
    @property
    def action_repeat(self) -> int: ...
    @property
    def initial(self) -> Literal["uniform", "normal"]: ...
    @property
    def initial_low(self) -> list[float] | None: ...
    @property
    def initial_high(self) -> list[float] | None: ...
    @property
    def initial_mean(self) -> float: ...
    @property
    def initial_std(self) -> float: ...
    @property
    def keep_elites(self) -> int: ...
    @property
    def warm_start_std(self) -> float: ...
    @property
    def clip(self) -> bool: ...
    @property
    def best(self) -> Literal["all", "last"]: ...
    @property
    def momentum(self) -> float: ...
    @property
    def samples_decay(self) -> float: ...
    @property
    def temperature(self) -> float | None: ...
    @property
    def min_std(self) -> float: ...
    @property
    def covariance(self) -> Literal["diagonal", "full"]: ...
    @property
    def shrinkage(self) -> float: ...
    @property
    def noise_beta(self) -> float: ...
    @property
    def shift_elites(self) -> int: ...
    def plan(
        self,
        model: Any,
        start: Any,
        goal: Any,
        seed: SupportsIndex = 0,
        warm_start: Plan | ArrayLike | None = None,
        warm_elites: ArrayLike | None = None,
    ) -> Plan:
        """Find actions that lead from ``start`` to ``goal``.

        Args:
            model: A world of this module, an object whose ``native`` is one, or any object with
                the methods of ``hvf.protocols.WorldModel``. Costs of its own that ``native``
                would hide are refused; see there.
            start: One uint8 image ``[height, width, 3]`` (which goes through the model's
                ``observe``, if it has one) or one frame of the model, ``[1]``.
            goal: The same for the goal.
            seed: From 0 to 2**64 - 1. The same seed gives the same plan to the last bit, with
                any number of threads, alone or in a batch.
            warm_start: The last plan, as it was before its first action was taken: the search
                starts from a Gaussian around the rest of it. A :class:`Plan` or float actions
                ``[H, A]``.
            warm_elites: The best candidates of that plan, as they were before its first action was
                taken, float ``[S, H, A]`` with ``S`` at most ``shift_elites``; ``None`` for those
                that a :class:`Plan` brings.

        Raises:
            ValueError: An argument does not fit, or the model answered with the wrong shape or
                with NaN only; the message names the argument or the model's method.
            TypeError: An argument is of the wrong kind, or the model lacks a method.
            KeyboardInterrupt: Ctrl-C: within a second of native work, else between two calls of
                the model. What a model raises comes back as it is.
            RuntimeError: This process was forked after the module had worked in its parent, whose
                threads it lacks; start processes by 'spawn' or 'forkserver'.
        """

    def plan_batch(
        self,
        model: Any,
        starts: Any,
        goals: Any,
        seeds: SupportsIndex | Sequence[SupportsIndex] | NDArray[np.integer] | None = None,
        warm_start: Plans | ArrayLike | None = None,
        warm_elites: ArrayLike | None = None,
    ) -> Plans:
        """Solve ``B`` problems together: as :meth:`plan` one by one, to the last bit.

        Args:
            model: As for :meth:`plan`.
            starts: Uint8 images ``[B, height, width, 3]`` or frames of the model, ``[B]``, at most
                2**20; or one, ``[1, ...]``, for all goals. Three axes are never one image here.
            goals: Images or frames, ``[B]``.
            seeds: One seed for all, one for each ``[B]``, or ``None`` for 0. Problems with one
                start and one seed share their first iteration's rollouts where the model can.
            warm_start: The last plans: :class:`Plans` or float actions ``[B, H, A]``.
            warm_elites: Their best candidates, float ``[B, S, H, A]``, unless :class:`Plans` bring
                them.

        Raises:
            As :meth:`plan`.
        """

@final
class Plan:
    """The best actions found for one problem."""

    def __new__(cls, never: Never, /) -> Self: ...  # planners make these
    @property
    def actions(self) -> NDArray[np.float32]:
        """Actions, float32 ``[H, A]``."""

    @property
    def cost(self) -> float:
        """Predicted cost of these actions: the lowest of the iterations that ``best`` says."""

    @property
    def elites(self) -> NDArray[np.float32]:
        """Best candidates of the last iteration, best first, float32 ``[shift_elites, H, A]``."""

    @property
    def iterations(self) -> int:
        """Iterations that were run (``I``)."""

    @property
    def history(self) -> dict[str, NDArray[np.float32]]:
        """Costs of every iteration, float32 ``[I]`` each.

        ``best``, ``elite_mean`` and ``elite_worst`` of the elites, ``population_mean`` of all
        finite costs, and ``max_std``, the largest deviation of the refitted Gaussian.
        """

@final
class Plans:
    """The best actions found for every problem of a batch; ``plans[b]`` is a :class:`Plan`."""

    def __new__(cls, never: Never, /) -> Self: ...  # planners make these
    @property
    def actions(self) -> NDArray[np.float32]:
        """Actions, float32 ``[B, H, A]``."""

    @property
    def costs(self) -> NDArray[np.float32]:
        """Predicted costs, float32 ``[B]``."""

    @property
    def elites(self) -> NDArray[np.float32]:
        """As :attr:`Plan.elites`, float32 ``[B, shift_elites, H, A]``."""

    @property
    def iterations(self) -> NDArray[np.int64]:
        """Iterations that each problem ran, int64 ``[B]``."""

    @property
    def history(self) -> dict[str, NDArray[np.float32]]:
        """As :attr:`Plan.history`, float32 ``[B, I]`` each; NaN after a problem was done."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: SupportsIndex, /) -> Plan: ...
    def __iter__(self) -> Iterator[Plan]: ...

@final
class HVF:
    """Hierarchical visual foresight: the search for subgoal images.

    The cross-entropy method over the latents of ``subgoals`` images, from a standard normal. A
    sample costs what the hardest of its ``subgoals + 1`` segments costs to plan with ``mpc``
    (paper, section 4 and algorithm 2). Objects are immutable, compare and hash by value, and can
    be copied and pickled.

    Args:
        mpc: How a segment is planned; ``None`` for ``VisualMPC()``.
        subgoals: Number of subgoals (``K``); 0 plans to the goal directly.
        samples: Samples per iteration (``M``).
        elites: Samples that the distribution is refitted to (``M*``), at most ``samples``.
        iterations: Most iterations.
        min_variance: Variance below which the search is done, in squared units of a latent.
        reduction: Cost of a sample from those of its segments: ``"max"`` or ``"mean"``.
        keep_elites: Best samples that compete again in the next iteration, with the cost they had.
        prune: Plan the segment of a sample first that a few candidates take for its hardest, drop
            samples whose worst segment exceeds the ``elites``-th best complete sample, and plan
            other segments only until they are known to be no harder. Changes nothing but the time,
            and what ``population_mean`` is over. Only with ``"max"``.
        share_rollouts: Share the first iteration's rollouts of all first segments where the model
            can (``shared_rollout_costs``). Changes nothing but the time.
        chunk: Samples that pruning completes at a time, before it looks what is still worth
            completing; ``None`` for as many as ``elites``. Larger ones make fewer, fuller calls.
            Changes nothing but the time.
        best: Where the answer comes from: ``"all"``, the sample with the lowest cost of all
            iterations, or ``"last"``, that of the last iteration that was run (kept elites
            included), as in the authors' released code. Subgoals, latents, cost and plans are of
            that one sample. How segments are planned is for the ``best`` of ``mpc`` to say.
        segment_cost: Who says what a segment costs: ``"planned"``, the planner, by the predicted
            cost of its best plan (the paper's), or ``"likelihood"``, the generator, by its
            ``segment_costs`` and without a plan.
        momentum: Share of the old mean, deviations and correlations that a refit keeps, from 0 to
            below 1 (iCEM's alpha).
        samples_decay: By how much each iteration has fewer samples than the one before, at least
            1: ``samples / samples_decay**i``, but no fewer than twice the elites (iCEM's gamma).
        temperature: Elites count by ``exp((best - cost) / temperature)`` in the refit (MPPI's
            lambda, in units of a cost); ``None`` for all alike.
        min_std: Least standard deviation of the refitted distribution, in units of a latent. Above
            the root of ``min_variance`` no problem is done early.
        covariance: What the refit keeps of the elites' covariance: ``"diagonal"``, the variances,
            or ``"full"``, the correlations, too, for candidates of at most 256 dimensions.
        shrinkage: How far the correlations of ``"full"`` are shrunk towards none, from 1e-6 to 1;
            1 draws as ``"diagonal"`` does.

    Raises:
        ValueError: An argument is out of range; the message names it.
        TypeError: An argument has the wrong type.
    """

    def __new__(
        cls,
        *,
        mpc: VisualMPC | None = None,
        subgoals: SupportsIndex = 2,
        samples: SupportsIndex = 200,
        elites: SupportsIndex = 40,
        iterations: SupportsIndex = 5,
        min_variance: float = 1e-3,
        reduction: Literal["max", "mean"] = "max",
        keep_elites: SupportsIndex = 0,
        prune: bool = True,
        share_rollouts: bool = True,
        chunk: SupportsIndex | None = None,
        best: Literal["all", "last"] = "all",
        segment_cost: Literal["planned", "likelihood"] = "planned",
        momentum: float = 0.0,
        samples_decay: float = 1.0,
        temperature: float | None = None,
        min_std: float = 0.0,
        covariance: Literal["diagonal", "full"] = "diagonal",
        shrinkage: float = 0.1,
    ) -> Self: ...
    def __hash__(self) -> int: ...
    def __getnewargs_ex__(self) -> tuple[tuple[()], dict[str, Any]]: ...
    @property
    def mpc(self) -> Self: ...
    @property
    def subgoals(self) -> int: ...
    @property
    def samples(self) -> int: ...
    @property
    def elites(self) -> int: ...
    @property
    def iterations(self) -> int: ...
    @property
    def min_variance(self) -> float: ...
    @property
    def reduction(self) -> Literal["max", "mean"]: ...
    @property
    def keep_elites(self) -> int: ...
    @property
    def prune(self) -> bool: ...
    @property
    def share_rollouts(self) -> bool: ...
    @property
    def chunk(self) -> int | None: ...
    @property
    def best(self) -> Literal["all", "last"]: ...
    @property
    def segment_cost(self) -> Literal["planned", "likelihood"]: ...
    @property
    def momentum(self) -> float: ...
    @property
    def samples_decay(self) -> float: ...
    @property
    def temperature(self) -> float | None: ...
    @property
    def min_std(self) -> float: ...
    @property
    def covariance(self) -> Literal["diagonal", "full"]: ...
    @property
    def shrinkage(self) -> float: ...
    def search(
        self,
        model: Any,
        generator: Any,
        start: Any,
        goal: Any,
        seed: SupportsIndex = 0,
        progress: Callable[[int, int, float], object] | None = None,
    ) -> SearchResult:
        """Search for subgoals between ``start`` and ``goal``.

        Args:
            model: The world, as for :meth:`VisualMPC.plan`.
            generator: An object with the methods of ``hvf.protocols.SubgoalModel``; may be
                ``None`` for ``subgoals=0``.
            start: One uint8 image ``[height, width, 3]`` or one frame of the model, ``[1]``.
            goal: The same for the goal.
            seed: From 0 to 2**64 - 1. The same seed gives the same result to the last bit, with
                any number of threads, and with ``prune`` and ``share_rollouts`` on or off.
            progress: Called as ``progress(iteration, iterations, cost)`` after every iteration, the
                first being 1, of at most ``iterations``, with the lowest cost so far (of the last
                iteration for ``best="last"``). What it raises ends the search.

        Raises:
            As :meth:`VisualMPC.plan`. An exception that ends a search after its first iteration
            (KeyboardInterrupt by Ctrl-C, or any of ``progress`` or a model) has an attribute
            ``partial``: the :class:`SearchResult` that the search would have given after its last
            finished iteration (by ``"likelihood"``, without plans).
        """

    def search_batch(
        self,
        model: Any,
        generator: Any,
        starts: Any,
        goals: Any,
        seeds: SupportsIndex | Sequence[SupportsIndex] | NDArray[np.integer] | None = None,
    ) -> list[SearchResult]:
        """Search for ``B`` pairs of start and goal: each result is what :meth:`search` finds alone.

        The searches go on side by side: a model whose frames can be joined
        (``hvf.protocols.Frames``) plans the segments of all of them in the same calls.

        Args:
            model: As for :meth:`search`.
            generator: As for :meth:`search`.
            starts: Uint8 images ``[B, height, width, 3]`` or frames of the model, ``[B]``; or one,
                ``[1, ...]``, for all goals.
            goals: Images or frames, ``[B]``.
            seeds: One seed for all, one for each ``[B]``, or ``None`` for 0.

        Raises:
            As :meth:`search`.
        """

@final
class SearchResult:
    """What the subgoal search found."""

    def __new__(cls, never: Never, /) -> Self: ...  # planners make these
    @property
    def subgoals(self) -> Any:
        """Subgoals in the order to reach them: frames of the model, ``[K]``."""

    @property
    def latents(self) -> NDArray[np.float32]:
        """Their latents, float32 ``[K, L]``."""

    @property
    def cost(self) -> float:
        """Cost of the sample: the maximum (or mean) of ``segment_costs``."""

    @property
    def segment_costs(self) -> NDArray[np.float32]:
        """Planning cost of every segment, float32 ``[K + 1]``."""

    @property
    def plans(self) -> Plans:
        """Best plan of every segment, ``K + 1``."""

    @property
    def iterations(self) -> int:
        """Iterations that were run (``I``); 0 without subgoals."""

    @property
    def history(self) -> dict[str, NDArray[np.float32] | NDArray[np.int64]]:
        """Figures of every iteration, ``[I]`` each.

        Those of :attr:`Plan.history` over the samples (``population_mean``: the completed ones)
        and the planning problems ``evaluated`` (to their end, or until it was clear that they are
        not their sample's hardest) and ``skipped``, int64.
        """

# --- the maze as a world model --------------------------------------------------------------

@final
class MazeFrames:
    def __new__(
        cls,
        states: ArrayLike,
        image_size: SupportsIndex = 64,
        layout: MazeLayout | None = None,
    ) -> Self: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: _Index, /) -> MazeFrames: ...
    @property
    def states(self) -> NDArray[np.float64]: ...
    @property
    def images(self) -> NDArray[np.uint8]: ...
    @property
    def image_size(self) -> int: ...

@final
class MazeWorld:
    """The maze's true simulator as a world model.

    Actions beyond the box ``[-3, 3]`` count as the nearest within, as in the environment; a
    candidate whose actions are not finite costs NaN.
    """

    def __new__(
        cls,
        image_size: SupportsIndex = 64,
        blur: float = 0.0,
        over_horizon: Literal["last", "sum", "min"] = "last",
        layout: MazeLayout | None = None,
    ) -> Self: ...
    @property
    def action_low(self) -> NDArray[np.float32]: ...
    @property
    def action_high(self) -> NDArray[np.float32]: ...
    @property
    def image_size(self) -> int: ...
    @property
    def blur(self) -> float: ...
    @property
    def over_horizon(self) -> Literal["last", "sum", "min"]: ...
    def observe(self, images: NDArray[np.uint8]) -> MazeFrames: ...
    def rollout_costs(
        self,
        starts: MazeFrames | NDArray[np.uint8],
        goals: MazeFrames | NDArray[np.uint8],
        actions: ArrayLike,
    ) -> NDArray[np.float32]: ...
    def shared_rollout_costs(
        self,
        start: MazeFrames | NDArray[np.uint8],
        goals: MazeFrames | NDArray[np.uint8],
        actions: ArrayLike,
    ) -> NDArray[np.float32]: ...
    def rollout(
        self, start: MazeFrames | NDArray[np.uint8], actions: ArrayLike
    ) -> NDArray[np.float64]: ...

@final
class MazeSubgoals:
    def __new__(cls, latent_dim: SupportsIndex = 8, layout: MazeLayout | None = None) -> Self: ...
    @property
    def latent_dim(self) -> int: ...
    def decode(self, scene: object, latents: ArrayLike) -> MazeFrames: ...

# --- the compact learned dynamics model -----------------------------------------------------

@final
class KeypointFrames:
    """Frames of a `KeypointWorld`: images, where the moving part is, and a map of the rest.

    Made by `KeypointWorld.frames`. What the model sees in a scene is computed once, when first
    needed; frames picked with `[]` and frames from `moved` share it.
    """

    def __new__(cls, never: Never, /) -> Self: ...  # worlds make these
    def __len__(self) -> int: ...
    def __getitem__(self, index: _Index, /) -> KeypointFrames: ...
    @property
    def images(self) -> NDArray[np.uint8]:
        """The images, uint8 `[N, S, S, 3]` (a copy)."""
    @property
    def keypoints(self) -> NDArray[np.float32]:
        """The keypoints, float32 `[N, 2]`, (row, column) in pixels (a copy)."""
    @property
    def maps(self) -> NDArray[np.float32]:
        """The scene maps, float32 `[N, S, S]` (a copy)."""
    def moved(self, images: NDArray[np.uint8], keypoints: NDArray[np.float32]) -> KeypointFrames:
        """Frames of the same scene in which the moving part is elsewhere.

        Args:
            images: uint8 `[N, S, S, 3]`.
            keypoints: float32 `[N, 2]`, (row, column) in pixels.

        Raises:
            ValueError: not exactly one frame here, shapes that do not fit each other, or keypoints
                that are not finite.
        """

@final
class KeypointWorld:
    """The compact learned dynamics model, evaluated in Rust; a world model.

    `hvf.worlds.learned.LearnedWorld` makes one from a trained `hvf.models.KeypointDynamics`.
    The cost is the squared pixel distance of the predicted frame to the goal, per pixel, in closed
    form. A candidate costs about `H * substeps * hidden**2` multiply-adds. Actions beyond the box
    are taken as they are: the model, which was trained within it, extrapolates.

    Args:
        patch: weights of the first layer for what is around the keypoint, float32
            `[hidden, taps**2]`.
        patch_bias: float32 `[hidden]`.
        context: weights of the first layer for action and memory, float32 `[hidden, A + C]`.
        middle: float32 `[hidden, hidden]`.
        middle_bias: float32 `[hidden]`.
        output: motion in pixels, then change of the memory, float32 `[2 + C, hidden]`.
        output_bias: float32 `[2 + C]`.
        free: motion per substep that is linear in the action, float32 `[2, A]`.
        action_scale: number by which actions are divided.
        spacing: pixels between the taps of a patch.
        substeps: substeps of an action.
        half_size: half the sprite's size along rows and columns, in pixels.
        edge: width of its soft edge along rows and columns, in pixels.
        colour: its colour relative to the background, in units of full intensity.
        action_low: lowest action, `[A]`.
        action_high: highest action, `[A]`.
        image_size: height and width of the images, `S`.
        blur: standard deviation of the Gaussian blur before frames are compared, in pixels.
        over_horizon: `"last"`, `"sum"` or `"min"` over the predicted frames.

    Raises:
        ValueError: shapes that do not fit each other, or numbers out of range, of any size.
        TypeError: arrays of another dtype, or objects of another kind.
    """

    def __new__(
        cls,
        *,
        patch: NDArray[np.float32],
        patch_bias: NDArray[np.float32],
        context: NDArray[np.float32],
        middle: NDArray[np.float32],
        middle_bias: NDArray[np.float32],
        output: NDArray[np.float32],
        output_bias: NDArray[np.float32],
        free: NDArray[np.float32],
        action_scale: float,
        spacing: SupportsIndex,
        substeps: SupportsIndex,
        half_size: Sequence[float],
        edge: Sequence[float],
        colour: Sequence[float],
        action_low: Sequence[float],
        action_high: Sequence[float],
        image_size: SupportsIndex,
        blur: float = 0.0,
        over_horizon: Literal["last", "sum", "min"] = "last",
    ) -> Self: ...
    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 `[A]`."""
    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 `[A]`."""
    def frames(
        self,
        images: NDArray[np.uint8],
        keypoints: NDArray[np.float32],
        maps: NDArray[np.float32],
    ) -> KeypointFrames:
        """Frames of this world.

        Args:
            images: uint8 `[N, S, S, 3]`.
            keypoints: float32 `[N, 2]`, (row, column) in pixels.
            maps: what does not move, as the model was trained to see it, float32 `[N, S, S]`.

        Raises:
            ValueError: shapes that do not fit each other or the world, or numbers that are not
                finite.
        """
    def rollout_costs(
        self, starts: KeypointFrames, goals: KeypointFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [B, D, H, A]`."""
    def rollout(self, starts: KeypointFrames, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Predicted keypoints float32 `[B, D, H, 2]`, in pixels, of `actions [B, D, H, A]`."""

# --- latents of any model -------------------------------------------------------------------

@final
class LatentFrames:
    """Frames of a `LatentWorld`: latents, and what is known of the frames besides. Immutable.

    Frames are of no world: any with latents of this length takes them. As starts, only their
    latents count; as goals, their targets (where there are none, what the world reads out of their
    latents) and constants. Frames picked with `[]` share memory.

    Args:
        latents: float32 `[N, Z]`.
        targets: what the read-out of a predicted latent is compared with where a frame is the goal,
            float32 `[N, P]`; None for the read-out of the frame's own latent.
        constants: what every predicted frame that counts costs more where a frame is the goal,
            float32 `[N]`; None for nothing. A read-out of the main part of an image makes its whole
            pixel cost so: the rest of the goal image, which no read-out can reach, is a constant.
        images: what the frames look like, uint8 `[N, H, W, 3]`: kept for others.

    Raises:
        ValueError: another dtype or shape, not as many of one as of the other, or numbers that are
            not finite.
        TypeError: what is no array.
    """

    def __new__(
        cls,
        latents: NDArray[np.float32],
        targets: NDArray[np.float32] | None = None,
        constants: NDArray[np.float32] | None = None,
        images: NDArray[np.uint8] | None = None,
    ) -> Self: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: _Index, /) -> LatentFrames:
        """The frames at `index`: an integer (one frame, still a batch) or an integer array.

        Raises:
            IndexError: an index beyond the frames.
            TypeError: another kind of index.
        """
    @property
    def latents(self) -> NDArray[np.float32]:
        """The latents, float32 `[N, Z]` (a copy)."""
    @property
    def targets(self) -> NDArray[np.float32] | None:
        """What read-outs are compared with, float32 `[N, P]` (a copy), or None."""
    @property
    def constants(self) -> NDArray[np.float32]:
        """What predicted frames cost more, float32 `[N]` (a copy)."""
    @property
    def images(self) -> NDArray[np.uint8]:
        """The images, uint8 `[N, H, W, 3]` (a copy).

        Raises:
            AttributeError: no images were given.
        """

@final
class LatentWorld:
    """A world whose frames are latents, moved by a network that is given by its weights.

    For models whose state is a vector, trained with torch or anything else: rollouts and costs run
    in Rust on all cores, without torch and without the GIL. To plan from images, give the planner
    an object with this world as its `native` and a method `observe(images) -> LatentFrames`.

    *Dynamics.* An action `[A]` is scaled so that its box is from -1 to 1 (one beyond the box is
    taken as it is): `u`. Then `z' = z + scale * network([z, u])`, or `z' = GRUCell(u, z)`.

    *Networks* are dicts of weights as `torch.nn.Linear` stores them, `(weight [outputs, inputs],
    bias [outputs])`, all float32::

        {"input": (weight, bias),
         "blocks": [((weight, bias), (weight, bias)), ...],   # may be left out
         "output": (weight, bias),
         "activation": "relu" or "sin"}                       # may be left out: "relu"

    that is `h = activation(input(x))`, `h = relu(h + second(relu(first(h))))` for every block,
    `output(h)`.

    *Cost.* `sum(weights * (read(z) - target)**2) + constant` of every predicted latent that counts;
    target and constant are the goal's (`LatentFrames`). Without a read-out, `read(z) = z`.

    The same costs to the last bit alone and in a batch, with rollouts shared or not, on any number
    of threads, on any machine; those of torch within float32's rounding. An action that is not a
    number costs NaN.

    Args:
        action_low: lowest action, `[A]`.
        action_high: highest action, `[A]`.
        dynamics: a network's dict, from `Z + A` numbers (the latent first) to `Z`, with one more
            entry, `"scale"`: a number or float32 `[Z]`, 1 if left out; or the weights of a
            `torch.nn.GRUCell(A, Z)` under their names there (`weight_ih [3 Z, A]`,
            `weight_hh [3 Z, Z]`, `bias_ih`, `bias_hh [3 Z]`): `cell.state_dict()`, as arrays.
        readout: what is compared of a latent: None for the latent itself (`P = Z`), a network's
            dict from `Z` numbers to `P`, or a float32 matrix `[P, Z]`. A matrix costs no more than
            `Z` rows would, however many it has, but is compared with goals' latents only, not with
            targets.
        weights: of the numbers of the read-out, float32 `[P]`, none negative; None for 1.
        over_horizon: `"last"`, `"sum"` or `"min"` over the predicted latents.
        hold: steps of actions that one step of the dynamics is long. The first of each `hold`
            actions is taken; the planners' `action_repeat` should be a multiple of it.

    Raises:
        ValueError: shapes that do not fit each other, another dtype, numbers out of range or not
            finite, entries that are missing or unknown; the message names the argument.
        TypeError: an argument of another type.
    """

    def __new__(
        cls,
        action_low: Sequence[float] | NDArray[np.floating],
        action_high: Sequence[float] | NDArray[np.floating],
        dynamics: Mapping[str, Any],
        *,
        readout: NDArray[np.float32] | Mapping[str, Any] | None = None,
        weights: NDArray[np.float32] | None = None,
        over_horizon: Literal["last", "sum", "min"] = "last",
        hold: SupportsIndex = 1,
    ) -> Self: ...
    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 `[A]`."""
    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 `[A]`."""
    @property
    def latent_dim(self) -> int:
        """Length of a latent, `Z`."""
    @property
    def over_horizon(self) -> str:
        """Which predicted latents count."""
    @property
    def hold(self) -> int:
        """Steps of actions that one step of the dynamics is long."""
    @property
    def max_candidates(self) -> int:
        """The most candidates that the planners ask for in one call: fewer for dearer networks."""
    def rollout_costs(
        self, starts: LatentFrames, goals: LatentFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [B, D, H, A]`.

        Raises:
            ValueError: frames or actions that do not fit the world or each other, or a horizon that
                is no multiple of `hold`.
        """
    def shared_rollout_costs(
        self, start: LatentFrames, goals: LatentFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [D, H, A]` from one start for every goal.

        Those of `rollout_costs`, to the last bit.

        Raises:
            ValueError: as `rollout_costs`.
        """
    def rollout(self, starts: LatentFrames, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Predicted latents float32 `[B, D, H / hold, Z]` of `actions [B, D, H, A]`.

        Raises:
            ValueError: as `rollout_costs`, or more than 2**28 numbers.
        """

# --- the desk's learned dynamics model ------------------------------------------------------

_Layer: TypeAlias = tuple[NDArray[np.float32], NDArray[np.float32]]

@final
class LayerFrames:
    """Frames of a `LayerWorld`: images, the same without the arm, where parts are, and states.

    Made by `LayerWorld.frames`. Frames picked with `[]` share memory.
    """

    def __new__(cls, never: Never, /) -> Self: ...  # worlds make these
    def __len__(self) -> int: ...
    def __getitem__(self, index: _Index, /) -> LayerFrames: ...
    @property
    def images(self) -> NDArray[np.uint8]:
        """The images, uint8 `[N, S, S, 3]` (a copy)."""
    @property
    def states(self) -> NDArray[np.float32]:
        """The states, float32 `[N, X]` (a copy)."""

@final
class LayerWorld:
    """The desk's learned dynamics model, evaluated in Rust; a world model with actions in [-1, 1].

    `hvf.worlds.layers.LayerWorld` makes one from a trained
    `hvf.models.layers.dynamics.LayerDynamics`. The cost is the squared pixel distance of the
    predicted frame to the goal, per pixel. Costs agree with those of torch to 1e-3 of their value,
    rollouts of 15 steps to 1e-2 pixels. Actions beyond the box are taken as they are: the model,
    which was trained within it, extrapolates.

    Letters in shapes: `A` = 3 action dimensions, `G` = 2 sliders, `R` parts that roam, `C` length
    of their memory, `T` size of a tile, `W` size of a sprite, `S` image size, `X` = A + G + 3R
    length of a state (hand; sliders; row, column and presence of each part).
    Networks are lists of layers, weights `[outputs, inputs]` and bias `[outputs]` as in
    `torch.nn.Linear`, with rectified units between.

    Args:
        hand: from hand, action and sliders (2A + G) to the hand's motion (A).
        sliders: for each, from sliders, hand, motion and action (G + 3A) to its motion (1).
        parts: from the hand beside the part, the hand's way, hand, motion, action, the part and its
            memory (7 + 3A + C) to its motion, change of presence and of memory (3 + C).
        contact: terms of the pixel where the hand meets parts, float32
            `[1 + A + A (A + 1) / 2, 2]`.
        reach: pixels from the hand's way beyond which a part does not move.
        arm_low: the hand's code at the first place of the grid of the arm's images, A numbers.
        arm_step: from one place to the next.
        arm_places: places of the grid in each dimension.
        arm_patches: opacity and colour times opacity of tiles, uint8 `[M, 4, T, T]`; the first is
            empty.
        arm_index: number of the patch in each tile of each place's image, int32
            `[places, (S / T)**2]`.
        table: what is behind everything, uint8 `[bins, bins, 3, S, S]` over the sliders' ways.
        sprites: opacity and colour times opacity of each part, float32 `[R, 4, W, W]`.
        blur: standard deviation of the Gaussian blur before frames are compared, in pixels.
        over_horizon: `"last"`, `"sum"` or `"min"` over the predicted frames.
        hold: steps that each action is held for; only frames after a held action count.
        scene_weight: how often what is behind the arm counts, beside the whole frame: the squared
            distance of frames without their arms, where the goal's hides nothing, without a blur.

    Raises:
        ValueError: shapes that do not fit each other, or numbers out of range, of any size.
        TypeError: arrays of another dtype, or objects of another kind.
    """

    def __new__(
        cls,
        *,
        hand: Sequence[_Layer],
        sliders: Sequence[Sequence[_Layer]],
        parts: Sequence[_Layer],
        contact: NDArray[np.float32],
        reach: float,
        arm_low: Sequence[float],
        arm_step: Sequence[float],
        arm_places: Sequence[int],
        arm_patches: NDArray[np.uint8],
        arm_index: NDArray[np.int32],
        table: NDArray[np.uint8],
        sprites: NDArray[np.float32],
        blur: float = 0.0,
        over_horizon: Literal["last", "sum", "min"] = "last",
        hold: SupportsIndex = 1,
        scene_weight: float = 0.0,
    ) -> Self: ...
    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 `[A]`."""
    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 `[A]`."""
    def frames(
        self,
        images: NDArray[np.uint8],
        clean: NDArray[np.float32],
        regions: NDArray[np.bool_],
        states: NDArray[np.float32],
    ) -> LayerFrames:
        """Frames of this world.

        Args:
            images: uint8 `[N, S, S, 3]`.
            clean: the same without the arm, in [0, 1], float32 `[N, S, S, 3]`.
            regions: where each part is in them, bool `[N, R, S, S]`.
            states: float32 `[N, X]`.

        Raises:
            ValueError: shapes that do not fit each other or the world, or numbers that are not
                finite.
        """
    def rollout_costs(
        self, starts: LayerFrames, goals: LayerFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [B, D, H, A]`."""
    def shared_rollout_costs(
        self, start: LayerFrames, goals: LayerFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [D, H, A]` from one start for every goal.

        Those of `rollout_costs`, to the last bit.
        """
    def rollout(self, starts: LayerFrames, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Predicted states float32 `[B, D, H, X]` of `actions [B, D, H, A]`."""
    def draw(self, starts: LayerFrames, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """Frames float32 `[N, S, S, 3]` in [0, 1]: what `starts` look like at `states [N, X]`."""
    def predict(self, starts: LayerFrames, actions: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Predicted frames uint8 `[N, H, S, S, 3]` of `actions [N, H, A]`."""
