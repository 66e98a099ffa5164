"""Training the desk's temporal distance on pairs of one episode, and on transplants."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import torch

from hvf.data.temporal import doubling_steps
from hvf.images import frame_grid
from hvf.models.doublings import class_of
from hvf.models.layers.distance import LayerDistance, LayerDistanceConfig
from hvf.models.layers.dynamics import LayerDynamics
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Stage, Stages, TrainingData
from hvf.training.recipes.on_states import OnStates
from hvf.training.tracks.pairs import StatePairs
from hvf.training.tracks.transplants import Transplants

# Pairs that are measured, and scenes that are shown.
_MEASURED, _SHOWN = 4096, 10
# Shares of pairs in which the hand alone moves, something slides, a part moves, a part is gone.
_SHARES = (0.25, 0.25, 0.25, 0.25)
# Distances from here on are drawn black.
_FAR = 12.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class LayersDistanceRecipe(OnStates):
    """Training of the desk's temporal distance.

    Attributes:
        transplants: share of pairs in which something is where another episode had it.
        model: the network; all sizes of its states are the dynamics'.
        loop: how to optimise.
    """

    name: ClassVar[str] = "layers-distance"

    batch_size: int = 1024
    transplants: float = 0.5
    model: LayerDistanceConfig = LayerDistanceConfig()
    loop: LoopConfig = LoopConfig(
        steps=3000,
        learning_rate=3e-3,
        weight_decay=0.1,
        schedule="cosine",
        warmup_steps=100,
        clip_norm=5.0,
        precision="float32",
        validate_every=1500,
        checkpoint_every=1000,
        threads=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.transplants < 1:
            raise ValueError(f"transplants must be at least 0 and below 1, got {self.transplants}")

    def stages(self, data: TrainingData) -> Stages:
        """One stage: steps between two states."""
        seed = self.loop.seed
        dynamics = self.seeing(data)
        config = self.sized(self.model, dynamics)

        def pairs(held_out: bool, count: int) -> Transplants:
            tracks = (self.held_out if held_out else self.tracks)(data, dynamics)
            longest = tracks.actions.shape[1]
            of_one = StatePairs(
                tracks, count, seed, _SHARES, lambda rng, n: doubling_steps(rng, longest, n)
            )
            return Transplants(of_one, tracks, self.transplants, seed)

        measured = pairs(True, _MEASURED)
        yield Stage(
            seeded(seed, lambda: LayerDistance(config)),
            pairs(False, self.batch_size),
            self.loop,
            "distance: steps of play between two states",
            settings={**self.settings(dynamics), "transplants": self.transplants},
            validate=lambda model, _: validate_layers_distance(model, dynamics, measured, data),
        )


def validate_layers_distance(
    model: LayerDistance, dynamics: LayerDynamics, pairs: Transplants, data: TrainingData
) -> Validation:
    """The loss on held-out pairs, how well transplants are told, and a picture.

    ``told``: of things in their place and of transplanted ones, the share that is taken for what
    it is, mean of both. ``right``: of pairs without any, the share whose class of steps is found.
    The picture's rows: scenes; the distance to each if its first part were moved to every place
    (bright is near).
    """
    batch = pairs.batch(0)
    loss, pieces = model.loss(batch, torch.Generator(), 0)
    steps, apart = model.logits(batch["scenes"], batch["states"])
    labels = batch["transplanted"]
    called = (apart > 0) == labels
    told = [called[labels == kind].float().mean() for kind in (False, True)]
    right = steps.argmax(dim=1) == class_of(batch["steps"], model.config.classes)
    metrics = {
        "nats": float(loss),
        **{name: float(value) for name, value in pieces.items()},
        "right": float(right[~labels.any(dim=1)].float().mean()),
        "told": float(torch.stack(told).mean()),
    }
    frames = data.held_out.frames[:_SHOWN, 0]
    size = model.config.image_size
    line = torch.arange(size, dtype=torch.float32)
    places = torch.stack(torch.meshgrid(line, line, indexing="ij"), dim=-1).reshape(-1, 2)
    maps = []
    part = slice(-3 * model.config.roaming, -3 * model.config.roaming + 2)
    for state in dynamics.perception.observe(torch.from_numpy(frames)):
        before = state.expand(len(places), -1)
        after = before.clone()
        after[:, part] = places
        maps.append((255 * (1 - model(before, after) / _FAR)).clamp(0, 255))
    grey = torch.stack(maps).reshape(-1, size, size, 1).expand(-1, -1, -1, 3).byte().numpy()
    return Validation(metrics, {"distances": frame_grid([frames, grey], zoom=2)})
