"""Training the compact dynamics of the desk: parts, then the hand, then cell and drawing."""

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
from hvf.models.frames import to_frames, to_unit
from hvf.models.hand import Hand, HandConfig
from hvf.models.parts import Parts
from hvf.models.parts_dynamics import PartsDynamics, PartsDynamicsConfig
from hvf.training.desk_states import DeskSampler, DeskStates
from hvf.training.loop import LoopConfig, Validation, seeded, train
from hvf.training.pictures import frame_grid

# Colours are found in this many pairs of frames, ten steps apart.
_PAIRS = 1500
_APART = 10
# The mean image is taken over every tenth frame of the pool.
_MEAN_STRIDE = 10
# Validation: windows of this many steps from each held-out episode, and how many are drawn.
_HORIZON = 15
_SHOWN = 10

_HAND_LOOP = LoopConfig(
    steps=4000,
    learning_rate=2e-3,
    schedule="cosine",
    warmup_steps=100,
    clip_norm=1.0,
    precision="float32",
    validate_every=1000,
    checkpoint_every=500,
    threads=1,
)
# Positions in pixels need all of float32's digits, on a GPU too.
_LOOP = LoopConfig(
    steps=12_000,
    learning_rate=2e-3,
    schedule="cosine",
    warmup_steps=200,
    clip_norm=5.0,
    precision="float32",
    validate_every=2000,
    checkpoint_every=1000,
    threads=1,
)


