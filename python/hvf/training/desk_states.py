"""States and frames of recorded episodes of the desk: what the compact dynamics is trained on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from hvf.data.store import EpisodeFile
from hvf.models.parts_dynamics import PartsDynamics

_FRAMES_AT_ONCE = 512
# Frames are kept of every third step: the drawing is trained on them, and memory is short.
FRAME_STRIDE = 3


class DeskStates:
    """States of every frame, actions, and every third frame, in memory.

    Args:
        path: file of episodes of the desk.
        model: whose perception finds the states.
        episodes: how many episodes to read.
        first: the first of them.
        console: where progress goes.

    Attributes:
        states: float32 ``[E, T+1, X]``.
        actions: float32 ``[E, T, A]``.
        frames: uint8 ``[E, T//3 + 1, S, S, 3]``.
    """

    def __init__(
        self,
        path: str | Path,
        model: PartsDynamics,
        episodes: int,
        first: int = 0,
        console: Console | None = None,
    ) -> None:
        with EpisodeFile(path, "desk") as file:
            if not 1 <= first + episodes <= len(file):
                raise ValueError(
                    f"episodes must be at most {len(file) - first} for {path}, got {episodes}"
                )
            steps, shape = file.metadata.steps, file.frame_shape
            self.states = np.empty((episodes, steps + 1, model.config.state_size), np.float32)
            self.actions = np.empty((episodes, steps, file.action_dim), np.float32)
            kept = steps // FRAME_STRIDE + 1
            self.frames = np.empty((episodes, kept, *shape), np.uint8)
            frames = np.empty((steps + 1, *shape), np.uint8)
            device = model.state_mean.device
            numbers = range(episodes)
            for i in track(numbers, "states of all frames", console=console, transient=True):
                file.read_into(first + i, frames, self.actions[i])
                self.frames[i] = frames[::FRAME_STRIDE]
                with torch.inference_mode():
                    parts = torch.split(torch.from_numpy(frames), _FRAMES_AT_ONCE)
                    found = [model.observe(part.to(device)).cpu() for part in parts]
                self.states[i] = torch.cat(found).numpy()


class DeskSampler:
    """Stretches of states with their actions, and pairs of frames with their states.

    Batches are what :meth:`hvf.models.parts_dynamics.PartsDynamics.loss` takes.

    Args:
        data: recorded episodes.
        windows: stretches per step.
        length: steps in a stretch, ``H``.
        pairs: pairs of frames per step.
        apart: most steps between the two frames of a pair.
        seed: of the draws.
    """

    def __init__(
        self, data: DeskStates, windows: int, length: int, pairs: int, apart: int, seed: int
    ) -> None:
        steps = data.actions.shape[1]
        if not 1 <= length <= steps:
            raise ValueError(f"length must be from 1 to {steps}, got {length}")
        for name, value in (("windows", windows), ("pairs", pairs), ("apart", apart)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self._data = data
        self._windows, self._length = windows, length
        self._pairs, self._apart = pairs, apart
        self._seed = seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        data, rng = self._data, np.random.default_rng([self._seed, step])
        episodes, steps = data.actions.shape[:2]
        episode = rng.integers(episodes, size=(self._windows, 1))
        start = rng.integers(steps - self._length + 1, size=(self._windows, 1))
        times = start + np.arange(self._length + 1)
        kept = data.frames.shape[1]
        shown = rng.integers(episodes, size=(self._pairs, 1))
        first = rng.integers(kept, size=(self._pairs, 1))
        reach = max(1, self._apart // FRAME_STRIDE)
        second = np.clip(first + rng.integers(-reach, reach + 1, size=first.shape), 0, kept - 1)
        pair = np.concatenate([first, second], axis=1)
        return {
            "states": torch.from_numpy(data.states[episode, times]),
            "actions": torch.from_numpy(data.actions[episode, times[:, :-1]]),
            "images": torch.from_numpy(data.frames[shown, pair]),
            "pairs": torch.from_numpy(data.states[shown, pair * FRAME_STRIDE]),
        }
