"""Where things on the desk are put: at random, or for a task; and the state that this gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hvf.envs.desk import panda
from hvf.envs.desk.scene import (
    BASE,
    BLOCK_SIZE,
    BLOCKS,
    DOOR_TRAVEL,
    DRAWER_HANDLE_GAP,
    DRAWER_TRAVEL,
    DRAWER_Y,
    HUTCH_X,
)
from hvf.envs.desk.simulator import (
    ARM,
    DOOR,
    DRAWER,
    POSITIONS,
    DeskSimulator,
    Floats,
)
from hvf.envs.desk.simulator import BLOCKS as BLOCK_POSES

START = (0.36, 0.0, 0.12)
"""The fingertip at the start of a task, m."""
BLOCK_X, BLOCK_Y = (0.415, 0.52), 0.33
"""Where the centres of cubes are put."""
BLOCK_DISTANCE = 0.15
"""Least distance of their centres: the finger fits between two cubes, however they are turned."""

BLOCK_REACH = BLOCK_SIZE / np.sqrt(2)
"""Half the diagonal of a cube's face, m."""
_FINGER_REACH = float(np.hypot(panda.FINGER[0], panda.FINGER[1]))
_MARGIN = 0.008
# Where the fingertip starts in collected episodes, m; clear of the door's handle.
_FINGERTIP = ((0.30, -0.40, 0.05), (0.50, 0.40, 0.12))
# Until the spare degree of freedom is at rest too: zero action then moves no joint.
_ITERATIONS = 150


@dataclass(frozen=True)
class Arrangement:
    """Where everything is.

    Attributes:
        door: opening, m, 0 to 0.40.
        drawer: opening, m, 0 to 0.10.
        blocks: centres of the cubes, m ``[3, 3]``; z is that of a cube at rest.
        yaws: how the cubes are turned about z, rad ``[3]``.
        end_effector: the fingertip, m ``[3]``.
    """

    door: float
    drawer: float
    blocks: NDArray[np.float64]
    yaws: NDArray[np.float64] = field(default_factory=lambda: np.zeros(len(BLOCKS)))
    end_effector: tuple[float, float, float] = START


def positions(arrangements: Sequence[Arrangement]) -> Floats:
    """MuJoCo's positions ``[B, 33]`` for ``B`` arrangements, with the arms pointing down."""
    count = len(arrangements)
    result = np.zeros((count, POSITIONS))
    result[:, ARM] = panda.inverse_kinematics(
        np.tile(panda.HOME, (count, 1)),
        np.array([each.end_effector for each in arrangements]).reshape(count, 3),
        BASE,
        _ITERATIONS,
    )
    poses = result[:, BLOCK_POSES].reshape(count, len(BLOCKS), 7)
    for i, each in enumerate(arrangements):
        result[i, DOOR], result[i, DRAWER] = each.door, each.drawer
        poses[i, :, :3] = each.blocks
        poses[i, :, 3], poses[i, :, 6] = np.cos(each.yaws / 2), np.sin(each.yaws / 2)
    result[:, BLOCK_POSES] = poses.reshape(count, -1)
    return result


def settled(simulator: DeskSimulator, arrangements: Sequence[Arrangement]) -> Floats:
    """States at rest for ``B`` arrangements: ``[B, 63]``."""
    return simulator.settle(positions(arrangements))


def random_arrangement(
    rng: np.random.Generator, end_effector: tuple[float, float, float] | None = START
) -> Arrangement:
    """Door and drawer anywhere, cubes upright on the table and clear of everything.

    Args:
        rng: where chance comes from.
        end_effector: the fingertip, m; None for anywhere that is clear of the cubes.
    """
    door = rng.uniform(0.0, DOOR_TRAVEL)
    drawer = rng.uniform(0.0, DRAWER_TRAVEL)
    yaws = rng.uniform(-np.pi / 4, np.pi / 4, len(BLOCKS))
    while True:
        places = rng.uniform((BLOCK_X[0], -BLOCK_Y), (BLOCK_X[1], BLOCK_Y), (len(BLOCKS), 2))
        if _blocks_are_clear(places, drawer):
            break
    blocks = np.column_stack([places, np.full(len(BLOCKS), BLOCK_SIZE / 2)])
    while end_effector is None:
        x, y, z = rng.uniform(*_FINGERTIP).tolist()
        apart = np.hypot(*(places - (x, y)).T).min() > BLOCK_REACH + _FINGER_REACH + _MARGIN
        if z > BLOCK_SIZE + _MARGIN or (apart and not over_drawer(x, y, drawer, _FINGER_REACH)):
            end_effector = (x, y, z)
    return Arrangement(door, drawer, blocks, yaws, end_effector)


def _blocks_are_clear(places: Floats, drawer: float) -> bool:
    gaps = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    apart = bool((gaps[np.triu_indices(len(places), 1)] > BLOCK_DISTANCE).all())
    return apart and not any(over_drawer(x, y, drawer, BLOCK_REACH) for x, y in places)


def over_drawer(x: float, y: float, drawer: float, reach: float) -> bool:
    """Whether something round of radius ``reach`` would touch the drawer or its handle."""
    front = HUTCH_X - drawer - DRAWER_HANDLE_GAP - 0.010
    beside = y + reach + _MARGIN < DRAWER_Y[0] or y - reach - _MARGIN > DRAWER_Y[1]
    return not beside and x + reach + _MARGIN > front
