"""Video of a camera that drifts over pictures, and a video model that knows how.

A scene is a random picture on a torus; an action is how far the camera goes, in whole pixels. What
follows is known exactly, for any scene.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.models.checkpoint import save_model
from hvf.models.entry import ModelEntry
from hvf.models.video import State, VideoConfig, VideoModel
from hvf.protocols import Images
from hvf.registry import MODELS

SIZE = 32
CONFIG = VideoConfig(image_size=(SIZE, SIZE), action_low=(-2, -2), action_high=(2, 2))


def scene(seed: int) -> Images:
    """A picture of large spots, uint8 ``[S, S, 3]``."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (4, 4, 3)).astype(np.uint8)
    return np.kron(coarse, np.ones((SIZE // 4, SIZE // 4, 1), np.uint8)).astype(np.uint8)


def drift(seed: int, steps: int) -> tuple[Images, NDArray[np.float32]]:
    """Frames ``[T+1, S, S, 3]`` of a camera that goes one way, and its actions ``[T, 2]``."""
    rng = np.random.default_rng(seed)
    actions = np.tile(rng.integers(-2, 3, 2), (steps, 1))
    frames = [scene(seed)]
    for action in actions:
        frames.append(np.roll(frames[-1], tuple(action), (0, 1)))
    return np.stack(frames), actions.astype(np.float32)


def episodes(path: Path, seeds: Sequence[int], steps: int = 6, split: str = "train") -> Path:
    """A file of episodes, one a seed."""
    frames, actions = zip(*(drift(seed, steps) for seed in seeds), strict=True)
    about = Metadata("drift", {"split": split}, None, steps, len(seeds), {})
    write_episodes(path, about, Episodes(np.stack(frames), np.stack(actions)))
    return path


class Drift(VideoModel):
    """Rolls the picture as the action says.

    It has a parameter, since models have; it does nothing.
    """

    config_type = VideoConfig

    def __init__(self, config: VideoConfig) -> None:
        super().__init__(config)
        self.nothing = torch.nn.Parameter(torch.zeros(1))

    def start(self, frames: torch.Tensor, past: torch.Tensor) -> State:
        return (frames[:, -1],)

    def step(self, state: State, actions: torch.Tensor, noise: Any, *, last: bool = False) -> State:
        far = actions.round().long()
        rows = (torch.arange(SIZE)[None] - far[:, :1]) % SIZE
        columns = (torch.arange(SIZE)[None] - far[:, 1:]) % SIZE
        return (
            state[0][
                torch.arange(len(far))[:, None, None], :, rows[:, :, None], columns[:, None]
            ].permute(0, 3, 1, 2),
        )

    def images(self, state: State) -> torch.Tensor:
        return state[0]


class Wanderer(torch.nn.Module):
    """Draws the scene from where the camera may be, its latents in steps of two pixels."""

    @dataclasses.dataclass(frozen=True)
    class Config:
        latents: int = 2

    config_type = Config

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        self.nothing = torch.nn.Parameter(torch.zeros(1))


class Wandering:
    """What the planner asks of it."""

    latent_dim = 2

    def __init__(self, wanderer: Wanderer, world: Any) -> None:
        pass

    def decode(self, scene: Any, latents: NDArray[np.float32]) -> Images:
        image = np.asarray(getattr(scene, "images", scene))[0]
        far = np.rint(2 * latents.reshape(-1, 2)).astype(int)
        return np.stack([np.roll(image, tuple(by), (0, 1)) for by in far])


class Blind(Wandering):
    """Draws other scenes than it is shown."""

    def decode(self, scene: Any, latents: NDArray[np.float32]) -> Images:
        return np.stack([255 - image for image in super().decode(scene, latents)])


def models(folder: Path) -> tuple[str, str]:
    """Checkpoints of dynamics and generator; the models are registered."""
    for name, entry in (
        (
            "drift",
            ModelEntry(
                "drifts", "video", "dynamics", Drift, "hvf.worlds.video:world_of", in_torch=True
            ),
        ),
        ("wanderer", ModelEntry("wanders", "video", "generator", Wanderer, Wandering)),
    ):
        MODELS.register(name, entry, replace=True)
    dynamics, generator = folder / "drift.safetensors", folder / "wanderer.safetensors"
    save_model(dynamics, Drift(CONFIG), environment="drift")
    save_model(generator, Wanderer(Wanderer.Config()), environment="drift")
    return str(dynamics), str(generator)
