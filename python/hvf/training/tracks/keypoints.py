"""Keypoints and actions of recorded episodes: what the keypoint models are trained on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from hvf.data.formats import EpisodeReader, open_episodes
from hvf.models.frames import to_unit
from hvf.models.keypoint.dynamics import KeypointDynamics
from hvf.models.keypoint.scene_code import SceneCode
from hvf.training.tracks.kept import kept_beside, refuse_unequal

_EPISODES_AT_ONCE = 4


class Transitions:
    """Keypoints of every frame, actions, and two backgrounds of every scene.

    They are kept beside the file (:mod:`hvf.training.tracks.kept`).

    Args:
        path: file of episodes.
        model: whose perception finds the keypoints.
        episodes: how many episodes to read.
        first: the first of them.
        console: where progress goes.
        camera: whose frames to see; the first one's by default.

    Raises:
        FileNotFoundError, ValueError: as :func:`~hvf.data.formats.open_episodes`; or episodes
            that are not there or of different lengths, or frames of another size than the model's.

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
        camera: str | None = None,
    ) -> None:
        with open_episodes(path, camera=camera) as file:
            refuse_unequal(file)
            if not (episodes >= 1 and 1 <= first + episodes <= len(file)):
                raise ValueError(
                    f"episodes must be at most {len(file) - first} for {path}, got {episodes}"
                )
            size = (model.config.perception.image_size,) * 2
            if file.frame_shape[:2] != size:
                raise ValueError(
                    f"{path}: frames are {file.frame_shape[:2]}, the model takes {size}"
                )
            found = kept_beside(
                Path(path),
                file.metadata,
                model.perception,
                first,
                episodes,
                lambda: _see(file, model, episodes, first, console),
                at_once=_EPISODES_AT_ONCE,
                camera=camera,
                console=console,
            )
        self.keypoints: NDArray[np.float32] = found["keypoints"]
        self.actions: NDArray[np.float32] = found["actions"]
        self.backgrounds: NDArray[np.float16] = found["backgrounds"]

    def codes(self, model: KeypointDynamics, code: SceneCode) -> NDArray[np.float32]:
        """Codes ``[P, E]`` of the scenes, after fitting ``code`` to them."""
        with torch.inference_mode():
            maps = model.maps(torch.from_numpy(self.backgrounds[:, 0]).float())
            codes: NDArray[np.float32] = code.fit(maps)(maps).numpy()
        return codes


def _see(
    file: EpisodeReader, model: KeypointDynamics, episodes: int, first: int, console: Console | None
) -> dict[str, NDArray[Any]]:
    steps, shape = file.metadata.steps, file.frame_shape
    keypoints = np.empty((episodes, steps + 1, 2), np.float32)
    actions = np.empty((episodes, steps, file.action_dim), np.float32)
    backgrounds = np.empty((episodes, 2, *shape[:2]), np.float16)
    frames = np.empty((_EPISODES_AT_ONCE, steps + 1, *shape), np.uint8)
    device = next(model.parameters()).device
    chunks = range(0, episodes, _EPISODES_AT_ONCE)
    for begin in track(chunks, "keypoints of all frames", console=console, transient=True):
        count = min(_EPISODES_AT_ONCE, episodes - begin)
        for i in range(count):
            file.read_into(first + begin + i, frames[i], actions[begin + i])
        part = slice(begin, begin + count)
        with torch.inference_mode():
            images = to_unit(torch.from_numpy(frames[:count]).flatten(0, 1).to(device))
            found = model.perception.keypoints(images).reshape(count, steps + 1, 2)
            ends = images.reshape(count, steps + 1, *images.shape[1:])[:, [0, -1]].flatten(0, 1)
            background = model.background(ends, found[:, [0, -1]].flatten(0, 1))
        keypoints[part] = found.cpu().numpy()
        backgrounds[part] = background.reshape(count, 2, *shape[:2]).cpu().numpy()
    return {"keypoints": keypoints, "actions": actions, "backgrounds": backgrounds}


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
