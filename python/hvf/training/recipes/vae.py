"""Training the generator of subgoal images on pairs of images of one episode."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

import hvf_core
from hvf.data.loader import EpisodePool, PairSampler
from hvf.images import frame_grid
from hvf.models.frames import to_frames, to_unit
from hvf.models.vae import CVAE, DESK_VAE, CVAEConfig, gaussian_kl
from hvf.training.loop import LoopConfig, Validation, seeded, train

# Held-out pairs that a validation measures, and how many of them its picture shows.
_PAIRS = 256
_SHOWN = 12
# A sample is sharp if it differs from a true image by less than this part of an agent.
_SHARP = 0.25
# The mean image is taken over every tenth frame of the pool.
_MEAN_STRIDE = 10


@dataclasses.dataclass(frozen=True)
class SubgoalTraining:
    """Training of the maze's CVAE.

    Attributes:
        data: file of episodes (``hvf collect maze``).
        out: directory of the run; a run that is already there is continued.
        batch_size: pairs of images per step; each image is reconstructed in the scene of the
            other; without a scene the first of each pair is.
        memory_gb: memory for decoded frames.
        model: the network and its loss.
        loop: how to optimise.
    """

    environment: ClassVar[str] = "maze"

    data: Path
    out: Path = Path("runs/subgoals")
    batch_size: int = 16
    memory_gb: float = 2.0
    model: CVAEConfig = CVAEConfig()
    loop: LoopConfig = LoopConfig(
        steps=16_000, learning_rate=1e-3, warmup_steps=200, schedule="cosine"
    )

    def __post_init__(self) -> None:
        if self.batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {self.batch_size}")
        if not (math.isfinite(self.memory_gb) and self.memory_gb > 0):
            raise ValueError(f"memory_gb must be positive, got {self.memory_gb}")


@dataclasses.dataclass(frozen=True)
class DeskSubgoalTraining(SubgoalTraining):
    """Training of the desk's VAE (``hvf collect desk``); see :class:`SubgoalTraining`."""

    environment: ClassVar[str] = "desk"

    out: Path = Path("runs/desk_subgoals")
    model: CVAEConfig = DESK_VAE


