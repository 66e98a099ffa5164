"""What the planners ask of a model: any object with these attributes and methods will do.

Letters in shapes: ``B`` problems, ``M`` subgoal samples, ``K`` subgoals, ``L`` latent dimensions,
``D`` candidates per problem, ``H`` time steps, ``A`` action dimensions.

Frames are whatever a model finds convenient: a NumPy array of images, a tensor on a GPU, simulator
states, a class of its own. The planner only counts them, takes some of them by an index array and
hands them back to the model.
"""

from __future__ import annotations

from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Frames", "Observer", "RolloutSharer", "SubgoalModel", "WorldModel"]


@runtime_checkable
class Frames(Protocol):
    """A batch of frames in a model's own memory.

    NumPy arrays and torch tensors are frames, their first axis being the batch.
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


@runtime_checkable
class WorldModel(Protocol[F_contra]):
    """Predicts what actions lead to, and says how far that is from a goal.

    Two attributes are optional: ``max_candidates``, the most candidates ``B * D`` that the model
    wants in one call (default 65536), and the methods of :class:`RolloutSharer` and
    :class:`Observer`.
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
            last; a problem whose costs are all NaN ends the planning with a ``ValueError``.
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
        """
        ...
