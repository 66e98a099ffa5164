"""Keypoints and actions of recorded episodes: what the compact dynamics model is trained on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from hvf.data.formats.hdf5 import EpisodeFile
from hvf.models.frames import to_unit
from hvf.models.keypoint.dynamics import KeypointDynamics

_EPISODES_AT_ONCE = 4


class Transitions:
    """Keypoints of every frame, actions, and two backgrounds of every scene.

    Args:
        path: file of episodes.
        model: whose perception finds the keypoints.
        episodes: how many episodes to read.
        first: the first of them.
        console: where progress goes.

    Attributes:
        keypoints: float32 ``[P, T+1, 2]``, (row, column) in pixels.
        actions: float32 ``[P, T, A]``.
        backgrounds: float16 ``[P, 2, S, S]``, what does not move, from the first and from the last
            frame.
    """

    def __init__(
        self,
        path: str | Path,
        model: KeypointDynamics,
        episodes: int,
        first: int = 0,
        console: Console | None = None,
    ) -> None:
        with EpisodeFile(path, "maze") as file:
            if not 1 <= first + episodes <= len(file):
                raise ValueError(
                    f"episodes must be at most {len(file) - first} for {path}, got {episodes}"
                )
            steps, shape = file.metadata.steps, file.frame_shape
            self.keypoints = np.empty((episodes, steps + 1, 2), np.float32)
            self.actions = np.empty((episodes, steps, file.action_dim), np.float32)
            self.backgrounds = np.empty((episodes, 2, *shape[:2]), np.float16)
            frames = np.empty((_EPISODES_AT_ONCE, steps + 1, *shape), np.uint8)
            device = next(model.parameters()).device
            chunks = range(0, episodes, _EPISODES_AT_ONCE)
            for begin in track(chunks, "keypoints of all frames", console=console, transient=True):
                count = min(_EPISODES_AT_ONCE, episodes - begin)
                for i in range(count):
                    file.read_into(first + begin + i, frames[i], self.actions[begin + i])
                part = slice(begin, begin + count)
                with torch.inference_mode():
                    images = to_unit(torch.from_numpy(frames[:count]).flatten(0, 1).to(device))
                    keypoints = model.perception.keypoints(images).reshape(count, steps + 1, 2)
                    ends = images.reshape(count, steps + 1, *images.shape[1:])[:, [0, -1]].flatten(
                        0, 1
                    )
                    background = model.background(ends, keypoints[:, [0, -1]].flatten(0, 1))
                self.keypoints[part] = keypoints.cpu().numpy()
                self.backgrounds[part] = background.reshape(count, 2, *shape[:2]).cpu().numpy()


class TransitionSampler:
    """Transitions of a few scenes at a time, drawn uniformly.

    Batches hold ``backgrounds`` float16 ``[G, S, S]``, ``before`` and ``after`` float32
    ``[G, B, 2]``, ``actions`` float32 ``[G, B, A]``.
    """

    def __init__(self, data: Transitions, scenes: int, transitions: int, seed: int) -> None:
        for name, value in (("scenes", scenes), ("transitions", transitions)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self._data = data
        self._scenes = scenes
        self._transitions = transitions
        self._seed = seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        data, rng = self._data, np.random.default_rng([self._seed, step])
        episodes, steps = data.actions.shape[:2]
        episode = rng.integers(episodes, size=(self._scenes, 1))
        time = rng.integers(steps, size=(self._scenes, self._transitions))
        return {
            "backgrounds": torch.from_numpy(data.backgrounds[episode[:, 0], rng.integers(2)]),
            "before": torch.from_numpy(data.keypoints[episode, time]),
            "after": torch.from_numpy(data.keypoints[episode, time + 1]),
            "actions": torch.from_numpy(data.actions[episode, time]),
        }
