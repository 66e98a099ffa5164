"""Training the compact dynamics of the desk: what needs no gradient, the arm, then the cell."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from hvf.data.loader import EpisodePool, WindowSampler
from hvf.images import frame_grid
from hvf.models.frames import to_frames, to_unit
from hvf.models.layers.arm import ArmConfig
from hvf.models.layers.cell import CellConfig
from hvf.models.layers.dynamics import LayerDynamics, LayerDynamicsConfig
from hvf.models.layers.perception import LayerPerception, LayerPerceptionConfig
from hvf.training.loop import LoopConfig, Validation, seeded, train
from hvf.training.tracks.layers import LayerSampler, LayerTracks

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


_LARGE = LayerDynamicsConfig(
    perception=LayerPerceptionConfig(
        arm=ArmConfig(channels=(32, 64, 64, 128), hidden=512, features=256, patch_rank=48)
    ),
    cell=CellConfig(hand_hidden=64, part_hidden=256, memory=8),
)


@dataclasses.dataclass(frozen=True)
class LayersTraining:
    """Training of the compact dynamics of the desk.

    Attributes:
        data: file of episodes (``hvf collect desk``).
        out: directory of the run; a run that is already there is continued.
        episodes: episodes that the cell learns from, at most.
        memory_gb: memory for decoded frames while perception is trained.
        arm_batch: pairs of frames per step while the arm is trained.
        windows: stretches of states per step while the cell is trained.
        length: steps in a stretch.
        short_steps: the first of the cell's steps see more and shorter stretches.
        model: the networks.
        arm_loop: how to optimise encoder and drawing of the arm.
        loop: how to optimise the cell.
    """

    data: Path
    out: Path = Path("runs/desk_dynamics")
    episodes: int = 9500
    memory_gb: float = 2.0
    arm_batch: int = 48
    windows: int = 128
    length: int = 15
    short_steps: int = 7500
    model: LayerDynamicsConfig = LayerDynamicsConfig()
    arm_loop: LoopConfig = _ARM_LOOP
    loop: LoopConfig = _LOOP

    def __post_init__(self) -> None:
        for name in ("episodes", "arm_batch", "windows", "length"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not (math.isfinite(self.memory_gb) and self.memory_gb > 0):
            raise ValueError(f"memory_gb must be positive, got {self.memory_gb}")


@dataclasses.dataclass(frozen=True)
class LargeLayersTraining(LayersTraining):
    """Training at a size for a GPU; see :class:`LayersTraining`."""

    out: Path = Path("runs/desk_dynamics_large")
    episodes: int = 9000
    memory_gb: float = 8.0
    arm_batch: int = 256
    windows: int = 1024
    short_steps: int = 40_000
    model: LayerDynamicsConfig = _LARGE
    arm_loop: LoopConfig = dataclasses.replace(_ARM_LOOP, steps=20_000, threads=0)
    loop: LoopConfig = dataclasses.replace(_LOOP, steps=60_000, threads=0)


def train_layers(config: LayersTraining, console: Console | None = None) -> LayerDynamics:
    """Train perception and cell, or go on with the run in ``config.out``.

    Raises:
        FileNotFoundError: no data file.
        ValueError: a damaged or foreign data file, frames of another size than the model's, or
            another run in ``config.out``.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    console = console or Console()
    seed = config.loop.seed
    held_out = EpisodePool(config.data, "validation", environment="desk", seed=seed)
    held_out.move_to(0)
    run: dict[str, Any] = {
        "command": "hvf train desk-dynamics",
        "data": dataclasses.asdict(held_out.metadata),
        "memory_gb": config.memory_gb,
        "arm_batch": config.arm_batch,
    }
    perception = _train_perception(config, held_out, run, console)
    console.print("cell: how hand, sliders and parts move")
    model = seeded(seed, lambda: LayerDynamics(config.model)).freeze_perception(perception)
    training = held_out.metadata.episodes - len(held_out)
    tracks = LayerTracks(config.data, perception, min(config.episodes, training), console=console)
    model.fit_contact(*map(torch.from_numpy, tracks.contacts()))
    return train(
        model,
        LayerSampler(tracks, config.windows, config.length, config.short_steps, seed),
        config.loop,
        config.out,
        environment="desk",
        run={
            **run,
            **{
                name: getattr(config, name)
                for name in ("episodes", "windows", "length", "short_steps")
            },
            "arm_steps": config.arm_loop.steps,
        },
        validate=lambda trained, _: validate_layers(trained, held_out),
        console=console,
    )