def train_subgoals(config: SubgoalTraining, console: Console | None = None) -> CVAE:
    """Train the maze's CVAE or the desk's VAE, or go on with the run in ``config.out``.

    Raises:
        FileNotFoundError: no data file.
        ValueError: a damaged or foreign data file, frames of another size than the model's, or
            another run in ``config.out``.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    seed = config.loop.seed
    environment = config.environment
    pool = EpisodePool(config.data, environment=environment, memory_gb=config.memory_gb, seed=seed)
    size = pool.frames.shape[2:4]
    if size != config.model.image_size:
        raise ValueError(
            f"{config.data}: frames are {size}, the model takes {config.model.image_size}"
        )
    probe = maze_probe if environment == "maze" else None
    held_out = EpisodePool(config.data, "validation", environment=environment, seed=seed)
    pairs = PairSampler(held_out, _PAIRS, seed).batch(0)
    pool.move_to(0)
    frames = torch.from_numpy(pool.frames[:, ::_MEAN_STRIDE].reshape(-1, *pool.frames.shape[2:]))
    return train(
        seeded(seed, lambda: CVAE(config.model)).centre(frames),
        PairSampler(pool, config.batch_size, seed),
        config.loop,
        config.out,
        environment=environment,
        run={
            "command": "hvf train subgoals" if environment == "maze" else "hvf train desk-subgoals",
            "batch_size": config.batch_size,
            "memory_gb": config.memory_gb,
            "data": dataclasses.asdict(pool.metadata),
        },
        validate=lambda model, generator: validate_subgoals(model, pairs, generator, probe),
        console=console,
    )


# Samples and what a true image of the same scene looks like, both uint8 [N, H, W, 3], to metrics.
Probe = Callable[[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]], Mapping[str, float]]


def validate_subgoals(
    model: CVAE,
    pairs: Mapping[str, torch.Tensor],
    generator: torch.Generator,
    probe: Probe | None = None,
) -> Validation:
    """Measure reconstructions of held-out images and samples in their scenes.

    Args:
        model: in evaluation mode.
        pairs: ``scene`` and ``image``, uint8 ``[N, H, W, 3]``.
        generator: of the latents of the samples, on the model's device.
        probe: further metrics from (images, reconstructions, samples).

    Returns:
        KL divergence in nats, latent dimensions in use, squared error of reconstructions from the
        posterior's mean (mean over values in [0, 1]), and a picture whose rows are scenes, images,
        reconstructions and three rows of samples.
    """
    device = generator.device
    image = to_unit(pairs["image"].to(device))
    scene = to_unit(pairs["scene"].to(device)) if model.config.conditional else None
    mean, log_variance = model.encode(image, scene)
    reconstruction = model.decode(mean, scene)
    latent = torch.randn(mean.shape, generator=generator, device=device)
    sample = model.decode(latent, scene)
    used = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).mean(0)
    metrics = {
        "kl": float(gaussian_kl(mean, log_variance).mean()),
        "latents_used": float((used > 0.1).sum()),
        "mse": float((reconstruction - image).square().mean()),
    }
    images, reconstructions, samples = (
        to_frames(batch).cpu().numpy() for batch in (image, reconstruction, sample)
    )
    if probe is not None:
        metrics.update(probe(images, reconstructions, samples))
    rows = [images[:_SHOWN], reconstructions[:_SHOWN], samples[:_SHOWN]]
    if scene is not None:
        rows.insert(0, to_frames(scene)[:_SHOWN].cpu().numpy())
    return Validation(metrics, {"subgoals": frame_grid(rows, zoom=2)})


def maze_probe(
    images: NDArray[np.uint8], reconstructions: NDArray[np.uint8], samples: NDArray[np.uint8]
) -> dict[str, float]:
    """Where the agent and the gaps are in generated images of the maze.

    Args:
        images: true images, uint8 ``[N, H, W, 3]``.
        reconstructions: of the same images.
        samples: images sampled in the same scenes.

    Returns:
        Median error of agent and gaps in reconstructions (mm), the fraction of samples that show
        one sharp agent where an agent can be, their gaps' median error, and how widely the agents
        of these are spread compared with those of true images (1 is alike, in x and y).
    """
    truth, rebuilt, drawn = (hvf_core.maze_locate(x) for x in (images, reconstructions, samples))
    # An image of the maze and its own state drawn again differ only by rounding; a smeared, second
    # or missing agent makes a difference of the order of an agent.
    scene = truth.copy()
    scene[:, :2] = drawn[:, :2]
    redrawn = hvf_core.maze_render(scene, images.shape[1])
    error = ((redrawn.astype(np.float64) - samples) ** 2).sum((1, 2, 3))
    empty = _agent_energy(images, truth)
    sharp = error < _SHARP * empty
    spread = drawn[sharp, :2].std(0) / truth[:, :2].std(0) if sharp.sum() > 1 else np.zeros(2)
    return {
        "agent_mm": 1e3 * float(np.median(np.linalg.norm((rebuilt - truth)[:, :2], axis=1))),
        "gap_mm": 1e3 * float(np.median(np.abs((rebuilt - truth)[:, 2:]))),
        "sharp_samples": float(sharp.mean()),
        "sample_gap_mm": 1e3 * float(np.median(np.abs((drawn - truth)[:, 2:]))),
        "spread_x": float(spread[0]),
        "spread_y": float(spread[1]),
    }


def _agent_energy(images: NDArray[np.uint8], states: NDArray[np.float64]) -> NDArray[Any]:
    """Squared difference that an agent makes: between frames with the agent here and far away."""
    far = states.copy()
    far[:, :2] *= -1
    difference = hvf_core.maze_render(far, images.shape[1]).astype(np.float64) - images
    return np.asarray((difference**2).sum((1, 2, 3)) / 2)
