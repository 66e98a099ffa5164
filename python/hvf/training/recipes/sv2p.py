"""Training SV2P on clips of episodes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

from hvf.data.loader import WindowSampler
from hvf.models.sv2p.config import SMALL, SV2PConfig
from hvf.models.sv2p.model import SV2P, SV2PSmall
from hvf.training.loop import LoopConfig, seeded
from hvf.training.prediction import validate_prediction
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData

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
    """Training of the paper's dynamics, as the authors ran it but for bfloat16 on a GPU.

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
        self.positive("memory_gb")

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
        return data.fitted(self.model, "the model cannot take it", action_low=low, action_high=high)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SV2PSmallRecipe(SV2PRecipe):
    """Training of SV2P with a quarter of its widths.

    Clips are of 6 frames, the 5 steps that a plan in the maze looks ahead, and the stages are
    shortened with the number of steps.

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
