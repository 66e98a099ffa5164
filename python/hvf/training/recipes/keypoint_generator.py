"""Training the generator of keypoints on what the keypoint dynamics sees."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

import hvf_core
from hvf.data.loader import EpisodePool
from hvf.images import frame_grid
from hvf.models.keypoint.dynamics import KeypointDynamics
from hvf.models.keypoint.generator import GeneratorConfig, KeypointGenerator
from hvf.training.loop import LoopConfig, Validation
from hvf.training.recipes.on_keypoints import OnKeypoints

_SHOWN = 10
_SAMPLES = 200


class KeypointSampler:
    """Keypoints with the codes of their scenes, drawn uniformly from all frames.

    Batches hold ``keypoints`` float32 ``[N, 2]`` and ``codes`` float32 ``[N, E]``.
    """

    def __init__(
        self, keypoints: NDArray[np.float32], codes: NDArray[np.float32], count: int, seed: int
    ) -> None:
        self._keypoints = keypoints
        self._codes = codes
        self._count = count
        self._seed = seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        rng = np.random.default_rng([self._seed, step])
        episode = rng.integers(len(self._keypoints), size=self._count)
        time = rng.integers(self._keypoints.shape[1], size=self._count)
        return {
            "keypoints": torch.from_numpy(self._keypoints[episode, time]),
            "codes": torch.from_numpy(self._codes[episode]),
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class KeypointGeneratorRecipe(OnKeypoints):
    """Training of the keypoint generator.

    Attributes:
        batch_size: keypoints per step.
        model: the network; the size of its images is the dynamics'.
        loop: how to optimise.
    """

    name: ClassVar[str] = "keypoint-generator"
    about: ClassVar[str] = "generator: where the keypoint may be in a scene"
    sampler: ClassVar[type[KeypointSampler]] = KeypointSampler
    network: ClassVar[type[KeypointGenerator]] = KeypointGenerator

    episodes: int = 1000
    batch_size: int = 1024
    model: GeneratorConfig = GeneratorConfig()
    loop: LoopConfig = LoopConfig(
        steps=5000,
        learning_rate=2e-3,
        schedule="cosine",
        warmup_steps=100,
        validate_every=2500,
        checkpoint_every=1000,
        threads=1,
    )

    def validated(
        self,
        model: Any,
        dynamics: KeypointDynamics,
        held_out: EpisodePool,
        generator: torch.Generator,
    ) -> Validation:
        """See :func:`validate_generator`."""
        return validate_generator(model, dynamics, held_out, generator)


def validate_generator(
    model: KeypointGenerator,
    dynamics: KeypointDynamics,
    held_out: EpisodePool,
    generator: torch.Generator,
) -> Validation:
    """Samples in held-out scenes, a picture of some, and in the maze how many are free.

    A sampled image of the maze is free, the agent standing where it can, if drawing the state that
    it shows again gives the same image: the true renderer pushes an agent out of a wall.
    """
    from hvf.worlds.keypoint import KeypointSubgoals, KeypointWorld  # for pictures only

    world = KeypointWorld(dynamics)
    subgoals = KeypointSubgoals(model, world)
    scenes = world.observe(held_out.frames[:20, 0])
    rows = [held_out.frames[:_SHOWN, 0]]
    errors = []
    for i in range(len(scenes)):
        latents = torch.randn(
            (_SAMPLES, 1, model.config.latent_dim), generator=generator, device=generator.device
        )
        images = subgoals.decode(scenes[np.array([i])], latents.cpu().numpy()).images
        if held_out.metadata.environment == "maze":
            again = hvf_core.maze_render(hvf_core.maze_locate(images), images.shape[1])
            errors.append(hvf_core.image_cost(images, again))
        if i < _SHOWN:
            rows.append(images[:_SHOWN])
    metrics = {"free": float((np.concatenate(errors) < 5e-4).mean())} if errors else {}
    return Validation(metrics, {"subgoals": frame_grid(rows, zoom=2)})