@dataclasses.dataclass(frozen=True)
class DeskDynamicsTraining:
    """Training of the compact dynamics of the desk.

    Attributes:
        data: file of episodes (``hvf collect desk``).
        out: directory of the run; a run that is already there is continued.
        episodes: episodes that cell and drawing learn from.
        memory_gb: memory for decoded frames while the hand is trained; keeping every third frame
            for the drawing takes 0.42 MB an episode more.
        hand_batch: pairs of frames per step while the hand is trained.
        windows: stretches of states per step while the cell is trained.
        length: steps in a stretch.
        pairs: pairs of frames per step while the drawing is trained.
        apart: most steps between them.
        model: the networks.
        hand_loop: how to optimise the hand's perception.
        loop: how to optimise cell and drawing.
    """

    data: Path
    out: Path = Path("runs/desk_dynamics")
    episodes: int = 6000
    memory_gb: float = 1.0
    hand_batch: int = 64
    windows: int = 128
    length: int = 15
    pairs: int = 48
    apart: int = 30
    model: PartsDynamicsConfig = PartsDynamicsConfig()
    hand_loop: LoopConfig = _HAND_LOOP
    loop: LoopConfig = _LOOP

    def __post_init__(self) -> None:
        for name in ("episodes", "hand_batch", "windows", "length", "pairs", "apart"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not (math.isfinite(self.memory_gb) and self.memory_gb > 0):
            raise ValueError(f"memory_gb must be positive, got {self.memory_gb}")


@dataclasses.dataclass(frozen=True)
class LargeDeskDynamicsTraining(DeskDynamicsTraining):
    """Training at a size for a GPU; see :class:`DeskDynamicsTraining`."""

    out: Path = Path("runs/desk_dynamics_large")
    episodes: int = 20_000
    memory_gb: float = 8.0
    hand_batch: int = 256
    windows: int = 1024
    pairs: int = 256
    model: PartsDynamicsConfig = PartsDynamicsConfig(
        hand=HandConfig(channels=(32, 64, 64, 128), hidden=512),
        hidden=256,
        memory=16,
        part_features=256,
        hand_features=512,
        patch_rank=64,
    )
    hand_loop: LoopConfig = dataclasses.replace(_HAND_LOOP, steps=20_000, threads=0)
    loop: LoopConfig = dataclasses.replace(_LOOP, steps=60_000, threads=0)


def train_desk_dynamics(
    config: DeskDynamicsTraining, console: Console | None = None
) -> PartsDynamics:
    """Train perception, cell and drawing, or go on with the run in ``config.out``.

    Raises:
        FileNotFoundError: no data file.
        ValueError: a damaged or foreign data file, frames of another size than the model's, or
            another run in ``config.out``.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    console = console or Console()
    seed = config.loop.seed
    held_out = EpisodePool(config.data, "validation", environment="desk", seed=seed)
    pool = EpisodePool(config.data, environment="desk", memory_gb=config.memory_gb, seed=seed)
    size = config.model.parts.image_size
    if pool.frames.shape[2:4] != (size, size):
        raise ValueError(
            f"{config.data}: frames are {pool.frames.shape[2:4]}, the model takes {(size, size)}"
        )
    if pool.actions.shape[2] != config.model.hand.action_dim:
        raise ValueError(
            f"{config.data}: actions have {pool.actions.shape[2]} dimensions, "
            f"the model's {config.model.hand.action_dim}"
        )
    held_out.move_to(0)
    pool.move_to(0)
    run: dict[str, Any] = {
        "command": "hvf train desk-dynamics",
        "data": dataclasses.asdict(pool.metadata),
        "memory_gb": config.memory_gb,
        "hand_batch": config.hand_batch,
    }
    console.print("parts: colours of what changes")
    parts = find_parts(Parts(config.model.parts), pool, seed)
    console.print("hand: what an action moves")
    frames = torch.from_numpy(pool.frames[:, ::_MEAN_STRIDE].reshape(-1, *pool.frames.shape[2:]))
    hand = train(
        seeded(seed, lambda: Hand(config.model.hand)).centre(frames),
        WindowSampler(pool, config.hand_batch, 1, seed),
        config.hand_loop,
        config.out / "hand",
        environment="desk",
        run=run,
        validate=lambda model, _: validate_hand(model, held_out),
        console=console,
    )
    training = pool.metadata.episodes - len(held_out)
    pool.close()
    del pool, frames
    console.print("cell and drawing: how hand and parts move, and what they look like")
    model = seeded(seed, lambda: PartsDynamics(config.model)).freeze_perception(parts, hand)
    data = DeskStates(config.data, model, min(config.episodes, training), console=console)
    model.fit_states(torch.from_numpy(data.states).flatten(0, 1))
    return train(
        model,
        DeskSampler(data, config.windows, config.length, config.pairs, config.apart, seed),
        config.loop,
        config.out,
        environment="desk",
        run={
            **run,
            **{
                name: getattr(config, name)
                for name in ("episodes", "windows", "length", "pairs", "apart")
            },
            "hand_steps": config.hand_loop.steps,
        },
        validate=lambda trained, _: validate_desk_dynamics(trained, held_out),
        console=console,
    )


def find_parts(parts: Parts, pool: EpisodePool, seed: int) -> Parts:
    """Fit ``parts`` to pairs of frames that ``pool`` holds."""
    rng = np.random.default_rng([seed, len(pool)])
    apart = min(_APART, pool.metadata.steps)
    episode = rng.integers(len(pool), size=_PAIRS)
    time = rng.integers(pool.metadata.steps + 1 - apart, size=_PAIRS)
    first, second = pool.frames[episode, time], pool.frames[episode, time + apart]
    return parts.fit(torch.from_numpy(first), torch.from_numpy(second), seed)


def validate_hand(model: Hand, held_out: EpisodePool) -> Validation:
    """How much of held-out actions the codes show, and how far codes go when they should not.

    ``moved`` is the mean motion along an action as a part of the action, ``back`` the mean motion
    against it, ``beyond`` that beyond it, in full actions; one number per action dimension.
    """
    code = _codes(model, held_out.frames[:50])
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
    return Validation(metrics)


def _codes(model: Hand, frames: NDArray[np.uint8]) -> torch.Tensor:
    device = model.mean_image.device
    parts = [model(torch.from_numpy(episode).to(device)) for episode in frames]
    return torch.stack(parts).cpu()


def validate_desk_dynamics(model: PartsDynamics, held_out: EpisodePool) -> Validation:
    """Error of predicted states and frames up to 15 steps ahead on held-out episodes.

    All windows of 15 steps that do not overlap are measured. Parts in pixels (mean distance of
    centres, over parts of which at least half the usual is seen, and over those of them that moved
    by more than 2 pixels, beside the distance that they moved), the hand in full actions, frames as
    PSNR. The rows of the picture: start frames, true frames, predicted frames.
    """
    device = model.state_mean.device
    steps = held_out.actions.shape[1]
    horizon = min(_HORIZON, steps)
    starts = np.arange(0, steps - horizon + 1, horizon)
    ends = starts + horizon
    count = len(held_out)
    first = torch.from_numpy(held_out.frames[:, starts]).flatten(0, 1)
    last = torch.from_numpy(held_out.frames[:, ends]).flatten(0, 1)
    before = torch.cat([model.observe(part.to(device)) for part in torch.split(first, 256)])
    truth = torch.cat([model.observe(part.to(device)) for part in torch.split(last, 256)])
    index = starts[:, None] + np.arange(horizon)
    actions = torch.from_numpy(held_out.actions[:, index]).flatten(0, 1).to(device)
    path = model.rollout(before, actions, last=True)[:, 0]
    size = 3 * model.config.parts.parts
    was, now, guess = (x[:, :size].reshape(len(x), -1, 3) for x in (before, truth, path))
    seen = (was[..., 0] > 0.5) & (now[..., 0] > 0.5)
    went = (now - was)[..., 1:].norm(dim=2)
    error = (guess - now)[..., 1:].norm(dim=2)
    moved = seen & (went > 2.0)
    squared = []
    for i in range(0, len(first), 64):
        drawn = model.draw(
            to_unit(first[i : i + 64].to(device)), before[i : i + 64], path[i : i + 64]
        )
        wrong = drawn.clamp(0, 1) - to_unit(last[i : i + 64].to(device))
        squared.append(wrong.square().mean(dim=(1, 2, 3)))
    metrics = {
        "hand": float((path - truth)[:, size:].norm(dim=1).mean()),
        "parts": float(error[seen].mean()),
        "still": float(went[seen].mean()),
        "moved_parts": float(error[moved].mean()),
        "moved_still": float(went[moved].mean()),
        "psnr": float(-10 * torch.cat(squared).clamp_min(1e-9).log10().mean()),
    }
    each = max(1, count * len(starts) // _SHOWN)
    shown = torch.arange(0, len(first), each)[:_SHOWN]
    drawn = model.draw(to_unit(first[shown].to(device)), before[shown], path[shown])
    rows = [first[shown].numpy(), last[shown].numpy(), to_frames(drawn.clamp(0, 1)).cpu().numpy()]
    return Validation(metrics, {"predictions": frame_grid(rows, zoom=2)})
