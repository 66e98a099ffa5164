"""Episodes in memory, and where they come from.

Letters in shapes: ``N`` episodes of up to ``T`` steps, frames of ``H`` x ``W`` pixels, ``A`` action
dimensions (0 where nobody knows what was done), ``S`` state dimensions. Episode ``i`` has
``lengths[i]`` actions and one more frame;
what arrays hold after its end is zero and means nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclasses.dataclass(frozen=True)
class Metadata:
    """Where the episodes of a file come from.

    Attributes:
        environment: name of the environment, such as ``maze``, or of the recorded data set.
        parameters: what the environment was built with; JSON's types.
        seed: of the collection; episode ``i`` is a function of (seed, i). None for what was
            recorded in the world.
        steps: actions of the longest episode, or as many as one may have, ``T``.
        episodes: number of episodes, ``N``.
        versions: name to version of the programs that made it.
        diverged: simulations that diverged on the way; they are not among the episodes.
        cameras: names of the cameras; the first is the one that is read unless another is asked
            for. None are named in files of version 1.
        action_names: what each dimension of an action is, ``A`` words, or nothing.
        action_low: lowest action, ``A`` numbers, if it is known.
        action_high: highest action, ``A`` numbers, if it is known.

    Raises:
        ValueError: a number out of range, or names and numbers that do not belong together.
        TypeError: names that are no tuple.
    """

    environment: str
    parameters: Mapping[str, Any]
    seed: int | None
    steps: int
    episodes: int
    versions: Mapping[str, str]
    diverged: int = 0
    cameras: tuple[str, ...] = ()
    action_names: tuple[str, ...] = ()
    action_low: tuple[float, ...] | None = None
    action_high: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("episodes", 1), ("diverged", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        for name in ("cameras", "action_names"):
            words = getattr(self, name)
            if not isinstance(words, tuple):
                raise TypeError(f"{name} must be a tuple of words, got {words!r}")
            if not all(words) or len(set(words)) < len(words) or any("/" in word for word in words):
                raise ValueError(f"{name} must be different words without '/', got {words}")
        if (self.action_low is None) != (self.action_high is None):
            raise ValueError("action_low and action_high must both be given, or neither")
        low, high = np.array(self.action_low or ()), np.array(self.action_high or ())
        if low.shape != high.shape or not (np.isfinite(low) & np.isfinite(high)).all():
            raise ValueError("action_low and action_high must be finite, and as many")
        if not (low < high).all():
            raise ValueError(f"action_low must be below action_high, got {low} and {high}")

    def check_actions(self, dimensions: int) -> None:
        """Refuse actions of another size than the names and the box are for.

        Raises:
            ValueError: it is so.
        """
        for name in ("action_names", "action_low", "action_high"):
            value = getattr(self, name)
            if value and len(value) != dimensions:
                raise ValueError(f"{name}: is for {len(value)} dimensions, actions: {dimensions}")


@dataclasses.dataclass(frozen=True)
class Episodes:
    """Episodes in memory.

    Attributes:
        frames: uint8 ``[N, T+1, H, W, 3]``.
        actions: float32 ``[N, T, A]``; action ``t`` leads from frame ``t`` to frame ``t + 1``.
        states: float64 ``[N, T+1, S]``, true states where there are any; never for training.
        diverged: simulations that diverged before these were complete.
        lengths: int64 ``[N]``, steps of each episode, 1 to ``T``; by default all have ``T``.

    Raises:
        ValueError: shapes that do not belong together, no episode, lengths out of range, or
            actions that are not finite.
        TypeError: another dtype than these.
    """

    frames: NDArray[np.uint8]
    actions: NDArray[np.float32]
    states: NDArray[np.float64] | None = None
    diverged: int = 0
    lengths: NDArray[np.int64] = dataclasses.field(default_factory=lambda: np.empty(0, np.int64))

    def __post_init__(self) -> None:
        self._check("frames", self.frames, np.uint8, 5)
        self._check("actions", self.actions, np.float32, 3)
        episodes, steps = self.actions.shape[:2]
        if self.frames.shape[:2] != (episodes, steps + 1) or self.frames.shape[-1] != 3:
            raise ValueError(
                f"frames must be [{episodes}, {steps + 1}, H, W, 3], got {self.frames.shape}"
            )
        if self.states is not None:
            self._check("states", self.states, np.float64, 3)
            if self.states.shape[:2] != (episodes, steps + 1):
                raise ValueError(
                    f"states must be [{episodes}, {steps + 1}, S], got {self.states.shape}"
                )
        if not np.isfinite(self.actions).all():
            raise ValueError("actions must be finite")
        if not np.size(self.lengths):
            object.__setattr__(self, "lengths", np.full(episodes, steps, np.int64))
        self._check("lengths", self.lengths, np.int64, 1)
        if self.lengths.shape != (episodes,):
            raise ValueError(f"lengths must be [{episodes}], got {self.lengths.shape}")
        if self.lengths.min() < 1 or self.lengths.max() > steps:
            raise ValueError(f"lengths must be from 1 to {steps}, got {self.lengths}")

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def true_states(self) -> NDArray[np.float64]:
        """The states, where they are needed.

        Raises:
            ValueError: nobody knows them.
        """
        if self.states is None:
            raise ValueError("states: these episodes have none, they were recorded without")
        return self.states

    @staticmethod
    def _check(name: str, array: NDArray[Any], dtype: Any, ndim: int) -> None:
        if not isinstance(array, np.ndarray):
            raise TypeError(f"{name} must be an array, got {type(array).__name__}")
        if array.dtype != dtype:
            raise TypeError(f"{name} must be {np.dtype(dtype)}, got {array.dtype}")
        # Of what was done, nothing may be known.
        if array.ndim != ndim or 0 in array.shape[: 2 if name == "actions" else ndim]:
            raise ValueError(f"{name} must have {ndim} non-empty axes, got {array.shape}")
