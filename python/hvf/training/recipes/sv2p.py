"""Training SV2P on clips of episodes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch

from hvf.data.loader import EpisodePool, WindowSampler
from hvf.images import frame_grid
from hvf.models.frames import to_frames, to_unit
from hvf.models.image_quality import psnr
from hvf.models.sv2p.config import SMALL, SV2PConfig
from hvf.models.sv2p.model import SV2P, SV2PSmall
from hvf.models.video import VideoModel, sequence_noise
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData

# Held-out clips that a validation measures, and how many of them its picture shows.
_CLIPS = 64
_SHOWN = 6

_PAPER_LOOP = LoopConfig(
    steps=300_000,
    learning_rate=1e-3,
    clip_norm=1.0,
    betas=(0.85, 0.997),
    eps=1e-6,
    validate_every=5_000,
    checkpoint_every=1_000,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SV2PRecipe(Recipe):
    """Training of the paper's dynamics, as the authors ran it: a day or two on one GPU.

    Preset ``paper`` is the same by name, whatever the defaults will be.

    Attributes:
        batch_size: clips per step.
        memory_gb: memory for decoded frames.
        model: the network and its schedules; size of images and box of actions are the data's.
        loop: how to optimise.
    """

    name: ClassVar[str] = "sv2p"
    model_class: ClassVar[type[SV2P]] = SV2P
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"batch_size": 16, "model": SV2PConfig(), "loop": _PAPER_LOOP}
    }

    batch_size: int = 16
    memory_gb: float = 2.0
    model: SV2PConfig = SV2PConfig()
    loop: LoopConfig = _PAPER_LOOP

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("batch_size")
        if not (np.isfinite(self.memory_gb) and self.memory_gb > 0):
            raise ValueError(f"memory_gb must be positive, got {self.memory_gb}")

    def stages(self, data: TrainingData) -> Stages:
        """One stage: the frames of clips from their first frames and actions."""
        seed = self.loop.seed
        config = self.fitting(data)
        model = seeded(seed, lambda: self.model_class(config))
        pool = data.pool(self.memory_gb)
        yield Stage(
            model,
            WindowSampler(pool, self.batch_size, config.frames - 1, seed),
            self.loop,
            "dynamics: frames from a first frame and actions",
            settings={"batch_size": self.batch_size, "memory_gb": self.memory_gb},
            validate=lambda trained, _: validate_prediction(
                trained, data.held_out, config.frames - 1
            ),
        )

    def fitting(self, data: TrainingData) -> SV2PConfig:
        """The model's config, of the data's sizes.

        Raises:
            ValueError: images that the model cannot take, or episodes shorter than a clip.
        """
        low, high = data.action_box
        if data.metadata.steps < self.model.frames - 1:
            raise ValueError(
                f"{data.path}: episodes have {data.metadata.steps} steps, model.frames needs "
                f"{self.model.frames - 1}"
            )
        try:
            return dataclasses.replace(
                self.model, image_size=data.image_size, action_low=low, action_high=high
            )
        except ValueError as error:
            raise ValueError(f"{data.path}: the model cannot take it: {error}") from error


@dataclasses.dataclass(frozen=True, kw_only=True)
class SV2PSmallRecipe(SV2PRecipe):
    """Training of SV2P with a quarter of its widths, in two hours on two cores.

    Clips are of 6 frames: the 5 steps that a plan in the maze looks ahead.

    Attributes:
        batch_size: clips per step.
        memory_gb: memory for decoded frames.
        model: the network and its schedules; size of images and box of actions are the data's.
        loop: how to optimise.
    """

    name: ClassVar[str] = "sv2p-small"
    model_class: ClassVar[type[SV2P]] = SV2PSmall
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}

    batch_size: int = 16
    model: SV2PConfig = SMALL
    loop: LoopConfig = dataclasses.replace(
        _PAPER_LOOP,
        steps=20_000,
        schedule="cosine",
        warmup_steps=100,
        validate_every=1_000,
        checkpoint_every=250,
    )


def validate_prediction(model: VideoModel, held_out: EpisodePool, steps: int) -> Validation:
    """How like the true ones predicted frames are, by steps ahead, on held-out clips.

    Noise is drawn from the prior, as in planning.

    Args:
        model: in evaluation mode.
        held_out: episodes.
        steps: to predict, at least 1.

    Returns:
        PSNR (dB) 1 step ahead, halfway and at the end, as ``psnr_...``, and of the last frame seen,
        copied, as ``still_...``; and a picture, in which a true clip and the predicted one lie one
        below the other.

    Raises:
        ValueError: no episode that is long enough.
    """
    long = np.flatnonzero(held_out.lengths >= steps)
    if not len(long):
        raise ValueError(f"held-out episodes: none has {steps} steps")
    rng = np.random.default_rng(0)
    episodes = long[np.arange(_CLIPS) % len(long)]
    first = rng.integers(held_out.lengths[episodes] - steps + 1)
    times = first[:, None] + np.arange(steps + 1)
    truth = held_out.frames[episodes[:, None], times]
    actions = held_out.actions[episodes[:, None], times[:, :-1]]
    drawn = _predicted(model, truth[:, 0], actions)
    ahead = sorted({1, (steps + 1) // 2, steps})
    metrics = {}
    for h in ahead:
        metrics[f"psnr_{h}"] = float(psnr(drawn[:, h - 1], truth[:, h]).mean())
        metrics[f"still_{h}"] = float(psnr(truth[:, 0], truth[:, h]).mean())
    rows = []
    for clip, guess in zip(truth[:_SHOWN], drawn[:_SHOWN], strict=True):
        rows += [clip, np.concatenate([clip[:1], guess])]
    return Validation(metrics, {"predictions": frame_grid(rows, zoom=2)})


def _predicted(
    model: VideoModel, starts: np.ndarray[Any, Any], actions: np.ndarray[Any, Any]
) -> np.ndarray[Any, Any]:
    """Predicted frames uint8 ``[N, H, S, S, 3]``."""
    device = next(model.parameters()).device
    images = to_unit(torch.from_numpy(starts).to(device))
    acted = torch.from_numpy(actions).to(device)
    noise = sequence_noise(torch.arange(len(starts)), model.noise).to(device)
    state = model.start(images[:, None], acted[:, :0])
    drawn = []
    for step in range(acted.shape[1]):
        state = model.step(state, acted[:, step], noise, last=step + 1 == acted.shape[1])
        drawn.append(to_frames(model.images(state).float()))
    return torch.stack(drawn, dim=1).cpu().numpy()
