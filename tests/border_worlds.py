"""One of everything in ``hvf_core`` that makes sense, small: worlds, frames, planners."""

from __future__ import annotations

from typing import Any

import numpy as np

import hvf_core
from hvf_core import HVF, VisualMPC

# --- worlds -----------------------------------------------------------------------------------

STATES = np.array([[0.0, 0.0, 0.1, -0.1], [0.1, 0.2, 0.0, 0.0], [-0.2, 0.0, 0.1, 0.1]])
LAYOUT = hvf_core.MazeLayout.preset("corridor-1")
LAID, _ = hvf_core.maze_episodes(0, 0, 3, layout=LAYOUT)
"""States of it."""
RNG = np.random.default_rng(0)


def numbers(*shape: int) -> np.ndarray:
    return RNG.normal(0, 0.3, shape).astype(np.float32)


def layer(outputs: int, inputs: int) -> tuple[np.ndarray, np.ndarray]:
    return numbers(outputs, inputs), numbers(outputs)


KEYPOINT: dict[str, Any] = {
    "patch": numbers(4, 9),
    "patch_bias": numbers(4),
    "context": numbers(4, 3),
    "middle": numbers(4, 4),
    "middle_bias": numbers(4),
    "output": numbers(3, 4),
    "output_bias": numbers(3),
    "free": numbers(2, 2),
    "action_scale": 3.0,
    "spacing": 2,
    "substeps": 2,
    "half_size": [1.5, 1.5],
    "edge": [1.0, 1.0],
    "colour": [0.1, 0.6, 0.0],
    "action_low": [-3.0, -3.0],
    "action_high": [3.0, 3.0],
    "image_size": 12,
    "blur": 1.0,
    "over_horizon": "min",
}
LAYERS: dict[str, Any] = {
    "hand": [layer(4, 8), layer(3, 4)],
    "sliders": [[layer(1, 11)], [layer(1, 11)]],
    "parts": [layer(5, 18)],
    "contact": numbers(10, 2),
    "reach": 7.0,
    "arm_low": [-1.0, -1.0, -1.0],
    "arm_step": [1.0, 1.0, 1.0],
    "arm_places": (2, 3, 2),
    "arm_patches": np.concatenate(
        [np.zeros((1, 4, 8, 8), np.uint8), RNG.integers(0, 256, (3, 4, 8, 8)).astype(np.uint8)]
    ),
    "arm_index": RNG.integers(0, 4, (12, 16)).astype(np.int32),
    "table": RNG.integers(0, 256, (2, 2, 3, 32, 32)).astype(np.uint8),
    "sprites": np.abs(numbers(2, 4, 7, 7)).clip(0, 1),
    "blur": 1.0,
    "over_horizon": "last",
    "hold": 1,
    "scene_weight": 0.5,
}
LATENT: dict[str, Any] = {
    "action_low": [-2.0, -2.0],
    "action_high": [2.0, 2.0],
    "dynamics": {
        "input": layer(5, 6),
        "blocks": [(layer(5, 5), layer(5, 5))],
        "output": layer(4, 5),
        "activation": "sin",
        "scale": numbers(4),
    },
    "readout": {"input": layer(5, 4), "output": layer(3, 5)},
    "weights": np.abs(numbers(3)),
    "over_horizon": "sum",
    "hold": 1,
}
GRU: dict[str, Any] = {
    **LATENT,
    "dynamics": {
        "weight_ih": numbers(12, 2),
        "weight_hh": numbers(12, 4),
        "bias_ih": numbers(12),
        "bias_hh": numbers(12),
    },
    "readout": numbers(6, 4),
    "weights": np.abs(numbers(6)),
}
MAZE_LAYOUT: dict[str, Any] = {
    "name": "any",
    "walls": LAYOUT.walls,
    "start": LAYOUT.start,
    "goal": LAYOUT.goal,
    "arena": LAYOUT.arena,
    "gaps": LAYOUT.gaps,
}
MAZE_WORLD = hvf_core.MazeWorld(image_size=8, blur=1.0)
MAZE_FRAMES = hvf_core.MazeFrames(STATES, image_size=8)
KEYPOINT_WORLD = hvf_core.KeypointWorld(**KEYPOINT)
KEYPOINT_IMAGES = RNG.integers(0, 256, (3, 12, 12, 3)).astype(np.uint8)
KEYPOINT_PARTS = (KEYPOINT_IMAGES, np.full((3, 2), 5.0, np.float32), numbers(3, 12, 12))
KEYPOINT_FRAMES = KEYPOINT_WORLD.frames(*KEYPOINT_PARTS)
LAYER_WORLD = hvf_core.LayerWorld(**LAYERS)
LAYER_PARTS = (
    RNG.integers(0, 256, (3, 32, 32, 3)).astype(np.uint8),
    RNG.random((3, 32, 32, 3)).astype(np.float32),
    RNG.random((3, 2, 32, 32)) < 0.1,
    np.abs(numbers(3, 11)),
)
LAYER_FRAMES = LAYER_WORLD.frames(*LAYER_PARTS)
LATENT_WORLD = hvf_core.LatentWorld(**LATENT)
LATENT_PARTS = (numbers(3, 4), numbers(3, 3), np.abs(numbers(3)), KEYPOINT_IMAGES)
LATENT_FRAMES = hvf_core.LatentFrames(*LATENT_PARTS)
POINTS = numbers(3, 2)
A2, A3 = numbers(3, 4, 2, 2), numbers(3, 4, 2, 3)
"""Actions ``[B, D, H, A]``."""
WORLDS = [
    (MAZE_WORLD, MAZE_FRAMES, A2),
    (KEYPOINT_WORLD, KEYPOINT_FRAMES, A2),
    (LAYER_WORLD, LAYER_FRAMES, A3),
    (LATENT_WORLD, LATENT_FRAMES, A2),
]

# --- planners ---------------------------------------------------------------------------------

PLANNERS = [
    VisualMPC(horizon=2, samples=6, elites=2, iterations=2),
    VisualMPC(
        horizon=4,
        samples=5,
        elites=5,
        iterations=2,
        action_repeat=2,
        clip=False,
        initial="normal",
        keep_elites=2,
        best="last",
    ),
    VisualMPC(
        horizon=3,
        samples=6,
        elites=2,
        iterations=3,
        noise_beta=2,
        shift_elites=2,
        samples_decay=1.5,
        temperature=0.1,
        momentum=0.1,
        min_std=0.01,
    ),
]
SEARCHES = [
    HVF(mpc=PLANNERS[0], subgoals=0),
    HVF(mpc=PLANNERS[0], subgoals=1, samples=4, elites=2, iterations=2),
    HVF(mpc=PLANNERS[1], subgoals=2, samples=3, elites=1, iterations=1, reduction="mean"),
    HVF(mpc=PLANNERS[2], subgoals=2, samples=4, elites=3, iterations=2, covariance="full"),
    HVF(mpc=PLANNERS[0], subgoals=1, samples=4, elites=2, segment_cost="likelihood"),
]
