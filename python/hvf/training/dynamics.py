"""Training the compact dynamics model: perception from pairs of frames, then the cell."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from hvf.data.loader import EpisodePool, PairSampler
from hvf.models.frames import to_frames, to_unit
from hvf.models.keypoint_dynamics import DynamicsConfig, KeypointDynamics
from hvf.models.keypoint_perception import KeypointPerception
from hvf.training.loop import LoopConfig, Validation, seeded, train
from hvf.training.pictures import frame_grid
from hvf.training.transitions import Transitions, TransitionSampler

# Validation: windows of this many steps from each held-out episode, and how many are drawn.
_HORIZON = 5
_SHOWN = 10


@dataclasses.dataclass(frozen=True)
class DynamicsTraining:
    """Training of the compact dynamics model.

    Attributes:
        data: file of episodes (``hvf collect maze``).
        out: directory of the run; a run that is already there is continued.
        episodes: episodes whose transitions train the cell.
        pairs: pairs of images per step while perception is trained.
        scenes: scenes per step while the cell is trained.
        transitions: transitions per scene and step.
        hard_fraction: transitions that the first pass predicts worst and the second draws more.
        hard_share: share of each scene's transitions that the second pass draws from these.
        model: the network.
        perception_loop: how to optimise perception.
        first_loop: how to optimise the cell in the first pass.
        loop: how to optimise it in the second.
    """

    data: Path
    out: Path = Path("runs/dynamics")
    episodes: int = 3000
    pairs: int = 32
    scenes: int = 32
    transitions: int = 64
    hard_fraction: float = 0.05
    hard_share: float = 0.125
    model: DynamicsConfig = DynamicsConfig()
    perception_loop: LoopConfig = LoopConfig(
        steps=800,
        learning_rate=8e-3,
        schedule="cosine",
        validate_every=400,
        checkpoint_every=200,
        threads=1,
    )
    first_loop: LoopConfig = LoopConfig(
        steps=3000,
        learning_rate=3e-3,
        schedule="cosine",
        warmup_steps=200,
        validate_every=1500,
        checkpoint_every=1000,
        threads=1,
    )
    loop: LoopConfig = LoopConfig(
        steps=20_000,
        learning_rate=3e-3,
        schedule="cosine",
        warmup_steps=200,
        validate_every=5000,
        checkpoint_every=1000,
        threads=1,
    )

    def __post_init__(self) -> None:
        for name in ("episodes", "pairs", "scenes", "transitions"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("hard_fraction", "hard_share"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")


def train_dynamics(config: DynamicsTraining, console: Console | None = None) -> KeypointDynamics:
    """Train perception and cell, or go on with the run in ``config.out``.

    Raises:
        FileNotFoundError: no data file.
        ValueError: a damaged or foreign data file, frames of another size than the model's, or
            another run in ``config.out``.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    console = console or Console()
    seed = config.loop.seed
    held_out = EpisodePool(config.data, "validation", environment="maze", seed=seed)
    held_out.move_to(0)
    pool = EpisodePool(config.data, environment="maze", memory_gb=0.5, seed=seed)
    run: dict[str, Any] = {
        "command": "hvf train dynamics",
        "data": dataclasses.asdict(pool.metadata),
    }
    size = config.model.perception.image_size
    if pool.frames.shape[2:4] != (size, size):
        raise ValueError(
            f"{config.data}: frames are {pool.frames.shape[2:4]}, the model takes {(size, size)}"
        )
    console.print("perception: mask, keypoint and sprite from pairs of frames")
    perception = train(
        seeded(seed, lambda: KeypointPerception(config.model.perception)),
        PairSampler(pool, config.pairs, seed),
        config.perception_loop,
        config.out / "perception",
        environment="maze",
        run={**run, "pairs": config.pairs},
        validate=lambda model, _: validate_perception(model, held_out),
        console=console,
    )
    pool.close()
    model = seeded(seed, lambda: KeypointDynamics(config.model)).freeze_perception(perception)
    console.print("cell: how actions move the keypoint")
    training = pool.metadata.episodes - len(held_out)
    data = Transitions(config.data, model, min(config.episodes, training), console=console)
    model.fit_scene_basis(torch.from_numpy(data.pooled[:, 0]))
    run = {
        **run,
        "episodes": config.episodes,
        "scenes": config.scenes,
        "transitions": config.transitions,
        "perception_steps": config.perception_loop.steps,
    }
    console.print("cell, first pass: transitions drawn uniformly")
    model = train(
        model,
        TransitionSampler(data, config.scenes, config.transitions, seed),
        config.first_loop,
        config.out / "first_pass",
        environment="maze",
        run=run,
        validate=lambda trained, _: validate_dynamics(trained, held_out),
        console=console,
    )
    # Passing a gap is 2% of random play and unlike the rest: drawn uniformly, it is not learned.
    hard = data.hardest(model, config.hard_fraction)
    console.print("cell, second pass: more of the transitions that were predicted worst")
    return train(
        model,
        TransitionSampler(
            data, config.scenes, config.transitions, seed + 1, hard, config.hard_share
        ),
        config.loop,
        config.out,
        environment="maze",
        run={
            **run,
            "first_steps": config.first_loop.steps,
            "hard_fraction": config.hard_fraction,
            "hard_share": config.hard_share,
        },
        validate=lambda trained, _: validate_dynamics(trained, held_out),
        console=console,
    )


