"""Keypoints and actions of recorded episodes: what the compact dynamics model is trained on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from hvf.data.store import EpisodeFile
from hvf.models.frames import to_unit
from hvf.models.keypoint_dynamics import KeypointDynamics

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
        keypoints: float32 ``[P, T+1, 2]``, (row, column) in [-1, 1].
        actions: float32 ``[P, T, A]``.
        pooled: float32 ``[P, 2, S * S / 4]``, backgrounds of the first and the last frame as the
            scene code sees them.
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
            self.pooled: NDArray[np.float32]
            pooled = []
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
                    pixels = model.perception.keypoints(images).reshape(count, steps + 1, 2)
                    ends = images.reshape(count, steps + 1, *images.shape[1:])[:, [0, -1]].flatten(
                        0, 1
                    )
                    background = model.pooled_background(ends, pixels[:, [0, -1]].flatten(0, 1))
                self.keypoints[part] = model.to_keypoints(pixels).cpu().numpy()
                pooled.append(background.reshape(count, 2, -1).cpu().numpy())
        self.pooled = np.concatenate(pooled)

    def hardest(self, model: KeypointDynamics, fraction: float) -> NDArray[np.bool_]:
        """The transitions ``[P, T]`` that ``model`` predicts worst: this ``fraction`` of them."""
        errors = []
        with torch.inference_mode():
            codes = model.scene_code(torch.from_numpy(self.pooled[:, 0]))
            for i, code in enumerate(codes):
                before, after = torch.from_numpy(self.keypoints[i]).unfold(0, 2, 1).unbind(-1)
                actions = torch.from_numpy(self.actions[i])
                predicted = model.step(before, code.expand(len(before), -1), actions)
                errors.append((predicted - after).norm(dim=1).numpy())
        error = np.stack(errors)
        return np.asarray(error > np.quantile(error, 1.0 - fraction))


class TransitionSampler:
    """Transitions of a few scenes at a time.

    Without ``hard`` they are drawn uniformly; with it, ``hard_share`` of them from those marked
    there, where an episode has any. Batches hold ``pooled`` float32 ``[G, S * S / 4]``, ``before``
    and ``after`` float32 ``[G, B, 2]``, ``actions`` float32 ``[G, B, A]``.
    """

    def __init__(
        self,
        data: Transitions,
        scenes: int,
        transitions: int,
        seed: int,
        hard: NDArray[np.bool_] | None = None,
        hard_share: float = 0.0,
    ) -> None:
        for name, value in (("scenes", scenes), ("transitions", transitions)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self._data = data
        self._scenes = scenes
        self._transitions = transitions
        self._seed = seed
        self._from_marked = round(hard_share * transitions)
        marked = np.zeros(data.actions.shape[:2], bool) if hard is None else hard
        # Times of every episode, the marked ones first.
        self._order = np.argsort(~marked, axis=1, kind="stable")
        self._marked = marked.sum(axis=1)

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        data, rng = self._data, np.random.default_rng([self._seed, step])
        episodes, steps = data.actions.shape[:2]
        episode = rng.integers(episodes, size=(self._scenes, 1))
        choices = np.full((self._scenes, self._transitions), steps)
        marked = self._marked[episode]
        choices[:, : self._from_marked] = np.where(marked > 0, marked, steps)
        place = (rng.random(choices.shape) * choices).astype(np.int64)
        time = self._order[episode, place]
        return {
            "pooled": torch.from_numpy(data.pooled[episode[:, 0], rng.integers(2)]),
            "before": torch.from_numpy(data.keypoints[episode, time]),
            "after": torch.from_numpy(data.keypoints[episode, time + 1]),
            "actions": torch.from_numpy(data.actions[episode, time]),
        }
