"""Training the spatial latent model on stretches of frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

from hvf.data.loader import WindowSampler
from hvf.models.spatial import SpatialConfig, SpatialLatent
from hvf.training.loop import LoopConfig, seeded
from hvf.training.prediction import validate_prediction
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialRecipe(Recipe):
    """Training of the spatial latent model, on any episodes.

    Preset ``desk`` is for a scene of an arm and several objects, and for two hours on two cores.

    Attributes:
        batch_size: stretches of frames per step.
        length: predicted frames of a stretch.
        memory_gb: memory for decoded frames.
        model: the network and its loss; size of images and box of actions are the data's, and so is
            ``hold`` where the data says that actions are held.
        loop: how to optimise.
    """

    name: ClassVar[str] = "spatial-latent"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "desk": {"memory_gb": 3.2},
    }

    batch_size: int = 16
    length: int = 5
    memory_gb: float = 2.0
    model: SpatialConfig = SpatialConfig()
    loop: LoopConfig = LoopConfig(
        steps=10_000,
        learning_rate=1.5e-3,
        schedule="cosine",
        warmup_steps=300,
        weight_decay=1e-4,
        clip_norm=1.0,
        validate_every=500,
        checkpoint_every=250,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("batch_size", "length")
        self.positive("memory_gb")

    def stages(self, data: TrainingData) -> Stages:
        """One stage: frames from first frames and actions."""
        seed = self.loop.seed
        config = self.fitting(data)
        model = seeded(seed, lambda: SpatialLatent(config))
        sampler = WindowSampler(
            data.pool(self.memory_gb), self.batch_size, self.length, seed, hold=config.hold
        )
        yield Stage(
            model,
            sampler,
            self.loop,
            "dynamics: a grid of features, how actions move it, and what it looks like",
            settings={
                "batch_size": self.batch_size,
                "length": self.length,
                "memory_gb": self.memory_gb,
            },
            validate=lambda trained, _: validate_prediction(trained, data.held_out, self.length),
        )

    def fitting(self, data: TrainingData) -> SpatialConfig:
        """The model's config, of the data's sizes.

        Raises:
            ValueError: images or episodes that the model cannot take.
        """
        return data.fitted_to_held(self.model, "the spatial latent model cannot take it")
