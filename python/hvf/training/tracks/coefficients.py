"""Coefficients and actions of recorded episodes: what the latent dynamics are trained on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from hvf.data.formats import EpisodeReader, open_episodes
from hvf.models.frames import to_unit
from hvf.models.latent.basis import BlurredBasis
from hvf.threads import one_thread
from hvf.training.tracks.kept import kept_beside

_EPISODES_AT_ONCE = 4
# The components are taken from so many episodes at most, and from each n-th frame of them.
_SAMPLED, _STRIDE = 500, 3


class Coefficients:
    """Coefficients of every frame, and the actions between them.

    They are kept beside the file (:mod:`hvf.training.tracks.kept`).

    Args:
        path: file of episodes.
        basis: fitted (:func:`fit_basis`).
        episodes: how many episodes to read, from the first.
        console: where progress goes.
        camera: whose frames to see; the first one's by default.

    Raises:
        FileNotFoundError, ValueError: as :func:`~hvf.data.formats.open_episodes`.

    Attributes:
        coefficients: float16 ``[P, T+1, Z]``.
        actions: float32 ``[P, T, A]``.
        lengths: int64 ``[P]``, steps of each episode; what is after its end means nothing.
    """

    def __init__(
        self,
        path: str | Path,
        basis: BlurredBasis,
        episodes: int,
        console: Console | None = None,
        camera: str | None = None,
    ) -> None:
        with open_episodes(path, camera=camera) as file:
            found = kept_beside(
                Path(path),
                file.metadata,
                basis,
                0,
                episodes,
                lambda: _see(file, basis, episodes, console),
                at_once=_EPISODES_AT_ONCE,
                camera=camera,
                console=console,
            )
            self.lengths = file.lengths[:episodes]
        self.coefficients: NDArray[np.float16] = found["coefficients"]
        self.actions: NDArray[np.float32] = found["actions"]


def fit_basis(
    path: str | Path,
    basis: BlurredBasis,
    episodes: int,
    console: Console | None = None,
    camera: str | None = None,
) -> None:
    """Take the components of ``basis`` from some of a file's first episodes.

    Args:
        path: file of episodes.
        basis: fitted here.
        episodes: how many episodes to choose from, from the first.
        console: where progress goes.
        camera: whose frames to see; the first one's by default.

    Raises:
        FileNotFoundError, ValueError: as :func:`~hvf.data.formats.open_episodes`; or frames that
            are all the same.
    """
    with open_episodes(path, camera=camera) as file:
        chosen = np.unique(np.linspace(0, episodes - 1, min(episodes, _SAMPLED)).astype(int))
        frames = _frames(file, chosen.tolist(), console, "components of frames")
        # One thread: the same components, and so the same file of coefficients, on any number.
        with one_thread():
            basis.fit(to_unit(torch.from_numpy(part[::_STRIDE])) for part in frames)


def _frames(
    file: EpisodeReader, numbers: list[int], console: Console | None, about: str
) -> Iterator[NDArray[np.uint8]]:
    """Frames of episodes, uint8 ``[length + 1, H, W, 3]`` each."""
    frames = np.empty((file.metadata.steps + 1, *file.frame_shape), np.uint8)
    actions = np.empty((file.metadata.steps, file.action_dim), np.float32)
    for number in track(numbers, about, console=console, transient=True):
        file.read_into(number, frames, actions)
        yield frames[: file.lengths[number] + 1]


def _see(
    file: EpisodeReader, basis: BlurredBasis, episodes: int, console: Console | None
) -> dict[str, NDArray[Any]]:
    steps, size = file.metadata.steps, len(basis.scale)
    coefficients = np.zeros((episodes, steps + 1, size), np.float16)
    actions = np.empty((episodes, steps, file.action_dim), np.float32)
    frames = np.empty((steps + 1, *file.frame_shape), np.uint8)
    for number in track(range(episodes), "coefficients", console=console, transient=True):
        file.read_into(number, frames, actions[number])
        with one_thread():
            found = basis(to_unit(torch.from_numpy(frames)))
        coefficients[number] = found.numpy()
    return {"coefficients": coefficients, "actions": actions}


class CoefficientWindows:
    """Stretches of consecutive frames, as coefficients, with their actions.

    Batches hold ``coefficients`` float16 ``[B, L+1, Z]`` and ``actions`` float32 ``[B, L, A]``: an
    episode drawn uniformly among those that are long enough, and a start in it. With ``hold`` the
    frames are so many steps apart, and a stretch begins where an action begins that is held.

    Args:
        data: coefficients of episodes.
        batch_size: stretches, ``B``.
        length: predicted frames, ``L``.
        hold: steps of the environment from one frame to the next.
        seed: of the draws.

    Raises:
        ValueError: no episode is long enough, or a number below 1.
    """

    def __init__(
        self, data: Coefficients, batch_size: int, length: int, hold: int, seed: int
    ) -> None:
        for name, value in (("batch_size", batch_size), ("length", length), ("hold", hold)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        self._enough = np.flatnonzero(data.lengths >= length * hold)
        if not len(self._enough):
            raise ValueError(
                f"length: no episode has {length * hold} steps; the longest has "
                f"{data.lengths.max()}"
            )
        self._data = data
        self._batch_size, self._length, self._hold, self._seed = batch_size, length, hold, seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        data, hold, rng = self._data, self._hold, np.random.default_rng([self._seed, step])
        episodes = self._enough[rng.integers(len(self._enough), size=(self._batch_size, 1))]
        starts = rng.integers(data.lengths[episodes] // hold - self._length + 1)
        times = (starts + np.arange(self._length + 1)) * hold
        return {
            "coefficients": torch.from_numpy(data.coefficients[episodes, times]),
            "actions": torch.from_numpy(data.actions[episodes, times[:, :-1]]),
        }
