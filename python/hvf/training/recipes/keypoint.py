"""Training the keypoint dynamics: perception from pairs of frames, then the cell."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
import torch

from hvf.data.formats import open_episodes
from hvf.data.loader import EpisodePool, PairSampler
from hvf.images import frame_grid
from hvf.models.frames import to_frames, to_unit
from hvf.models.keypoint.dynamics import DynamicsConfig, KeypointDynamics
from hvf.models.keypoint.perception import KeypointPerception
from hvf.training.loop import LoopConfig, Validation, seeded
from hvf.training.recipe import Recipe, Stage, Stages, TrainingData
from hvf.training.tracks.kept import refuse_unequal
from hvf.training.tracks.keypoints import Transitions, TransitionSampler

# Validation: windows of this many steps from each held-out episode, and how many are drawn.
_HORIZON = 5
_SHOWN = 10


@dataclasses.dataclass(frozen=True, kw_only=True)
class KeypointRecipe(Recipe):
    """Training of the keypoint dynamics, for one moving thing before a still scene.

    Attributes:
        episodes: episodes whose transitions train the cell, at most.
        pairs: pairs of images per step while perception is trained.
        scenes: scenes per step while the cell is trained.
        transitions: transitions per scene and step.
        model: the network; sizes of images and actions are the data's, and the largest action is,
            where the data tells the range of its actions.
        perception_loop: how to optimise perception.
        loop: how to optimise the cell.
    """

    name: ClassVar[str] = "keypoint"

    episodes: int = 6000
    pairs: int = 32
    scenes: int = 64
    transitions: int = 32
    model: DynamicsConfig = DynamicsConfig()
    perception_loop: LoopConfig = LoopConfig(
        steps=800,
        learning_rate=8e-3,
        schedule="cosine",
        precision="float32",
        validate_every=400,
        checkpoint_every=200,
        threads=1,
    )
    # Positions in pixels need all of float32's digits, on a GPU too.
    loop: LoopConfig = LoopConfig(
        steps=20_000,
        learning_rate=4e-3,
        schedule="cosine",
        warmup_steps=200,
        clip_norm=1.0,
        precision="float32",
        validate_every=5000,
        checkpoint_every=1000,
        threads=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("episodes", "pairs", "scenes", "transitions")

    def stages(self, data: TrainingData) -> Stages:
        """Perception from pairs of frames, then the cell from the keypoints that it sees."""
        seed = self.loop.seed
        config = self.fitting(data)
        pool = data.pool(memory_gb=0.5)
        perception = yield Stage(
            seeded(seed, lambda: KeypointPerception(config.perception)),
            PairSampler(pool, self.pairs, seed),
            self.perception_loop,
            "perception: mask, keypoint and sprite from pairs of frames",
            folder="perception",
            settings={"pairs": self.pairs},
            validate=lambda model, _: validate_perception(model, data.held_out),
        )
        pool.close()
        perception.warn_of_unexplained(_apart(perception, data.held_out))
        model = seeded(seed, lambda: KeypointDynamics(config)).freeze_perception(perception)
        episodes = min(self.episodes, data.training)
        found = Transitions(data.path, model, episodes, console=data.console, camera=data.camera)
        model.fit_backgrounds(torch.from_numpy(found.backgrounds[:, 0]))
        yield Stage(
            model,
            TransitionSampler(found, self.scenes, self.transitions, seed),
            self.loop,
            "cell: how actions move the keypoint",
            settings={
                "episodes": self.episodes,
                "pairs": self.pairs,
                "scenes": self.scenes,
                "transitions": self.transitions,
                "perception_steps": self.perception_loop.steps,
            },
            validate=lambda trained, _: validate_dynamics(trained, data.held_out),
        )

    def fitting(self, data: TrainingData) -> DynamicsConfig:
        """The model's config, of the data's sizes.

        Raises:
            ValueError: images that the model cannot take.
        """
        with open_episodes(data.path) as file:
            refuse_unequal(file)
        size = data.square("the keypoint model")
        if data.metadata.steps < _HORIZON:
            raise ValueError(
                f"{data.path}: episodes have {data.metadata.steps} steps, "
                f"validation needs {_HORIZON}"
            )
        largest = data.largest_action
        try:
            return dataclasses.replace(
                self.model,
                perception=dataclasses.replace(self.model.perception, image_size=size),
                action_dim=data.action_dim,
                action_scale=self.model.action_scale if largest is None else largest,
            )
        except ValueError as error:
            raise ValueError(f"{data.path}: the keypoint model cannot take it: {error}") from error


def validate_perception(model: KeypointPerception, held_out: EpisodePool) -> Validation:
    """Unexplained part of the difference between held-out frames some steps apart, and a picture.

    The rows of the picture: frames, masks, and the frames with the sprite taken away.
    """
    pairs = _apart(model, held_out)
    images = to_unit(pairs.flatten(0, 1)[:_SHOWN])
    mask = model.motion_mask(images)
    background = model.background(images, model.centroid(mask))
    metrics = {
        "unexplained": model.unexplained(pairs),
        "sprite_height": float(2 * model.half_size[0]),
        "sprite_width": float(2 * model.half_size[1]),
    }
    masks = mask[:, None].expand(-1, 3, -1, -1)
    rows = [to_frames(row).cpu().numpy() for row in (images, masks, background)]
    return Validation(metrics, {"perception": frame_grid(rows, zoom=2)})


def _apart(model: KeypointPerception, held_out: EpisodePool) -> torch.Tensor:
    """Held-out frames ten steps apart, uint8 `[N, 2, S, S, 3]`, where the model is."""
    later = min(10, held_out.frames.shape[1] - 1)
    return torch.from_numpy(held_out.frames[:64, [0, later]]).to(model.colour.device)


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
    maps = torch.cat([m for _, m in observed])[:: keypoints.shape[1]]
    windows = len(starts)
    index = starts[:, None] + np.arange(_HORIZON)
    actions = torch.from_numpy(held_out.actions[:, index]).to(device)
    path = model.rollout(keypoints[:, :windows], maps, actions)
    first = torch.from_numpy(frames[:, starts + 1]).flatten(0, 1)
    after_one = torch.cat([model.observe(part.to(device))[0] for part in torch.split(first, 512)])
    one = (path[:, :, 0].flatten(0, 1) - after_one).norm(dim=1)
    five = (path[:, :, -1] - keypoints[:, 1 : windows + 1]).norm(dim=2).flatten()
    metrics = {
        "pixels_1_median": float(one.median()),
        "pixels_1_95": float(one.quantile(0.95)),
        "pixels_5_median": float(five.median()),
        "pixels_5_mean": float(five.mean()),
        "pixels_5_over_2.5": float((five > 2.5).float().mean()),
    }
    images = to_unit(torch.from_numpy(frames[:_SHOWN, 0]).to(device))
    drawn = model.draw(images, keypoints[:_SHOWN, 0], path[:_SHOWN, 0, -1])
    rows = [frames[:_SHOWN, 0], frames[:_SHOWN, _HORIZON], to_frames(drawn).cpu().numpy()]
    return Validation(metrics, {"predictions": frame_grid(rows, zoom=2)})
