"""The paper's four desk tasks (section 6.2): what is where at the start, and what should become.

A task's episode is a function of (task, seed, number). Its stages are the states after each of
its objects has been dealt with, blocks first and the door last; the last of them is the goal.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from hvf.envs.desk import panda
from hvf.envs.desk.arrangement import (
    BLOCK_REACH,
    START,
    Arrangement,
    over_drawer,
    random_arrangement,
    settled,
)
from hvf.envs.desk.scene import (
    BASE,
    BLOCK_SIZE,
    BLOCKS,
    HANDLE_CLOSED_Y,
    HANDLE_RADIUS,
    HANDLE_X,
    TABLE_Y,
)
from hvf.envs.desk.simulator import DOOR, WORKSPACE, DeskSimulator, Floats, block_positions

TaskName: TypeAlias = Literal["door", "two_block", "door_block", "door_two_block"]
TASKS: tuple[TaskName, ...] = get_args(TaskName)

MAX_STEPS: dict[TaskName, int] = {
    "door": 50,
    "two_block": 50,
    "door_block": 100,
    "door_two_block": 100,
}
"""Steps of an episode, ``T``, of the paper."""

_OBJECTS: dict[TaskName, tuple[bool, int]] = {
    "door": (True, 0),
    "two_block": (False, 2),
    "door_block": (True, 1),
    "door_two_block": (True, 2),
}

DOOR_CLOSED = 0.02
"""The door counts as closed below this opening, m."""
OFF_TABLE = 0.02
"""A cube is off the table below this height of its centre, m. One that came to lie on another on
the floor is at 0.005 m."""
DOOR_OPEN = (0.25, 0.40)
"""Where the door of a door task starts, m."""

# Where the finger ends: beside the closed handle, and at the table's edge after a push.
_AT_HANDLE = (HANDLE_X, HANDLE_CLOSED_Y + HANDLE_RADIUS + panda.FINGER[1] + 0.004, 0.10)
_AT_EDGE_Y = TABLE_Y - BLOCK_SIZE / 2
_AT_EDGE_Z = 0.04
# Where it is before: beside the cube however that is turned, and a little off the handle.
_BESIDE_BLOCK = BLOCK_REACH + panda.FINGER[1] + 0.012
_BESIDE_HANDLE = 0.010
# As high as the finger goes, above the cubes; as low, so that it does not rise over one.
_HOVER_Z, _PUSH_Z = float(WORKSPACE[1, 2]), float(WORKSPACE[0, 2])
# On the way: behind a cube that it pushes, here as far as the brink; and in front of the handle.
_BEHIND_BLOCK = BLOCK_SIZE / 2 + panda.FINGER[1] + 0.002
_BRINK_Y = TABLE_Y - 0.02
_IN_FRONT_X = HANDLE_X - 0.09
# A cube that was pushed over the edge lies this far out, on the floor.
_FALLEN_Y = TABLE_Y + 0.09


@dataclass(frozen=True)
class Episodes:
    """``B`` episodes of a task.

    Attributes:
        task: name of the task.
        starts: states, float64 ``[B, 63]``.
        ways: five states on the way for each object, float64 ``[B, J, 5, 63]``. A cube: the finger
            is above the place beside it; at that place; has pushed it half way to the table's
            edge; to the brink; it has fallen. The door: the finger is in front of the place
            beside its handle; at that place; has closed a third; two thirds; all of it.
        blocks: which cubes have to leave the table, bool ``[B, 3]``.
    """

    task: TaskName
    starts: Floats
    ways: Floats
    blocks: NDArray[np.bool_]

    @property
    def approaches(self) -> Floats:
        """States in which the finger is beside each object, ready to push it: ``[B, J, 63]``."""
        return self.ways[:, :, 1]

    @property
    def stages(self) -> Floats:
        """States after each object, ``[B, J, 63]``."""
        return self.ways[:, :, -1]

    @property
    def goals(self) -> Floats:
        """Goal states, ``[B, 63]``: the goal images show these."""
        return self.stages[:, -1]

    @property
    def has_door(self) -> bool:
        """Whether the door has to be closed."""
        return has_door(self.task)


def make_episodes(
    simulator: DeskSimulator, task: TaskName, seed: int, first: int, count: int
) -> Episodes:
    """Episodes ``first`` to ``first + count`` of ``seed``.

    Raises:
        ValueError: an unknown task, or a negative seed, number or count.
    """
    check_task(task)
    for name, value in (("seed", seed), ("first", first), ("count", count)):
        if value < 0:
            raise ValueError(f"{name}: must not be negative, got {value}")
    starts, ways = [], []
    blocks = np.zeros((count, len(BLOCKS)), np.bool_)
    for i in range(count):
        rng = np.random.default_rng([seed, first + i, TASKS.index(task)])
        start, moved = _start(rng, task)
        blocks[i, moved] = True
        starts.append(start)
        ways += _way(start, task, moved)
    states = settled(simulator, [*starts, *ways]) if count else np.empty((0, 63))
    return Episodes(
        task, states[:count], states[count:].reshape(count, sum(_OBJECTS[task]), 5, -1), blocks
    )


def has_door(task: TaskName) -> bool:
    """Whether a task asks for the door to be closed."""
    return _OBJECTS[task][0]


def object_success(task: TaskName, blocks: NDArray[np.bool_], states: Floats) -> NDArray[np.bool_]:
    """Whether door, red, green and blue are where the task wants them, bool ``[B, 4]``.

    What the task does not ask for is True. The door is closed below 0.02 m of opening; a cube is
    off the table when its centre is below 0.02 m (at rest on the table it is at 0.035 m).

    Args:
        task: name of the task.
        blocks: which cubes have to leave the table, ``[B, 3]``.
        states: ``[B, 63]``.
    """
    check_task(task)
    done = np.ones((len(states), 1 + len(BLOCKS)), np.bool_)
    if _OBJECTS[task][0]:
        done[:, 0] = states[:, DOOR] < DOOR_CLOSED
    done[:, 1:] = ~blocks | (block_positions(states)[:, :, 2] < OFF_TABLE)
    return done


def check_task(task: str) -> None:
    """Refuse what is not one of ``TASKS``.

    Raises:
        ValueError: an unknown task.
    """
    if task not in TASKS:
        raise ValueError(f"task: must be one of {TASKS}, got {task!r}")


def _start(rng: np.random.Generator, task: TaskName) -> tuple[Arrangement, list[int]]:
    """Where everything starts, and which cubes are to be moved, in order."""
    has_door, count = _OBJECTS[task]
    start = random_arrangement(rng, START)
    if has_door:
        start = dataclasses.replace(start, door=rng.uniform(*DOOR_OPEN))
    moved = rng.permutation(len(BLOCKS))[:count].tolist()
    # Outer ones first: an inner one would push them along.
    return start, sorted(moved, key=lambda block: -abs(start.blocks[block, 1]))


def _way(start: Arrangement, task: TaskName, moved: list[int]) -> list[Arrangement]:
    """Five states for each object, see ``Episodes``: cubes over a side of the table, then the door.

    The arm is where it would be before, while and after moving the object.
    """
    way, now = [], start
    for block in moved:
        x, y, _ = now.blocks[block].tolist()
        side = _side(now, block)
        for height in (_HOVER_Z, _PUSH_Z):
            place = (x, y - side * _BESIDE_BLOCK, height)
            way.append(dataclasses.replace(now, end_effector=place))
        for to in ((y + side * _BRINK_Y) / 2, side * _BRINK_Y):
            behind = (x, to - side * _BEHIND_BLOCK, _PUSH_Z)
            way.append(_with_block(now, block, (x, to, BLOCK_SIZE / 2), behind))
        fallen = (x, side * _fallen(now, x, side), float(BASE[2] + BLOCK_SIZE / 2))
        now = _with_block(now, block, fallen, (x, side * _AT_EDGE_Y, _AT_EDGE_Z))
        way.append(now)
    if _OBJECTS[task][0]:
        x, y, z = _AT_HANDLE
        beside = min(y + now.door + _BESIDE_HANDLE, float(WORKSPACE[1, 1]))
        for place in ((_IN_FRONT_X, beside, _HOVER_Z), (x, beside, z)):
            way.append(dataclasses.replace(now, end_effector=place))
        for door in (now.door * 2 / 3, now.door / 3):
            way.append(dataclasses.replace(now, door=door, end_effector=(x, y + door, z)))
        way.append(dataclasses.replace(now, door=0.0, end_effector=_AT_HANDLE))
    return way


def _with_block(
    now: Arrangement,
    block: int,
    place: tuple[float, float, float],
    end_effector: tuple[float, float, float],
) -> Arrangement:
    """With a cube somewhere else, square to the table as pushing leaves it, and so the finger."""
    blocks, yaws = now.blocks.copy(), now.yaws.copy()
    blocks[block], yaws[block] = place, 0.0
    return dataclasses.replace(now, blocks=blocks, yaws=yaws, end_effector=end_effector)


def _side(now: Arrangement, block: int) -> float:
    """The side of the table that a cube is pushed over: the nearer one, unless the way is not free.

    Returns:
        1 for the left, -1 for the right.
    """
    x, y, _ = now.blocks[block]
    nearer = 1.0 if y >= 0 else -1.0

    def free(side: float) -> bool:
        others = [other for i, other in enumerate(now.blocks) if i != block and other[2] > 0]
        cubes = any(
            side * (other[1] - y) > 0 and abs(other[0] - x) < 2 * BLOCK_REACH for other in others
        )
        edge = np.linspace(y, side * TABLE_Y, 20)
        return not cubes and not any(over_drawer(x, at, now.drawer, BLOCK_REACH) for at in edge)

    return -nearer if free(-nearer) and not free(nearer) else nearer


def _fallen(now: Arrangement, x: float, side: float) -> float:
    """How far out a cube lies on the floor: beyond one that is there already."""
    away = _FALLEN_Y
    lying = now.blocks[now.blocks[:, 2] < 0]
    for other_x, other_y, _ in lying:
        if side * other_y > 0 and abs(other_x - x) < 1.5 * BLOCK_SIZE:
            away = max(away, abs(other_y) + 1.2 * BLOCK_SIZE)
    return away
