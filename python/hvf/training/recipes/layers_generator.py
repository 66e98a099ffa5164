"""Training the generator of the desk's states on what the compact dynamics sees."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from hvf.data.loader import EpisodePool
from hvf.images import frame_grid
from hvf.models.checkpoint import load_model
from hvf.models.frames import to_frames
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.layers.generator import LayerGenerator, LayerGeneratorConfig
from hvf.training.loop import LoopConfig, Validation, seeded, train
from hvf.training.tracks.layers import LayerTracks

_SHOWN = 10
_SAMPLES = 5
# Steps between a scene and what it looks like later: as far as a plan reaches, and twice that.
_LATER = (5, 30)
_PLAN = 15


@dataclasses.dataclass(frozen=True)
class LayersGeneratorTraining:
    """Training of the generator of the desk's states.

    Attributes:
        data: file of episodes (``hvf collect desk``).
        dynamics: trained compact dynamics (``hvf train desk-dynamics``).
        out: directory of the run; a run that is already there is continued.
        episodes: episodes to learn from.
        batch_size: pairs of states per step.
        model: the network.
        loop: how to optimise.
    """

    data: Path
    dynamics: Path = Path("runs/desk_dynamics/model.safetensors")
    out: Path = Path("runs/desk_generator")
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
        for name in ("episodes", "batch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


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


def train_layers_generator(
    config: LayersGeneratorTraining, console: Console | None = None
) -> LayerGenerator:
    """Train the generator of states, or go on with the run in ``config.out``.

    Raises:
        FileNotFoundError: no data file, or no dynamics model.
        ValueError: a damaged or foreign file, or another run in ``config.out``.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    console = console or Console()
    seed = config.loop.seed
    dynamics = load_model(config.dynamics, LayerDynamics, environment="desk")
    perception = dynamics.config.perception
    model_config = dataclasses.replace(
        config.model,
        image_size=perception.image_size,
        action_dim=perception.arm.action_dim,
        sliders=perception.sliders,
        roaming=perception.roaming,
    )
    held_out = EpisodePool(config.data, "validation", environment="desk", seed=seed)
    held_out.move_to(0)
    training = held_out.metadata.episodes - len(held_out)
    episodes = min(config.episodes, training)
    tracks = LayerTracks(config.data, dynamics.perception, episodes, console=console)
    return train(
        seeded(seed, lambda: LayerGenerator(model_config)),
        StatePairs(tracks, config.batch_size, seed),
        config.loop,
        config.out,
        environment="desk",
        run={
            "command": "hvf train desk-generator",
            "episodes": config.episodes,
            "batch_size": config.batch_size,
            "data": dataclasses.asdict(held_out.metadata),
        },
        validate=lambda model, generator: validate_layers_generator(
            model, dynamics, held_out, generator
        ),
        console=console,
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
