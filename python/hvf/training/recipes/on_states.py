"""Training of networks of states, on what the layers dynamics sees in recorded episodes."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, TypeVar

from hvf.models.checkpoint import load_model
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.layers.states import StateSizes
from hvf.training.recipe import Recipe, TrainingData
from hvf.training.tracks.kept import checksum
from hvf.training.tracks.layers import LayerTracks

SizesT = TypeVar("SizesT", bound=StateSizes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnStates(Recipe):
    """What such a training has to know.

    Attributes:
        dynamics: trained layers dynamics (``hvf train layers``).
        episodes: episodes to learn from, at most.
        batch_size: samples per step.
    """

    dynamics: Path = Path("runs/layers/model.safetensors")
    episodes: int = 4000
    batch_size: int = 512

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("episodes", "batch_size")

    def seeing(self, data: TrainingData) -> LayerDynamics:
        """The dynamics.

        Raises:
            FileNotFoundError, ValueError: there are none, or of another environment.
        """
        return load_model(self.dynamics, LayerDynamics, environment=data.environment)

    def sized(self, model: SizesT, dynamics: LayerDynamics) -> SizesT:
        """``model`` for the dynamics' states."""
        perception = dynamics.config.perception
        return dataclasses.replace(
            model,
            image_size=perception.image_size,
            action_dim=perception.arm.action_dim,
            sliders=perception.sliders,
            roaming=perception.roaming,
        )

    def tracks(self, data: TrainingData, dynamics: LayerDynamics) -> LayerTracks:
        """States of the episodes that are learned from."""
        return _tracks(data, dynamics, 0, min(self.episodes, data.training))

    def held_out(self, data: TrainingData, dynamics: LayerDynamics) -> LayerTracks:
        """States of the validation episodes."""
        return _tracks(data, dynamics, data.training, len(data.held_out.frames))

    def settings(self, dynamics: LayerDynamics) -> dict[str, Any]:
        """What a stage's result is a function of, beside its model."""
        return {
            "dynamics": checksum(dynamics),
            "episodes": self.episodes,
            "batch_size": self.batch_size,
        }


def _tracks(data: TrainingData, dynamics: LayerDynamics, first: int, count: int) -> LayerTracks:
    return LayerTracks(
        data.path, dynamics.perception, count, first, console=data.console, camera=data.camera
    )
