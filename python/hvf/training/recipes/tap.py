"""Training of time-agnostic prediction on frames between two others of an episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch

from hvf.data.temporal import BetweenSampler
from hvf.images import frame_grid
from hvf.models.frames import to_frames, to_unit
from hvf.models.tap import TAP, TAPConfig
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData
from hvf.training.recipes.vae import PROBES, Probe, centre

# Held-out samples that a validation measures, and how many of them its picture shows.
_SAMPLES = 256
_SHOWN = 12


@dataclasses.dataclass(frozen=True, kw_only=True)
class TAPRecipe(Recipe):
    """Training of time-agnostic prediction.

    Preset ``paper`` is as in the released code: its loss, batches of 256, Adam at a constant 1e-3
    for 100,000 steps. The default is what two cores can pay, with the same layers: smaller
    batches, fewer steps, a rate that ends at 0, and what makes our CVAE learn in fewer steps (see
    :mod:`hvf.models.tap`). Without that, so few steps draw a maze with nobody in it, and with it a
    smear where he may be: where random play is in between is hardly to be predicted.

    Attributes:
        batch_size: samples per step.
        memory_gb: memory for decoded frames.
        nearest: fewest steps from a start to its end.
        furthest: most steps from a start to its end; episodes must be longer.
        margin: steps after the start and before the end in which no candidate lies.
        model: the network; the size of images is the data's.
        loop: how to optimise.
    """

    name: ClassVar[str] = "tap"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {
            "batch_size": 256,
            "model": TAPConfig(),
            "loop": LoopConfig(steps=100_000, learning_rate=1e-3, precision="float32"),
        }
    }

    batch_size: int = 16
    memory_gb: float = 2.0
    nearest: int = 12
    furthest: int = 19
    margin: int = 5
    model: TAPConfig = TAPConfig(centred=True, initialisation="he", pyramid_levels=4)
    loop: LoopConfig = LoopConfig(
        steps=16_000, learning_rate=1e-3, warmup_steps=200, schedule="cosine"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("batch_size")
        self.positive("memory_gb")

    def stages(self, data: TrainingData) -> Stages:
        """One stage: images between two others."""
        seed = self.loop.seed
        config = data.fitted(self.model)
        times = (self.nearest, self.furthest, self.margin)
        held_out = BetweenSampler(data.held_out, _SAMPLES, *times, seed).batch(0)
        probe = PROBES.get(data.environment)
        pool = data.pool(self.memory_gb)
        model = seeded(seed, lambda: TAP(config))
        if config.centred:
            centre(model, pool)
        yield Stage(
            model,
            BetweenSampler(pool, self.batch_size, *times, seed),
            self.loop,
            "proposer: an image between a start and a goal",
            settings={
                "batch_size": self.batch_size,
                "memory_gb": self.memory_gb,
                "nearest": self.nearest,
                "furthest": self.furthest,
                "margin": self.margin,
            },
            validate=lambda trained, generator: validate_tap(
                trained, held_out, generator.device, probe
            ),
        )


def validate_tap(
    model: TAP,
    samples: Mapping[str, torch.Tensor],
    device: torch.device,
    probe: Probe | None = None,
) -> Validation:
    """Measure predictions of held-out samples against the candidates that they are nearest to.

    Args:
        model: in evaluation mode.
        samples: as :class:`~hvf.data.temporal.BetweenSampler` gives them.
        device: the model's.
        probe: further metrics from (candidates, predictions, predictions).

    Returns:
        Negative log likelihood (nats), squared error (mean over values in [0, 1]), that of the
        start image in the prediction's place (``copy_mse``), which candidate it is on average; and
        a picture whose rows are starts, predictions, nearest candidates and ends.
    """
    start, end, candidates = (samples[name].to(device) for name in ("start", "end", "candidates"))
    prediction = model(to_unit(start), to_unit(end))
    least, which = model.negative_likelihoods(prediction, candidates).min(1)
    chosen = candidates[torch.arange(len(which), device=device), which]
    copied = (candidates.float() - start[:, None]).square().flatten(2).mean(2) / 255**2
    metrics = {
        "nats": float(least.mean()),
        "mse": float((prediction - to_unit(chosen)).square().mean()),
        "copy_mse": float(copied.min(1).values.mean()),
        "candidate": float(which.float().mean()),
    }
    rows = [row.cpu().numpy() for row in (start, to_frames(prediction), chosen, end)]
    if probe is not None:
        metrics.update(probe(rows[2], rows[1], rows[1]))
    return Validation(
        metrics, {"proposals": frame_grid([np.asarray(row[:_SHOWN]) for row in rows], zoom=2)}
    )
