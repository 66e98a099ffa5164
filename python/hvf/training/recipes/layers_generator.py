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
# Pairs to a first frame, and of all.
_AHEAD, _MOST_PAIRS = 8, 4_000_000
# Shares of pairs in which the hand alone moves, something slides, a part moves, a part is gone.
_SHARES = (0.2, 0.25, 0.35, 0.2)
# A slider that moved by more of its way slid; a part that moved by more pixels moved.
_SLID, _MOVED = 0.05, 1.5
# What is known of a part (:class:`~hvf.training.tracks.layers.LayerTracks`).
_GONE, _PLACED = 1, 2


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
    """Two states of one episode, a scene and what it is later, in balance.

    Most of what play does is to move the hand. Pairs are sorted by the rarest thing that changes
    between them (a part is gone; a part moved; something slid; nothing but the hand), and each
    kind is drawn with a share of its own, so that the generator learns, and its
    likelihood measures, the rare as well as the common. Parts change places at random: what one
    does is as likely of the others.

    Batches hold ``scenes`` and ``states``, float32 ``[N, X]``.

    Args:
        tracks: recorded episodes.
        count: pairs per step.
        seed: of the draws.
        shares: of the four kinds, from the most common to the rarest.

    Raises:
        ValueError: no pair whose parts are all known.
    """

    def __init__(
        self,
        tracks: LayerTracks,
        count: int,
        seed: int,
        shares: tuple[float, float, float, float] = _SHARES,
    ) -> None:
        self._tracks, self._count, self._seed = tracks, count, seed
        self._shares = shares
        pairs = _pairs(tracks, np.random.default_rng([seed, len(tracks.truth)]))
        if not pairs.shape[1]:
            raise ValueError("tracks: no two frames in which all parts are known, one later")
        kinds = changes(tracks, pairs)
        self._kinds = [pairs[:, kinds == kind] for kind in range(len(shares))]

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        rng = np.random.default_rng([self._seed, step])
        there = [pairs.shape[1] > 0 for pairs in self._kinds]
        shares = np.array(self._shares) * there
        counts = rng.multinomial(self._count, shares / shares.sum())
        drawn = [
            pairs[:, rng.integers(pairs.shape[1], size=count)]
            for pairs, count in zip(self._kinds, counts, strict=True)
            if count
        ]
        episode, first, later = np.concatenate(drawn, axis=1)
        truth, parts = self._tracks.truth, self._tracks.parts
        roaming = self._tracks.known.shape[2]
        order = rng.permuted(np.tile(np.arange(roaming), (self._count, 1)), axis=1)
        found = {"scenes": truth[episode, first], "states": truth[episode, later]}
        for states in found.values():
            each = states[:, parts].reshape(self._count, roaming, 3)
            mixed = np.take_along_axis(each, order[:, :, None], axis=1)
            states[:, parts] = mixed.reshape(self._count, -1)
        return {name: torch.from_numpy(states) for name, states in found.items()}


def _pairs(tracks: LayerTracks, rng: np.random.Generator) -> NDArray[np.int64]:
    """Episodes, first and later frames ``[3, N]`` of pairs in which all parts are known."""
    sure: NDArray[np.bool_] = np.asarray((tracks.known > 0).all(axis=2))
    starts, last = np.argwhere(sure[:, :-1]), tracks.actions.shape[1]
    starts = starts[rng.integers(len(starts), size=min(_AHEAD * len(starts), _MOST_PAIRS))]
    episode, first = starts.T
    ahead = rng.integers(_LATER[0], _LATER[1] + 1, size=len(starts))
    pairs: NDArray[np.int64] = np.stack([episode, first, np.minimum(first + ahead, last)])
    return pairs[:, sure[pairs[0], pairs[2]]]


def changes(tracks: LayerTracks, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """What changes in ``pairs [3, N]`` (episodes, first and later frames), ``[N]``.

    Returns:
        0 where it is the hand alone, 1 where something slid, 2 where a part moved, 3 where one is
        gone; of several the last.
    """
    episode, first, later = pairs
    kinds = np.zeros(pairs.shape[1], np.int64)
    before, after = (tracks.truth[episode, frame] for frame in (first, later))
    known, then = (tracks.known[episode, frame] for frame in (first, later))
    sliders = slice(tracks.hand.stop, tracks.parts.start)
    kinds[(np.abs(after - before)[:, sliders] > _SLID).any(axis=1)] = 1
    apart = (after - before)[:, tracks.parts].reshape(*known.shape, 3)[..., :2]
    both = (known == _PLACED) & (then == _PLACED)
    kinds[(both & (np.linalg.norm(apart, axis=2) > _MOVED)).any(axis=1)] = 2
    kinds[((known == _PLACED) & (then == _GONE)).any(axis=1)] = 3
    return kinds


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
