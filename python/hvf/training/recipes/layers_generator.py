"""Training the generator of states on what the layers dynamics sees."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import torch

from hvf.data.loader import EpisodePool
from hvf.images import frame_grid
from hvf.models.frames import to_frames
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.layers.generator import LayerGenerator, LayerGeneratorConfig
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Stage, Stages, TrainingData
from hvf.training.recipes.on_states import OnStates
from hvf.training.tracks.pairs import StatePairs

_SHOWN = 10
_SAMPLES = 5


@dataclasses.dataclass(frozen=True, kw_only=True)
class LayersGeneratorRecipe(OnStates):
    """Training of the generator of states.

    Attributes:
        model: the network; all sizes of its states are the dynamics'.
        loop: how to optimise.
    """

    name: ClassVar[str] = "layers-generator"

    model: LayerGeneratorConfig = LayerGeneratorConfig(
        hidden=384, depth=3, activation="silu", presence_precision=0.1
    )
    loop: LoopConfig = LoopConfig(
        steps=15_000,
        learning_rate=2e-3,
        schedule="cosine",
        warmup_steps=100,
        clip_norm=5.0,
        precision="float32",
        validate_every=2500,
        checkpoint_every=1000,
        threads=1,
    )

    def stages(self, data: TrainingData) -> Stages:
        """One stage: what a scene may look like a few steps later."""
        seed = self.loop.seed
        dynamics = self.seeing(data)
        config = self.sized(self.model, dynamics)
        yield Stage(
            seeded(seed, lambda: LayerGenerator(config)),
            StatePairs(self.tracks(data, dynamics), self.batch_size, seed),
            self.loop,
            "generator: states a few steps after others",
            settings=self.settings(dynamics),
            validate=lambda model, generator: validate_layers_generator(
                model, dynamics, data.held_out, generator
            ),
        )


def validate_layers_generator(
    model: LayerGenerator,
    dynamics: LayerDynamics,
    held_out: EpisodePool,
    generator: torch.Generator,
) -> Validation:
    """Samples in held-out scenes: how often something other than the hand moves, and a picture."""
    perception = dynamics.perception
    scenes = torch.from_numpy(held_out.frames[:_SHOWN, 0])
    states = perception.observe(scenes)
    rows, moved, slid = [scenes.numpy()], [], []
    for _ in range(_SAMPLES):
        latents = torch.randn(
            (len(states), model.config.latent_dim), generator=generator, device=generator.device
        )
        drawn = model.decode(latents, states.to(latents.device)).cpu()
        _, sliders, parts = perception.split(drawn)
        _, sliders_before, before = perception.split(states)
        moved.append((parts != before).any(dim=2).any(dim=1).float().mean())
        slid.append((sliders != sliders_before).any(dim=1).float().mean())
        rows.append(to_frames(perception.draw(perception.scene(scenes), drawn)).numpy())
    metrics = {
        "moved": float(torch.stack(moved).mean()),
        "slid": float(torch.stack(slid).mean()),
    }
    return Validation(metrics, {"subgoals": frame_grid(rows, zoom=2)})
