"""Training of the paper's temporal distance on pairs of frames of one episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch.nn import functional as F

from hvf.data.loader import EpisodePool
from hvf.data.temporal import PartnersSampler
from hvf.images import frame_grid
from hvf.models.frames import to_unit
from hvf.models.tdm import TDM, TDMConfig
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData

# Held-out pairs that a validation measures, and how many episodes its picture shows.
_PAIRS = 512
_SHOWN = 6
# Steps from the first frame at which the picture asks how far it is.
_LATER = (0, 1, 2, 4, 8, 16, 30)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TDMRecipe(Recipe):
    """Training of the paper's temporal distance, network and loss as in the released code.

    Preset ``paper`` is the released training, too: batches of 256, Adam at a constant 1e-3 for
    10,000 steps. The default is what two cores can pay: smaller batches, and a rate that ends
    at 0.

    Attributes:
        batch_size: anchors per step, each with two partners.
        memory_gb: memory for decoded frames.
        furthest: most steps from an anchor to a partner.
        model: the network and its loss; the size of images is the data's.
        loop: how to optimise.
    """

    name: ClassVar[str] = "tdm"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {
            "batch_size": 256,
            "loop": LoopConfig(steps=10_000, learning_rate=1e-3, precision="float32"),
        }
    }

    batch_size: int = 32
    memory_gb: float = 2.0
    furthest: int = 30
    model: TDMConfig = TDMConfig()
    loop: LoopConfig = LoopConfig(
        steps=10_000, learning_rate=1e-3, warmup_steps=200, schedule="cosine"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("batch_size", "furthest")
        self.positive("memory_gb")

    def stages(self, data: TrainingData) -> Stages:
        """One stage: near pairs of frames, and far ones."""
        seed = self.loop.seed
        config = data.fitted(self.model)
        yield Stage(
            seeded(seed, lambda: TDM(config)),
            PartnersSampler(data.pool(self.memory_gb), self.batch_size, self.furthest, seed),
            self.loop,
            "distance: near pairs of frames, and far ones",
            settings={
                "batch_size": self.batch_size,
                "memory_gb": self.memory_gb,
                "furthest": self.furthest,
            },
            validate=lambda trained, generator: validate_tdm(
                trained, data.held_out, generator.device, self.furthest
            ),
        )


def validate_tdm(
    model: TDM, held_out: EpisodePool, device: torch.device, furthest: int = 30
) -> Validation:
    """Measure the classifier on held-out pairs.

    Args:
        model: in evaluation mode.
        held_out: episodes.
        device: the model's.
        furthest: most steps between the frames of a pair.

    Returns:
        Cross entropy (nats), the parts of near and of far pairs that are told right, the mean
        probability of "far" of an image and itself, and a picture: each row an episode's frames
        0, 1, 2, 4, 8, 16 and 30 steps after its first, below them how near the model takes them to
        be to it (white is near).
    """
    batch = PartnersSampler(held_out, _PAIRS, furthest).batch(0)
    anchor, first = (to_unit(batch[name].to(device)) for name in ("anchor", "first"))
    near = (batch["steps"][:, 0].abs() < model.config.near).long().to(device)
    logits = model.logits(anchor, first)
    right = logits.argmax(1) == near
    metrics = {
        "nats": float(F.cross_entropy(logits, near)),
        "near_right": float(right[near == 1].float().mean()),
        "far_right": float(right[near == 0].float().mean()),
        "far_from_itself": float(model(anchor, anchor).mean()),
    }
    shown = min(_SHOWN, len(held_out))
    rows = []
    for episode in range(shown):
        later = np.minimum(_LATER, held_out.lengths[episode])
        seen = held_out.frames[episode, later]
        images = to_unit(torch.from_numpy(seen).to(device))
        far = model(images, images[:1].expand(len(images), -1, -1, -1)).cpu().numpy()
        grey = np.rint(255 * (1 - far)).astype(np.uint8)
        rows += [seen, np.broadcast_to(grey[:, None, None, None], seen.shape).copy()]
    return Validation(metrics, {"distances": frame_grid(rows)})
