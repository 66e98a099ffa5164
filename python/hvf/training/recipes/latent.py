"""Training the latent model: dynamics from coefficients of frames, then the decoder."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch

from hvf.data.loader import EpisodePool, PairSampler
from hvf.images import frame_grid
from hvf.models.frames import to_frames, to_unit
from hvf.models.latent.config import LatentConfig
from hvf.models.latent.dynamics import LatentDynamics
from hvf.models.latent.model import LatentModel
from hvf.models.video import State
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData
from hvf.training.state import fitted
from hvf.training.tracks.coefficients import Coefficients, CoefficientWindows, fit_basis
from hvf.training.tracks.kept import checksum

# Validation: steps ahead, and how many frames a picture shows.
_HORIZON = 5
_SHOWN = 10
# What of the model's settings its components depend on.
_OF_BASIS = ("image_size", "blur", "cell", "components")


@dataclasses.dataclass(frozen=True, kw_only=True)
class LatentRecipe(Recipe):
    """Training of the latent model, on any episodes.

    Preset ``desk`` has sizes for a scene of an arm and several objects.

    Attributes:
        episodes: episodes to learn from, at most.
        batch_size: stretches of frames per step while the dynamics are trained.
        length: predicted frames of a stretch.
        pairs: pairs of frames per step while the decoder is trained.
        memory_gb: memory for decoded frames while the decoder is trained.
        model: the network; sizes of images and the box of actions are the data's, and so is
            ``hold`` where the data says that actions are held.
        loop: how to optimise the dynamics.
        decoder_loop: how to optimise the decoder.
    """

    name: ClassVar[str] = "latent"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "desk": {
            "model": {"state": 64, "components": 192, "dynamics_width": 192, "readout_width": 384},
            "length": 4,
            "loop": {"steps": 14_000},
        },
    }

    episodes: int = 100_000
    batch_size: int = 256
    length: int = 3
    pairs: int = 16
    memory_gb: float = 1.0
    model: LatentConfig = LatentConfig()
    # Positions within a blurred frame are small differences: all of float32's digits.
    loop: LoopConfig = LoopConfig(
        steps=50_000,
        learning_rate=2e-3,
        schedule="cosine",
        warmup_steps=200,
        weight_decay=1e-4,
        clip_norm=1.0,
        precision="float32",
        validate_every=2000,
        checkpoint_every=1000,
        threads=1,
    )
    decoder_loop: LoopConfig = LoopConfig(
        steps=2000,
        learning_rate=2e-3,
        schedule="cosine",
        warmup_steps=100,
        precision="float32",
        validate_every=500,
        checkpoint_every=250,
        threads=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("episodes", "batch_size", "length", "pairs")

    def stages(self, data: TrainingData) -> Stages:
        """Dynamics from coefficients of frames, then the decoder."""
        seed = self.loop.seed
        config = self.fitting(data)
        dynamics = seeded(seed, lambda: LatentDynamics(config))
        episodes = min(self.episodes, data.training)
        fitted(
            self.folder / "basis.safetensors",
            dynamics.basis,
            {
                "data": dataclasses.asdict(data.metadata),
                "camera": data.camera,
                "episodes": episodes,
                "model": {name: getattr(config, name) for name in _OF_BASIS},
            },
            lambda basis: fit_basis(data.path, basis, episodes, data.console, data.camera),
        )
        found = Coefficients(data.path, dynamics.basis, episodes, data.console, data.camera)
        settings = {
            "episodes": self.episodes,
            "batch_size": self.batch_size,
            "length": self.length,
            "basis": checksum(dynamics.basis),
        }
        trained = yield Stage(
            dynamics,
            CoefficientWindows(found, self.batch_size, self.length, config.hold, seed),
            self.loop,
            "dynamics: states, and how actions move them",
            folder="dynamics",
            settings=settings,
            validate=lambda model, _: validate_dynamics(model, data.held_out),
        )
        model = seeded(seed, lambda: LatentModel(config)).with_dynamics(trained)
        yield Stage(
            model,
            PairSampler(data.pool(self.memory_gb), self.pairs, seed),
            self.decoder_loop,
            "decoder: what states look like",
            settings={
                **settings,
                "pairs": self.pairs,
                "memory_gb": self.memory_gb,
                "dynamics": checksum(trained),
            },
            validate=lambda model, _: validate_pictures(model, data.held_out),
        )

    def fitting(self, data: TrainingData) -> LatentConfig:
        """The model's config, of the data's sizes.

        Raises:
            ValueError: images or episodes that the model cannot take.
        """
        return data.fitted_to_held(self.model, "the latent model cannot take it")


def validate_dynamics(model: LatentDynamics, held_out: EpisodePool) -> Validation:
    """Error of read-outs 0, 1 and 5 steps ahead on held-out episodes, as a part of the variance.

    ``still_5`` is the error of "nothing moves". Stretches do not overlap. The rows of the picture:
    true blurred frames, predicted ones.
    """
    device = model.basis.mean.device
    hold = model.hold
    steps = min(_HORIZON, int(held_out.lengths.max()) // hold)
    errors = torch.zeros(steps + 1, dtype=torch.float64)
    still = torch.zeros((), dtype=torch.float64)
    count = 0
    rows: list[torch.Tensor] = []
    for frames, actions, length in zip(
        held_out.frames, held_out.actions, held_out.lengths, strict=True
    ):
        starts = np.arange(0, length - steps * hold + 1, steps * hold)
        if not len(starts):
            continue
        times = starts[:, None] + np.arange(steps + 1) * hold
        images = to_unit(torch.from_numpy(frames[times]).flatten(0, 1).to(device))
        truth = model.basis(images).reshape(*times.shape, -1)
        done = torch.from_numpy(actions[times[:, :-1]]).to(device)
        state: State = (model.encoder(truth[:, 0]),)
        for h in range(steps + 1):
            found = model.read(state[0])
            errors[h] += model.basis.error(found, truth[:, h]).sum().cpu()
            if h < steps:
                state = model.step(state, done[:, h], None)
        still += model.basis.error(truth[:, 0], truth[:, -1]).sum().cpu()
        count += len(starts)
        if len(rows) < _SHOWN:
            rows.append(torch.stack([truth[0, 0], truth[0, -1], found[0]]))
    errors, still = errors / count, still / count
    shown = to_frames(model.basis.frames(torch.cat(rows))).cpu().numpy()
    pictures = [shown[i::3] for i in range(3)]
    metrics = {
        "error_0": float(errors[0]),
        "error_1": float(errors[1]),
        f"error_{steps}": float(errors[-1]),
        f"still_{steps}": float(still),
    }
    return Validation(metrics, {"predictions": frame_grid(pictures, zoom=6)})


def validate_pictures(model: LatentModel, held_out: EpisodePool) -> Validation:
    """Squared error of drawn predictions 5 steps ahead (mean over values in [0, 1]), and a picture.

    The rows of the picture: first frames, true frames 5 steps later, predicted ones.
    """
    device = model.basis.mean.device
    hold = model.hold
    steps = min(_HORIZON, int(held_out.lengths.max()) // hold)
    enough = np.flatnonzero(held_out.lengths >= steps * hold)[:100]
    first, last = (
        to_unit(torch.from_numpy(held_out.frames[enough, time]).to(device))
        for time in (0, steps * hold)
    )
    done = torch.from_numpy(held_out.actions[enough, : steps * hold : hold]).to(device)
    state = model.start(first[:, None], done[:, :0])
    for h in range(steps):
        state = model.step(state, done[:, h], None)
    drawn = model.images(state)
    metrics = {
        "mse": float((drawn - last).square().mean()),
        "still_mse": float((first - last).square().mean()),
    }
    rows = [to_frames(part[:_SHOWN]).cpu().numpy() for part in (first, last, drawn)]
    return Validation(metrics, {"predictions": frame_grid(rows, zoom=2)})
