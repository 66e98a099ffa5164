"""Training of models that see a frame as its keypoint and the code of its scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from hvf.data.loader import EpisodePool
from hvf.models.checkpoint import load_model
from hvf.models.keypoint.dynamics import KeypointDynamics
from hvf.models.keypoint.scene_code import SceneCode
from hvf.training.loop import LoopConfig, Sampler, Validation, seeded, train
from hvf.training.tracks.keypoints import Transitions


@dataclasses.dataclass(frozen=True)
class OnKeypoints:
    """What such a training has to know.

    Attributes:
        data: file of episodes (``hvf collect maze``).
        dynamics: trained compact dynamics model (``hvf train dynamics``).
        out: directory of the run; a run that is already there is continued.
        episodes: episodes to learn from.
        batch_size: samples per step.
        model: the network; a dataclass with ``image_size``.
        loop: how to optimise.
    """

    data: Path
    dynamics: Path = Path("runs/dynamics/model.safetensors")
    out: Path = Path("runs/on_keypoints")
    episodes: int = 1000
    batch_size: int = 1024
    model: Any = None
    loop: LoopConfig = LoopConfig()

    def __post_init__(self) -> None:
        for name in ("episodes", "batch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


ModelT = TypeVar("ModelT", bound=torch.nn.Module)

# Keypoints [P, T+1, 2] and codes [P, E] of the episodes, samples per step, seed.
MakeSampler = Callable[[NDArray[np.float32], NDArray[np.float32], int, int], Sampler]
Validate = Callable[[ModelT, KeypointDynamics, EpisodePool, torch.Generator], Validation]


def train_on_keypoints(
    config: OnKeypoints,
    command: str,
    build: Callable[[Any], ModelT],
    sampler: MakeSampler,
    validate: Validate[ModelT],
    console: Console | None,
) -> ModelT:
    """Train a model that has a ``code`` (:class:`SceneCode`), or go on with the run.

    Args:
        config: what to train on, and how.
        command: name of the command, for the checkpoint.
        build: makes the model from its config; its ``code`` is then fitted to the scenes.
        sampler: makes the source of batches.
        validate: measures the model on held-out episodes.
        console: where progress goes.

    Raises:
        FileNotFoundError: no data file, or no dynamics model.
        ValueError: a damaged or foreign file, or another run in ``config.out``.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    console = console or Console()
    seed = config.loop.seed
    dynamics = load_model(config.dynamics, KeypointDynamics, environment="maze")
    size = dynamics.config.perception.image_size
    model_config = dataclasses.replace(config.model, image_size=size)
    model = seeded(seed, lambda: build(model_config))
    held_out = EpisodePool(config.data, "validation", environment="maze", seed=seed)
    held_out.move_to(0)
    training = held_out.metadata.episodes - len(held_out)
    data = Transitions(config.data, dynamics, min(config.episodes, training), console=console)
    code = model.code
    assert isinstance(code, SceneCode)
    with torch.inference_mode():
        maps = dynamics.maps(torch.from_numpy(data.backgrounds[:, 0]).float())
        codes = code.fit(maps)(maps).numpy()
    return train(
        model,
        sampler(data.keypoints, codes, config.batch_size, seed),
        config.loop,
        config.out,
        environment="maze",
        run={
            "command": command,
            "episodes": config.episodes,
            "batch_size": config.batch_size,
            "data": dataclasses.asdict(held_out.metadata),
        },
        validate=lambda trained, generator: validate(trained, dynamics, held_out, generator),
        console=console,
    )
