"""Paths of latents that a policy went, and goals put in their place in hindsight.

Stable-Baselines3 has such a buffer, which mixes the goals that were reached for with those of one
kind of hindsight, and none with imagined ones; its learner owns the loop, and keeps runs as
pickles.

Letters in shapes: ``E`` paths, ``T`` steps of a path, ``L`` latent dimensions, ``A`` action
dimensions, ``B`` transitions of a batch.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class Relabelling:
    """Whose goals the transitions of a batch are given; the defaults are those of RIG (rlkit).

    Attributes:
        rollout: part that keeps the goals that were reached for.
        prior: part that is given new goals from the VAE's prior, N(0, I). The rest is given a
            latent of the same path, from the transition's own end on: "future".

    Raises:
        ValueError: parts that are negative or more than all.
    """

    rollout: float = 0.1
    prior: float = 0.5

    def __post_init__(self) -> None:
        for name in ("rollout", "prior"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.rollout + self.prior > 1:
            raise ValueError(f"rollout and prior must be at most 1 together, got {self}")

    def counts(self, size: int) -> tuple[int, int, int]:
        """Transitions of a batch that keep theirs, get the prior's, and get their future."""
        rollout, prior = int(size * self.rollout), int(size * self.prior)
        return rollout, prior, size - rollout - prior


class Replay:
    """The last paths, in latents.

    Args:
        capacity: transitions that are kept; paths, whole, as many as these fill, at least one.
        steps: most steps of a path, ``T``.
        latent_dim: ``L``.
        action_dim: ``A``.

    Raises:
        ValueError: a number below 1.
    """

    def __init__(self, capacity: int, steps: int, latent_dim: int, action_dim: int) -> None:
        for name, value in (("capacity", capacity), ("steps", steps)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self._most = max(1, capacity // steps)
        self._begun = 0
        self._latents = np.zeros((0, steps + 1, latent_dim), np.float32)
        self._actions = np.zeros((0, steps, action_dim), np.float32)
        self._goals = np.zeros((0, latent_dim), np.float32)
        self._lengths = np.zeros(0, np.int64)

    def __len__(self) -> int:
        """Return the number of transitions."""
        return int(self._lengths.sum())

    def begin(self, latents: Floats, goals: Floats) -> NDArray[np.int64]:
        """Begin paths at ``latents [N, L]`` towards ``goals [N, L]``; where they are kept.

        Raises:
            ValueError: more paths at once than are kept.
        """
        count = len(latents)
        if count > self._most:
            raise ValueError(f"capacity: keeps {self._most} paths, {count} are begun at once")
        slots = (self._begun + np.arange(count)) % self._most
        self._begun += count
        missing = max(slots) + 1 - len(self._lengths)
        if missing > 0:
            # Grown by more than is needed, since every growth copies all.
            more = min(self._most - len(self._lengths), max(missing, len(self._lengths)))
            for name in ("_latents", "_actions", "_goals", "_lengths"):
                held = getattr(self, name)
                grown = np.zeros((len(held) + more, *held.shape[1:]), held.dtype)
                grown[: len(held)] = held
                setattr(self, name, grown)
        self._latents[slots, 0], self._goals[slots], self._lengths[slots] = latents, goals, 0
        return np.asarray(slots)

    def add(self, slots: NDArray[np.int64], actions: Floats, latents: Floats) -> None:
        """Add a step to paths: ``actions [N, A]`` lead to ``latents [N, L]``."""
        steps = self._lengths[slots]
        self._actions[slots, steps] = actions
        self._latents[slots, steps + 1] = latents
        self._lengths[slots] += 1

    def sample(
        self, size: int, relabelling: Relabelling, rng: np.random.Generator
    ) -> Mapping[str, torch.Tensor]:
        """A batch of transitions with goals: the first keep theirs, the last get their future.

        Returns:
            ``latent``, ``after`` and ``goal``, float32 ``[B, L]``, and ``action``,
            float32 ``[B, A]``.

        Raises:
            ValueError: nothing to draw from.
        """
        if not len(self):
            raise ValueError("replay: there are no transitions yet")
        ends = np.cumsum(self._lengths)
        drawn = rng.integers(ends[-1], size=size)
        paths = np.searchsorted(ends, drawn, side="right")
        steps = drawn - (ends[paths] - self._lengths[paths])
        rollout, prior, future = relabelling.counts(size)
        goals = self._goals[paths]
        imagined = rng.standard_normal((prior, goals.shape[1]), np.float32)
        goals[rollout : rollout + prior] = imagined
        late = slice(rollout + prior, size)
        when = rng.integers(steps[late], self._lengths[paths[late]], size=future) + 1
        goals[late] = self._latents[paths[late], when]
        return {
            "latent": torch.from_numpy(self._latents[paths, steps]),
            "action": torch.from_numpy(self._actions[paths, steps]),
            "after": torch.from_numpy(self._latents[paths, steps + 1]),
            "goal": torch.from_numpy(goals),
        }

    def path(self, slots: NDArray[np.int64]) -> tuple[Floats, Floats, Floats, NDArray[np.int64]]:
        """Latents ``[N, T+1, L]``, actions ``[N, T, A]``, goals and lengths of paths."""
        return (
            self._latents[slots],
            self._actions[slots],
            self._goals[slots],
            self._lengths[slots],
        )

    def memory(self) -> dict[str, torch.Tensor]:
        """All that it holds."""
        used = min(self._begun, self._most)
        kept = {name: getattr(self, f"_{name}")[:used] for name in _KEPT}
        tensors = {name: torch.from_numpy(array.copy()) for name, array in kept.items()}
        return {**tensors, "begun": torch.tensor(self._begun)}

    def recall(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Hold what :meth:`memory` gave.

        Raises:
            ValueError: it is of another replay.
        """
        arrays: dict[str, NDArray[Any]] = {name: tensors[name].numpy() for name in _KEPT}
        for name, array in arrays.items():
            held = getattr(self, f"_{name}")
            if array.shape[1:] != held.shape[1:] or len(array) > self._most:
                raise ValueError(f"replay: {name} has shape {array.shape}, which does not fit")
            setattr(self, f"_{name}", array.copy())
        self._begun = int(tensors["begun"])


_KEPT = ("latents", "actions", "goals", "lengths")