def validate_perception(model: KeypointPerception, held_out: EpisodePool) -> Validation:
    """Unexplained part of the difference between held-out frames ten steps apart, and a picture.

    The rows of the picture: frames, masks, and the frames with the sprite taken away.
    """
    frames = torch.from_numpy(held_out.frames[:64, [0, 10]]).to(model.colour.device)
    images = to_unit(frames.flatten(0, 1))
    mask = model.motion_mask(images)
    pixels = model.centroid(mask)
    background = model.background(images, pixels)
    pairs = background.reshape(-1, 2, *background.shape[1:])
    difference = images.reshape(-1, 2, *images.shape[1:])
    unexplained = (pairs[:, 0] - pairs[:, 1]).square().sum() / (
        (difference[:, 0] - difference[:, 1]).square().sum().clamp_min(1e-9)
    )
    metrics = {
        "unexplained": float(unexplained),
        "sprite_height": float(2 * model.half_size[0]),
        "sprite_width": float(2 * model.half_size[1]),
    }
    masks = mask[:_SHOWN, None].expand(-1, 3, -1, -1)
    rows = [to_frames(row).cpu().numpy() for row in (images[:_SHOWN], masks, background[:_SHOWN])]
    return Validation(metrics, {"perception": frame_grid(rows, zoom=2)})


def validate_dynamics(model: KeypointDynamics, held_out: EpisodePool) -> Validation:
    """Error of predicted keypoints 1 and 5 steps ahead on held-out episodes, and a picture.

    All windows of 5 steps that do not overlap are measured, in pixels, against the keypoints that
    perception finds in the true frames. The rows of the picture: true frames, predicted frames.
    """
    device = next(model.parameters()).device
    frames = held_out.frames
    episodes, steps = held_out.actions.shape[:2]
    starts = np.arange(0, steps - _HORIZON + 1, _HORIZON)
    every = torch.from_numpy(frames[:, ::_HORIZON]).flatten(0, 1)
    observed = [model.observe(part.to(device)) for part in torch.split(every, 512)]
    keypoints = torch.cat([k for k, _ in observed]).reshape(episodes, -1, 2)
    codes = torch.cat([c for _, c in observed]).reshape(episodes, keypoints.shape[1], -1)
    windows = len(starts)
    index = starts[:, None] + np.arange(_HORIZON)
    actions = torch.from_numpy(held_out.actions[:, index]).flatten(0, 1).to(device)
    path = model.rollout(
        keypoints[:, :windows].flatten(0, 1), codes[:, :windows].flatten(0, 1), actions
    )
    ends = keypoints[:, 1 : windows + 1].flatten(0, 1)
    first = torch.from_numpy(frames[:, starts + 1]).flatten(0, 1)
    after_one = torch.cat([model.observe(part.to(device))[0] for part in torch.split(first, 512)])
    one = (model.to_pixels(path[:, 0]) - model.to_pixels(after_one)).norm(dim=1)
    five = (model.to_pixels(path[:, -1]) - model.to_pixels(ends)).norm(dim=1)
    metrics = {
        "pixels_1_median": float(one.median()),
        "pixels_1_95": float(one.quantile(0.95)),
        "pixels_5_median": float(five.median()),
        "pixels_5_mean": float(five.mean()),
        "pixels_5_over_2.5": float((five > 2.5).float().mean()),
    }
    shown = np.arange(_SHOWN) * windows
    images = to_unit(torch.from_numpy(frames[:_SHOWN, 0]).to(device))
    drawn = model.draw(images, keypoints[:_SHOWN, 0], path[shown, -1])
    rows = [frames[:_SHOWN, 0], frames[:_SHOWN, _HORIZON], to_frames(drawn).cpu().numpy()]
    return Validation(metrics, {"predictions": frame_grid(rows, zoom=2)})
