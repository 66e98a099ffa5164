"""Training of models that see a frame as its keypoint and the code of its scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import torch

from hvf.data.loader import EpisodePool
from hvf.models.checkpoint import load_model
from hvf.models.keypoint.dynamics import KeypointDynamics
from hvf.training.loop import Sampler, Validation, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData
from hvf.training.tracks.kept import checksum
from hvf.training.tracks.keypoints import Transitions


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnKeypoints(Recipe):
    """What such a training has to know, and its one stage.

    Attributes:
        dynamics: trained keypoint dynamics (``hvf train keypoint``).
        episodes: episodes to learn from, at most.
        batch_size: samples per step.
        model: the network; the size of its images is the dynamics'.
    """

    about: ClassVar[str]
    """What is learned, in a line."""
    network: ClassVar[type[Any]]
    """The module; its ``code`` is fitted to the scenes (:class:`SceneCode`)."""
    sampler: ClassVar[Callable[..., Sampler]]
    """Makes batches of keypoints ``[P, T+1, 2]``, codes ``[P, E]``, a number a step and a seed."""

    dynamics: Path = Path("runs/keypoint/model.safetensors")
    episodes: int = 1000
    batch_size: int = 1024
    model: Any = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("episodes", "batch_size")

    def validated(
        self,
        model: Any,
        dynamics: KeypointDynamics,
        held_out: EpisodePool,
        generator: torch.Generator,
    ) -> Validation:
        """Measure the model on held-out episodes."""
        raise NotImplementedError

    def stages(self, data: TrainingData) -> Stages:
        """One stage."""
        seed, kind = self.loop.seed, type(self)
        dynamics = load_model(self.dynamics, KeypointDynamics, environment=data.environment)
        size = dynamics.config.perception.image_size
        config = dataclasses.replace(self.model, image_size=size)
        model = seeded(seed, lambda: kind.network(config))
        episodes = min(self.episodes, data.training)
        found = Transitions(data.path, dynamics, episodes, console=data.console, camera=data.camera)
        codes = found.codes(dynamics, model.code)
        yield Stage(
            model,
            kind.sampler(found.keypoints, codes, self.batch_size, seed),
            self.loop,
            kind.about,
            settings={
                "dynamics": checksum(dynamics),
                "episodes": self.episodes,
                "batch_size": self.batch_size,
            },
            validate=lambda trained, generator: self.validated(
                trained, dynamics, data.held_out, generator
            ),
        )