def _train_perception(
    config: LayersTraining, held_out: EpisodePool, run: dict[str, Any], console: Console
) -> LayerPerception:
    seed, size = config.loop.seed, config.model.perception.image_size
    if config.length > held_out.metadata.steps:
        raise ValueError(
            f"length must be from 1 to {held_out.metadata.steps} for {config.data}, "
            f"got {config.length}"
        )
    pool = EpisodePool(config.data, environment="desk", memory_gb=config.memory_gb, seed=seed)
    if pool.frames.shape[2:4] != (size, size):
        raise ValueError(
            f"{config.data}: frames are {pool.frames.shape[2:4]}, the model takes {(size, size)}"
        )
    if pool.actions.shape[2] != config.model.perception.arm.action_dim:
        raise ValueError(
            f"{config.data}: actions have {pool.actions.shape[2]} dimensions, "
            f"the model's {config.model.perception.arm.action_dim}"
        )
    pool.move_to(0)
    perception = seeded(seed, lambda: LayerPerception(config.model.perception))
    console.print("parts and backdrop: colours of what changes, and what is behind")
    frames = torch.from_numpy(np.ascontiguousarray(pool.frames[:, ::_STRIDE]))
    with torch.inference_mode():
        perception.fit(_pairs(pool, seed), frames, seed)
    del frames
    console.print("arm: what an action moves, and what that looks like")
    trained = train(
        perception,
        WindowSampler(pool, config.arm_batch, 1, seed),
        config.arm_loop,
        config.out / "perception",
        environment="desk",
        run=run,
        validate=lambda model, _: validate_arm(model, held_out),
        console=console,
    )
    console.print("gallery: images of the arm")
    # The same frames, however often the training was stopped.
    pool.move_to(0)
    with torch.inference_mode():
        frames = torch.from_numpy(pool.frames[:, ::_GALLERY_STRIDE]).flatten(0, 1)
        trained.fit_gallery(frames)
    pool.close()
    return trained


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
    the hand in full actions, frames as PSNR. The rows of the picture: start frames, true frames,
    predicted frames.
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
    metrics = {
        "hand": float((hand - hand_now).norm(dim=1).mean()),
        "moved_parts": float(error[moved].mean()),
        "moved_still": float(went[moved].mean()),
        "still_parts": float(error[whole & (went < 1.0)].mean()),
    }
    for i in range(slides.shape[1]):
        slid_far = slides[:, i] > 0.05
        metrics[f"slider_{i}"] = float((slid - slid_to)[slid_far, i].abs().mean())
        metrics[f"slider_{i}_still"] = float(slides[slid_far, i].mean())
    drawn = torch.cat(
        [
            perception.draw(perception.scene(some.to(device)), states).cpu()
            for some, states in zip(
                torch.split(first, _AT_ONCE), torch.split(path, _AT_ONCE), strict=True
            )
        ]
    )
    metrics["psnr"] = _psnr(drawn, to_unit(last))
    each = max(1, len(first) // _SHOWN)
    shown = torch.arange(0, len(first), each)[:_SHOWN]
    rows: list[NDArray[np.uint8]] = [
        first[shown].numpy(),
        last[shown].numpy(),
        to_frames(drawn[shown]).numpy(),
    ]
    return Validation(metrics, {"predictions": frame_grid(rows, zoom=2)})


def _psnr(guess: torch.Tensor, truth: torch.Tensor) -> float:
    squared = (guess - truth).square().mean(dim=(1, 2, 3))
    return float(-10 * squared.clamp_min(1e-9).log10().mean())
