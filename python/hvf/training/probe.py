"""Training the position probe, which measures models and which no model learns from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from hvf.data.formats import EpisodeReader
from hvf.models.probe import PositionProbe, PositionProbeConfig
from hvf.training.loop import LoopConfig, Validation, seeded, train

_BATCH = 64
# Frames of an episode are much alike: every third teaches, every seventh of the others tests.
_TAUGHT, _CHECKED, _MOST_CHECKED = 3, 7, 2000


class StateSampler:
    """Frames uint8 `[N, S, S, 3]` and their states `[N, O]`, uniformly."""

    def __init__(self, frames: NDArray[np.uint8], states: NDArray[np.float32], seed: int) -> None:
        self._frames, self._states, self._seed = frames, states, seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        chosen = np.random.default_rng([self._seed, step]).integers(len(self._frames), size=_BATCH)
        return {
            "frames": torch.from_numpy(self._frames[chosen]),
            "states": torch.from_numpy(self._states[chosen]),
        }


def train_probe(
    file: EpisodeReader,
    episodes: Iterable[int],
    checked: Iterable[int],
    loop: LoopConfig,
    out: Path,
    errors: Callable[[PositionProbe, NDArray[np.uint8], NDArray[np.float32]], Mapping[str, float]],
    console: Console,
) -> PositionProbe:
    """Train a probe on true frames and states, or go on with the one in ``out``.

    Args:
        file: where from; with states.
        episodes: numbers of those that it learns from.
        checked: numbers of those that it is validated on.
        loop: how to optimise.
        out: directory of the run.
        errors: what to report of a probe, of frames and their states.
        console: where progress goes.

    Raises:
        ValueError: frames of a size that the probe cannot take, or another run in ``out``.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    episodes, checked = list(episodes), list(checked)
    frames, states = _read(file, episodes, _TAUGHT)
    images, truth = _read(file, checked, _CHECKED)
    images, truth = images[:_MOST_CHECKED], truth[:_MOST_CHECKED]
    sizes = PositionProbeConfig(image_size=frames.shape[1], observables=states.shape[1])
    run: dict[str, Any] = {
        "command": "hvf probe",
        "data": asdict(file.metadata),
        "episodes": len(episodes),
    }
    return train(
        seeded(loop.seed, lambda: PositionProbe(sizes)).fit_scale(torch.from_numpy(states)),
        StateSampler(frames, states, loop.seed),
        loop,
        out,
        environment=file.metadata.environment,
        run=run,
        validate=lambda probe, _: Validation(dict(errors(probe, images, truth))),
        console=console,
    )


def _read(
    file: EpisodeReader, episodes: Iterable[int], stride: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    parts = [file.read(number, 1) for number in episodes]
    frames = np.concatenate([part.frames[0, ::stride] for part in parts])
    states = np.concatenate([part.true_states[0, ::stride] for part in parts])
    return frames, states.astype(np.float32)
