"""Training the generator of states on what the layers dynamics sees."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.data.loader import EpisodePool
from hvf.images import frame_grid
from hvf.models.checkpoint import load_model
from hvf.models.frames import to_frames
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.layers.generator import LayerGenerator, LayerGeneratorConfig
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData
from hvf.training.tracks.kept import checksum
from hvf.training.tracks.layers import LayerTracks

_SHOWN = 10
_SAMPLES = 5
# Steps between a scene and what it looks like later: as far as a plan reaches, and twice that.
_LATER = (5, 30)
_PLAN = 15


@dataclasses.dataclass(frozen=True, kw_only=True)
class LayersGeneratorRecipe(Recipe):
    """Training of the generator of states.

    Attributes:
        dynamics: trained layers dynamics (``hvf train layers``).
        episodes: episodes to learn from, at most.
        batch_size: pairs of states per step.
        model: the network; all sizes of its states are the dynamics'.
        loop: how to optimise.
    """

    name: ClassVar[str] = "layers-generator"

    dynamics: Path = Path("runs/layers/model.safetensors")
    episodes: int = 4000
    batch_size: int = 512
    model: LayerGeneratorConfig = LayerGeneratorConfig()
    loop: LoopConfig = LoopConfig(
        steps=10_000,
        learning_rate=2e-3,
        schedule="cosine",
        warmup_steps=100,
        clip_norm=5.0,
        precision="float32",
        validate_every=2500,
        checkpoint_every=1000,
        threads=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("episodes", "batch_size")

    def stages(self, data: TrainingData) -> Stages:
        """One stage: what a scene may look like a few steps later."""
        seed = self.loop.seed
        dynamics = load_model(self.dynamics, LayerDynamics, environment=data.environment)
        perception = dynamics.config.perception
        config = dataclasses.replace(
            self.model,
            image_size=perception.image_size,
            action_dim=perception.arm.action_dim,
            sliders=perception.sliders,
            roaming=perception.roaming,
        )
        episodes = min(self.episodes, data.training)
        tracks = LayerTracks(
            data.path, dynamics.perception, episodes, console=data.console, camera=data.camera
        )
        yield Stage(
            seeded(seed, lambda: LayerGenerator(config)),
            StatePairs(tracks, self.batch_size, seed),
            self.loop,
            "generator: states a few steps after others",
            settings={
                "dynamics": checksum(dynamics),
                "episodes": self.episodes,
                "batch_size": self.batch_size,
            },
            validate=lambda model, generator: validate_layers_generator(
                model, dynamics, data.held_out, generator
            ),
        )


class StatePairs:
    """Two states of one episode, a scene and what it is later; in half of them a part is pushed.

    Batches hold ``scenes`` and ``states``, float32 ``[N, X]``.

    Args:
        tracks: recorded episodes.
        count: pairs per step.
        seed: of the draws.

    Raises:
        ValueError: no pair whose parts are all known.
    """

    def __init__(self, tracks: LayerTracks, count: int, seed: int) -> None:
        self._tracks, self._count, self._seed = tracks, count, seed
        self._sure: NDArray[np.bool_] = np.asarray((tracks.known > 0).all(axis=2))
        pushed = tracks.pushed(min(_PLAN, tracks.actions.shape[1]))
        self._pushed = pushed[self._sure[pushed[:, 0], pushed[:, 1]]]
        self._any = self._starts()
        if not len(self._any):
            raise ValueError("tracks: no two frames in which all parts are known, one later")

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        rng = np.random.default_rng([self._seed, step])
        found, wanted = [self._draw(rng)], self._count
        while sum(pairs.shape[1] for pairs in found) < wanted:
            found.append(self._draw(rng))
        episode, first, later = np.concatenate(found, axis=1)[:, :wanted]
        truth = self._tracks.truth
        return {
            "scenes": torch.from_numpy(truth[episode, first]),
            "states": torch.from_numpy(truth[episode, later]),
        }

    def _starts(self) -> NDArray[np.int64]:
        """Episodes and frames ``[N, 2]`` that are known, as is one of those drawn for later."""
        starts, last = np.argwhere(self._sure[:, :-1]), self._tracks.actions.shape[1]
        before = np.pad(self._sure.cumsum(axis=1), ((0, 0), (1, 0)))
        nearest, farthest = (np.minimum(starts[:, 1] + ahead, last) for ahead in _LATER)
        between = before[starts[:, 0], farthest + 1] - before[starts[:, 0], nearest]
        chosen: NDArray[np.int64] = starts[between > 0]
        return chosen

    def _draw(self, rng: np.random.Generator) -> NDArray[np.int64]:
        """Episodes, first and later frames ``[3, N]`` of pairs that are known."""
        # Twice as many as are wanted: some end where a part is not known.
        size, last = 2 * self._count, self._tracks.actions.shape[1]
        chosen = self._any[rng.integers(len(self._any), size=size)]
        ahead = rng.integers(_LATER[0], _LATER[1] + 1, size=size)
        if len(self._pushed):
            half = np.arange(size) % 2 == 0
            chosen[half] = self._pushed[rng.integers(len(self._pushed), size=half.sum())]
            ahead[half] = _PLAN
        episode, first = chosen.T
        later = np.minimum(first + ahead, last)
        pairs: NDArray[np.int64] = np.stack([episode, first, later])
        return pairs[:, self._sure[episode, later]]


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
