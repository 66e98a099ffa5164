"""Training the layers dynamics: what needs no gradient, the arm, then the cell."""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.data.formats import open_episodes
from hvf.data.loader import EpisodePool, WindowSampler
from hvf.images import frame_grid
from hvf.models.checkpoint import load_model
from hvf.models.frames import to_frames, to_unit
from hvf.models.image_quality import image_psnr
from hvf.models.layers.dynamics import LayerDynamics, LayerDynamicsConfig
from hvf.models.layers.perception import LayerPerception
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData
from hvf.training.state import fitted
from hvf.training.tracks.kept import checksum, refuse_unequal
from hvf.training.tracks.layers import PUSHED_SHARE, SLID_SHARE, LayerSampler, LayerTracks

# Colours are found in this many pairs of frames, ten steps apart.
_PAIRS = 3000
_APART = 10
# Backdrop and sprites are taken from every tenth frame of the pool.
_STRIDE = 10
_GALLERY_STRIDE = 4
# Validation: windows of this many steps from each held-out episode, and how many are drawn.
_HORIZON = 15
_SHOWN = 10
_AT_ONCE = 64

_ARM_LOOP = LoopConfig(
    steps=3000,
    learning_rate=2e-3,
    schedule="cosine",
    warmup_steps=100,
    clip_norm=1.0,
    channels_last=False,  # torch refuses it for the backdrop's five dimensions
    precision="float32",
    validate_every=1000,
    checkpoint_every=500,
    threads=1,
)
# Positions in pixels need all of float32's digits, on a GPU too.
_LOOP = LoopConfig(
    steps=11_000,
    learning_rate=2e-3,
    schedule="cosine",
    warmup_steps=200,
    clip_norm=5.0,
    channels_last=False,
    precision="float32",
    validate_every=2000,
    checkpoint_every=1000,
    threads=1,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LayersRecipe(Recipe):
    """Training of the layers dynamics, for an arm and coloured parts before a still camera.

    Preset ``large`` is a size for a GPU.

    Attributes:
        episodes: episodes that the cell learns from, at most.
        memory_gb: memory for decoded frames while perception is trained.
        arm_batch: pairs of frames per step while the arm is trained.
        windows: stretches of states per step while the cell is trained.
        length: steps in a stretch.
        short_steps: the first of the cell's steps see more and shorter stretches.
        pushed: share of the stretches in which a part is pushed.
        perception: trained layers dynamics whose perception is taken over, so that only the cell is
            trained.
        model: the networks. Their widths in pixels are for images of one size, so the size of
            images is not taken from the data.
        arm_loop: how to optimise encoder and drawing of the arm.
        loop: how to optimise the cell.
    """

    name: ClassVar[str] = "layers"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "large": {
            "episodes": 9000,
            "memory_gb": 8.0,
            "arm_batch": 256,
            "windows": 1024,
            "short_steps": 40_000,
            "model.perception.arm": {
                "channels": (32, 64, 64, 128),
                "hidden": 512,
                "features": 256,
                "patch_rank": 48,
            },
            "model.cell": {"hand_hidden": 64, "part_hidden": 256, "memory": 8},
            "arm_loop": {"steps": 20_000, "threads": 0},
            "loop": {"steps": 60_000, "threads": 0},
        }
    }

    episodes: int = 9500
    memory_gb: float = 2.0
    arm_batch: int = 48
    windows: int = 128
    length: int = 15
    short_steps: int = 7500
    pushed: float = PUSHED_SHARE
    perception: Path | None = None
    model: LayerDynamicsConfig = LayerDynamicsConfig()
    arm_loop: LoopConfig = _ARM_LOOP
    loop: LoopConfig = _LOOP

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("episodes", "arm_batch", "windows", "length")
        if not 0 <= self.pushed <= 1 - SLID_SHARE:
            raise ValueError(f"pushed must be from 0 to {1 - SLID_SHARE:.2f}, got {self.pushed}")
        self.positive("memory_gb")

    def stages(self, data: TrainingData) -> Stages:
        """What needs no gradient and the arm; the gallery of its images; then the cell.

        What is fitted is kept in the run's folder and read from there when the run goes on.
        """
        seed, config = self.loop.seed, self.model
        if self.perception is None:
            self.check(data, config)
            settings = self._arm_settings
            perception = yield from self._arm(data)
        else:
            given = load_model(self.perception, LayerDynamics, environment=data.environment)
            perception = given.perception
            config = dataclasses.replace(config, perception=perception.config)
            self.check(data, config)
            settings = {"perception": checksum(perception)}
        with torch.inference_mode():
            seen = torch.from_numpy(data.held_out.frames[:, 0]).to(perception.sprites.device)
            perception.check(seen)
        model = seeded(seed, lambda: LayerDynamics(config)).freeze_perception(perception)
        episodes = min(self.episodes, data.training)
        tracks = LayerTracks(
            data.path, perception, episodes, console=data.console, camera=data.camera
        )
        model.fit_contact(*map(torch.from_numpy, tracks.contacts()))
        yield Stage(
            model,
            LayerSampler(tracks, self.windows, self.length, self.short_steps, seed, self.pushed),
            self.loop,
            "cell: how hand, sliders and parts move",
            settings={
                **settings,
                "episodes": self.episodes,
                "windows": self.windows,
                "length": self.length,
                "short_steps": self.short_steps,
                "pushed": self.pushed,
            },
            validate=lambda trained, _: validate_layers(trained, data.held_out),
        )

    @property
    def _arm_settings(self) -> dict[str, Any]:
        """What else the perception is a function of."""
        return {
            "memory_gb": self.memory_gb,
            "arm_batch": self.arm_batch,
            "arm_steps": self.arm_loop.steps,
        }

    def _arm(self, data: TrainingData) -> Generator[Stage, Any, LayerPerception]:
        """Perception, fitted and trained."""
        seed = self.loop.seed
        pool = data.pool(self.memory_gb)
        perception: LayerPerception = yield Stage(
            self._fit_perception(data, pool),
            WindowSampler(pool, self.arm_batch, 1, seed),
            self.arm_loop,
            "arm: what an action moves, and what that looks like",
            folder="perception",
            settings={"memory_gb": self.memory_gb, "arm_batch": self.arm_batch},
            validate=lambda model, _: validate_arm(model, data.held_out),
        )
        self._fit_gallery(data, pool, perception)
        pool.close()
        return perception

    def check(self, data: TrainingData, model: LayerDynamicsConfig) -> None:
        """Refuse data that ``model`` cannot be trained on.

        Raises:
            ValueError: images or actions of other sizes, or episodes that are too short.
        """
        with open_episodes(data.path) as file:
            refuse_unequal(file)
        config, steps = model.perception, data.metadata.steps
        size = (config.image_size, config.image_size)
        if self.length > steps:
            raise ValueError(f"length must be from 1 to {steps} for {data.path}, got {self.length}")
        if data.image_size != size:
            raise ValueError(f"{data.path}: frames are {data.image_size}, the model takes {size}")
        if data.action_dim != config.arm.action_dim:
            raise ValueError(
                f"{data.path}: actions have {data.action_dim} dimensions, "
                f"the model's {config.arm.action_dim}"
            )

    def _fit_perception(self, data: TrainingData, pool: EpisodePool) -> LayerPerception:
        """Colours, sliders, backdrop and sprites, before the arm is trained."""
        seed = self.loop.seed

        def fit(model: LayerPerception) -> None:
            with data.phase("parts and backdrop: colours of what changes, and what is behind"):
                pool.move_to(0)
                frames = torch.from_numpy(np.ascontiguousarray(pool.frames[:, ::_STRIDE]))
                with torch.inference_mode():
                    model.fit(_pairs(pool, seed), frames, seed)

        return fitted(
            self.folder / "perception" / "fitted.safetensors",
            seeded(seed, lambda: LayerPerception(self.model.perception)),
            self._identity(data),
            fit,
        )

    def _fit_gallery(
        self, data: TrainingData, pool: EpisodePool, perception: LayerPerception
    ) -> None:
        """Images of the arm, once its encoder is trained."""

        def fit(model: LayerPerception) -> None:
            with data.phase("gallery: images of the arm"):
                # The same frames, however often the training was stopped.
                pool.move_to(0)
                with torch.inference_mode():
                    model.fit_gallery(
                        torch.from_numpy(pool.frames[:, ::_GALLERY_STRIDE]).flatten(0, 1)
                    )

        fitted(
            self.folder / "perception" / "gallery.safetensors",
            perception,
            {**self._identity(data), "perception": checksum(perception)},
            fit,
        )

    def _identity(self, data: TrainingData) -> dict[str, Any]:
        """What is fitted is a function of this."""
        return {
            "data": dataclasses.asdict(data.metadata),
            "model": dataclasses.asdict(self.model.perception),
            "memory_gb": self.memory_gb,
            "seed": self.loop.seed,
        }


