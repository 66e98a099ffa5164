"""Training the temporal distance on pairs of frames of one episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from hvf.data.loader import EpisodePool
from hvf.data.temporal import doubling_steps
from hvf.images import frame_grid
from hvf.models.keypoint.dynamics import KeypointDynamics
from hvf.models.temporal_distance import TemporalDistance, TemporalDistanceConfig
from hvf.training.loop import LoopConfig, Validation
from hvf.training.recipes.on_keypoints import OnKeypoints

_SHOWN = 10
_PAIRS = 8192


class KeypointPairs:
    """Pairs of keypoints of one episode, and the steps between them.

    Half of the pairs are turned around: random play has no direction. Steps are drawn such that
    every class of doubling width is about as frequent. Batches hold ``before`` and ``after``
    float32 ``[N, 2]``, ``codes`` float32 ``[N, E]``, ``steps`` int64 ``[N]``.
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
        longest = self._keypoints.shape[1] - 1
        steps = doubling_steps(rng, longest, self._count)
        first = rng.integers(0, longest - steps + 1)
        times = np.stack([first, first + steps])
        turned = rng.random(self._count) < 0.5
        times[:, turned] = times[::-1, turned]
        before, after = self._keypoints[episode, times]
        return {
            "before": torch.from_numpy(before),
            "after": torch.from_numpy(after),
            "codes": torch.from_numpy(self._codes[episode]),
            "steps": torch.from_numpy(steps),
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class TemporalDistanceRecipe(OnKeypoints):
    """Training of the temporal distance.

    Attributes:
        batch_size: pairs per step.
        model: the network; the size of its images is the dynamics'.
        loop: how to optimise.
    """

    name: ClassVar[str] = "temporal-distance"
    about: ClassVar[str] = "distance: steps between two keypoints of a scene"
    sampler: ClassVar[type[KeypointPairs]] = KeypointPairs
    network: ClassVar[type[TemporalDistance]] = TemporalDistance

    episodes: int = 3000
    batch_size: int = 2048
    model: TemporalDistanceConfig = TemporalDistanceConfig()
    loop: LoopConfig = LoopConfig(
        steps=10_000,
        learning_rate=3e-3,
        schedule="cosine",
        warmup_steps=100,
        precision="float32",
        validate_every=5000,
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
        """See :func:`validate_temporal_distance`."""
        return validate_temporal_distance(model, dynamics, held_out, generator)


def validate_temporal_distance(
    model: TemporalDistance,
    dynamics: KeypointDynamics,
    held_out: EpisodePool,
    generator: torch.Generator,
) -> Validation:
    """Cross entropy on held-out pairs, and a picture.

    Its rows: scenes; the distance from every point to where the agent stands (bright is near).
    """
    frames = torch.from_numpy(held_out.frames)
    keypoints = torch.stack([dynamics.observe(episode)[0] for episode in frames])
    maps = dynamics.observe(frames[:, 0])[1]
    codes = model.code(maps)
    batch = KeypointPairs(keypoints.numpy(), codes.numpy(), _PAIRS, 0).batch(0)
    labels = model.classes(batch["steps"])
    logits = model.logits(batch["before"], batch["after"], batch["codes"])
    metrics = {
        "nats": float(F.cross_entropy(logits, labels)),
        "right": float((logits.argmax(dim=1) == labels).float().mean()),
    }
    size = model.config.image_size
    line = torch.arange(size, dtype=torch.float32)
    points = torch.stack(torch.meshgrid(line, line, indexing="ij"), dim=-1).reshape(1, -1, 2)
    shown = keypoints[:_SHOWN, :1].expand(-1, size * size, -1)
    code = codes[:_SHOWN, None].expand(-1, size * size, -1)
    distance = model(points.expand(len(shown), -1, -1), shown, code)
    brightness = 255 * (1 - distance / (model.config.classes - 1))
    grey = brightness.reshape(-1, size, size, 1).expand(-1, -1, -1, 3).byte().numpy()
    rows = [held_out.frames[:_SHOWN, 0], grey]
    return Validation(metrics, {"distances": frame_grid(rows, zoom=2)})