def _pairs(pool: EpisodePool, seed: int) -> torch.Tensor:
    """Pairs of frames that ``pool`` holds, uint8 ``[M, 2, S, S, 3]``."""
    rng = np.random.default_rng([seed, len(pool)])
    apart = min(_APART, pool.metadata.steps)
    episode = rng.integers(len(pool), size=_PAIRS)
    time = rng.integers(pool.metadata.steps + 1 - apart, size=_PAIRS)
    both = [pool.frames[episode, time], pool.frames[episode, time + apart]]
    return torch.from_numpy(np.stack(both, axis=1))


def validate_arm(model: LayerPerception, held_out: EpisodePool) -> Validation:
    """How much of held-out actions the codes show, and how far codes go when they should not.

    ``moved`` is the mean motion along an action as a part of the action, ``back`` the mean motion
    against it, ``beyond`` that beyond it, in full actions; one number per action dimension.
    The rows of the picture: true frames, and what is sketched of them.
    """
    device = model.sprites.device
    hand = model.config.arm.action_dim
    episodes = [model.observe(torch.from_numpy(x).to(device)) for x in held_out.frames[:50]]
    states = torch.stack(episodes).cpu()
    code = states[..., :hand]
    actions = torch.from_numpy(held_out.actions[:50])
    along = (code[:, 1:] - code[:, :-1]) * actions.sign()
    ratio = along.mean(dim=(0, 1)) / actions.abs().mean(dim=(0, 1))
    back = (-along).clamp_min(0).mean(dim=(0, 1))
    beyond = (along - actions.abs()).clamp_min(0).mean(dim=(0, 1))
    metrics: dict[str, float] = {}
    for i in range(actions.shape[2]):
        metrics |= {
            f"moved_{i}": float(ratio[i]),
            f"back_{i}": float(back[i]),
            f"beyond_{i}": float(beyond[i]),
        }
    frames = torch.from_numpy(held_out.frames[:50, :: 2 * _STRIDE]).flatten(0, 1)
    shown = torch.arange(0, len(frames), max(1, len(frames) // _SHOWN))[:_SHOWN]
    scenes = model.scene(frames[shown].to(device))
    opacity, colour = model.arm.sketch(scenes.states[:, :hand])
    drawn = (scenes.image * (1 - opacity.clamp(0, 1)) + colour).clamp(0, 1)
    rows = [frames[shown].numpy(), to_frames(drawn).cpu().numpy()]
    return Validation(metrics, {"sketched": frame_grid(rows, zoom=2)})


def validate_layers(model: LayerDynamics, held_out: EpisodePool) -> Validation:
    """Error of predicted states and frames 15 steps ahead on held-out episodes.

    All windows of 15 steps that do not overlap are measured. Parts in pixels (mean distance of
    their middles, over those of them that are seen whole at both ends and moved by more than 2
    pixels, beside the distance that they moved), ``gone`` how often a part's presence is right
    where it was lost or moved, sliders as a part of their way, where they moved by a twentieth,
    the hand in full actions, frames as PSNR. What no window shows is left out.
    The rows of the picture: start frames, true frames, predicted frames.
    """
    perception = model.perception
    device = perception.sprites.device
    steps = held_out.actions.shape[1]
    horizon = min(_HORIZON, steps)
    starts = np.arange(0, steps - horizon + 1, horizon)
    first = torch.from_numpy(held_out.frames[:, starts]).flatten(0, 1)
    last = torch.from_numpy(held_out.frames[:, starts + horizon]).flatten(0, 1)
    before, mass_before = perception.look(first.to(device))
    truth, mass_after = perception.look(last.to(device))
    index = starts[:, None] + np.arange(horizon)
    actions = torch.from_numpy(held_out.actions[:, index]).flatten(0, 1).to(device)
    path = model.rollout(before, actions, last=True)[:, 0]
    _, slid_from, was = perception.split(before)
    hand_now, slid_to, now = perception.split(truth)
    hand, slid, guess = perception.split(path)
    whole = (mass_before > 0.65) & (mass_after > 0.65)
    went = (now - was)[..., :2].norm(dim=2)
    error = (guess - now)[..., :2].norm(dim=2)
    moved = whole & (went > 2.0)
    slides = (slid_to - slid_from).abs()
    measured = {
        "hand": (hand - hand_now).norm(dim=1),
        "moved_parts": error[moved],
        "moved_still": went[moved],
        "still_parts": error[whole & (went < 1.0)],
    }
    for i in range(slides.shape[1]):
        slid_far = slides[:, i] > 0.05
        measured[f"slider_{i}"] = (slid - slid_to)[slid_far, i].abs()
        measured[f"slider_{i}_still"] = slides[slid_far, i]
    metrics = {name: float(values.mean()) for name, values in measured.items() if len(values)}
    drawn = torch.cat(
        [
            perception.draw(perception.scene(some.to(device)), states).cpu()
            for some, states in zip(
                torch.split(first, _AT_ONCE), torch.split(path, _AT_ONCE), strict=True
            )
        ]
    )
    metrics["psnr"] = float(image_psnr(drawn, to_unit(last)).mean())
    each = max(1, len(first) // _SHOWN)
    shown = torch.arange(0, len(first), each)[:_SHOWN]
    rows: list[NDArray[np.uint8]] = [
        first[shown].numpy(),
        last[shown].numpy(),
        to_frames(drawn[shown]).numpy(),
    ]
    return Validation(metrics, {"predictions": frame_grid(rows, zoom=2)})
