"""The physics of the desk as a function: states and actions in, states out, many at once.

Shapes: ``B`` desks, ``H`` agent steps. A state is float64 ``[63]``: MuJoCo's 33 positions (seven
joints of the arm, door, drawer, three buttons, position and quaternion of each cube) and 30
velocities. Nothing else is carried from one agent step to the next, so that a state is all there
is to save: the same state and action give the same next state, bit for bit, alone or in a batch.

One agent step is 0.2 s of 40 substeps. At its start, inverse kinematics turns the wanted position
of the fingertip into joint angles; the actuators' targets go there in the first 60% of the step.

What rests is put to sleep by MuJoCo until something touches it, which halves the time of a step.
Sleep is no part of a state: every step decides anew, from the velocities, what may sleep.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from hvf.envs.desk import panda
from hvf.envs.desk.scene import BASE, TIME_STEP, load_scene

Floats = NDArray[np.float64]

POSITIONS, VELOCITIES = 33, 30
STATE_SIZE = POSITIONS + VELOCITIES
ACTION_SIZE = 3

STEP_SECONDS = 0.2
SUBSTEPS = round(STEP_SECONDS / TIME_STEP)
RAMP = 0.6
"""Part of a step in which the joint targets move; in the rest the arm settles."""
STEP_LENGTH = 0.08
"""How far the fingertip goes in a step at full action along one axis, m: 0.4 m/s."""
WORKSPACE = np.array([[0.30, -0.42, 0.025], [0.63, 0.42, 0.12]])
"""Where the fingertip is sent: lowest and highest x, y and z, m."""

ARM, DOOR, DRAWER, BUTTONS, BLOCKS = slice(0, 7), 7, 8, slice(9, 12), slice(12, 33)

# Faster than anything on a desk moves, m/s and rad/s.
_TOO_FAST = 1e3
# MuJoCo's count of substeps until a body may sleep: what has no velocity at all sleeps after two of
# them, unless it has gained some in the first. (All else: after ten slow ones.)
_MAY_SLEEP = -3
# Slower than this it sleeps, m/s and rad/s: a hundredth of MuJoCo's default, which is as fast, and
# moves a cube by less than a micrometre.
_ASLEEP = 1e-5


class DivergenceError(RuntimeError):
    """A simulation whose state is not finite any more, or absurdly fast.

    Attributes:
        which: numbers of the desks in the batch.
        step: agent step, counted from 0, in which it happened.
    """

    def __init__(self, which: list[int], step: int, where: str = "") -> None:
        super().__init__(where or f"simulation of desks {which} diverged in step {step}")
        self.which = which
        self.step = step

    def __reduce__(self) -> tuple[type[DivergenceError], tuple[list[int], int, str]]:
        # From one process to another.
        return DivergenceError, (self.which, self.step, str(self))


class DeskSimulator:
    """The desk's physics.

    Args:
        scene: MJCF file to use in place of the package's own scene.
        threads: threads that a batch is spread over; results do not depend on it.

    Attributes:
        model: the compiled scene.

    Raises:
        FileNotFoundError, ValueError: as :func:`~hvf.envs.desk.scene.load_scene`; or threads
            below 1.
    """

    def __init__(self, scene: str | Path | None = None, threads: int = 1) -> None:
        if threads < 1:
            raise ValueError(f"threads: must be at least 1, got {threads}")
        self.model = load_scene(scene)
        self.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        self.model.opt.sleep_tolerance = _ASLEEP
        self._rollout = mujoco.rollout.Rollout(nthread=0)
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        self._threads = ThreadPoolExecutor(threads) if threads > 1 else None
        times = (np.arange(SUBSTEPS) + 1) / (RAMP * SUBSTEPS)
        self._ramp: Floats = np.minimum(times, 1.0)[None, :, None]

    def step(self, states: Floats, actions: NDArray[np.floating]) -> Floats:
        """States ``[B, 63]`` after ``actions[B, 3]``.

        An action is the velocity of the fingertip along x, y and z in units of 0.4 m/s; it is
        clipped to ``[-1, 1]``, and where it leads to the workspace.

        Raises:
            DivergenceError: a simulation diverged; the states are not changed.
            ValueError: other shapes, or numbers that are not finite.
        """
        states = checked_states(states)
        if np.shape(actions) != (len(states), ACTION_SIZE):
            raise ValueError(
                f"actions: expected shape [{len(states)}, {ACTION_SIZE}], "
                f"got {list(np.shape(actions))}"
            )
        if not np.isfinite(actions).all():
            raise ValueError("actions: must be finite")
        moves = STEP_LENGTH * np.clip(np.asarray(actions, np.float64), -1.0, 1.0)
        joints = states[:, ARM]
        targets = np.clip(panda.tool_positions(joints, BASE) + moves, *WORKSPACE)
        return self._move(states, panda.inverse_kinematics(joints, targets, BASE), 0)

    def rollout(self, states: Floats, actions: NDArray[np.floating]) -> Floats:
        """States ``[B, H, 63]`` after each of ``actions[B, H, 3]``, from ``states[B, 63]``.

        Raises:
            DivergenceError, ValueError: as :meth:`step`.
        """
        states = checked_states(states)
        shape = np.shape(actions)
        if len(shape) != 3 or shape[0] != len(states) or shape[2] != ACTION_SIZE:
            raise ValueError(
                f"actions: expected shape [{len(states)}, H, {ACTION_SIZE}], got {list(shape)}"
            )
        result = np.empty((len(states), shape[1], STATE_SIZE))
        for step in range(shape[1]):
            try:
                states = result[:, step] = self.step(states, actions[:, step])
            except DivergenceError as error:
                raise DivergenceError(error.which, step) from error
        return result

    def settle(self, positions: Floats, seconds: float = 0.4) -> Floats:
        """States ``[B, 63]`` at rest, from ``positions[B, 33]``: contacts take up their load.

        Raises:
            DivergenceError: something was put inside something else.
        """
        states = np.concatenate([positions, np.zeros((len(positions), VELOCITIES))], axis=1)
        for step in range(round(seconds / STEP_SECONDS)):
            states = self._move(states, states[:, ARM].copy(), step)
            states[:, POSITIONS:] = 0.0
        return states

    def _move(self, states: Floats, joints: Floats, step: int) -> Floats:
        """One agent step in which the arm's joints go to ``joints[B, 7]``."""
        count = len(states)
        now = states[:, None, ARM]
        controls = now + self._ramp * (joints[:, None] - now)
        # Time begins at 0 in every step, so that it is no part of the state.
        initial = np.concatenate([np.zeros((count, 1)), states], axis=1)
        after = np.empty_like(initial)
        shares = [slice(n, None, len(self._data)) for n in range(len(self._data))]

        def run(data: mujoco.MjData, share: slice) -> None:
            self._run(data, initial[share], controls[share], after[share])

        with _quiet():
            if self._threads is None:
                run(self._data[0], shares[0])
            else:
                list(self._threads.map(run, self._data, shares))
        # A rollout that raised a warning stops, and with it its clock.
        wrong = after[:, 0] < STEP_SECONDS - TIME_STEP / 2
        wrong |= ~np.isfinite(after).all(axis=1)
        wrong |= (np.abs(after[:, 1 + POSITIONS :]) > _TOO_FAST).any(axis=1)
        if wrong.any():
            raise DivergenceError(np.flatnonzero(wrong).tolist(), step)
        return np.ascontiguousarray(after[:, 1:])

    def _run(self, data: mujoco.MjData, initial: Floats, controls: Floats, after: Floats) -> None:
        """Write ``after[B, 64]`` from ``initial[B, 64]``, time and state, and ``controls``."""
        moving = initial[:, 1 + POSITIONS :] != 0
        still = ~np.logical_or.reduceat(moving, self.model.tree_dofadr, axis=1)
        path = np.empty((1, SUBSTEPS, initial.shape[1]))
        for i in range(len(initial)):
            # One at a time and after a reset: who sleeps is left behind in ``data``.
            mujoco.mj_resetData(self.model, data)
            data.tree_asleep[still[i]] = _MAY_SLEEP
            self._rollout.rollout(
                [self.model],
                [data],
                initial[i : i + 1],
                controls[i : i + 1],
                skip_checks=True,
                nstep=SUBSTEPS,
                state=path,
            )
            after[i] = path[0, -1]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """No ``MUJOCO_LOG.TXT`` in the working folder: what goes wrong is an error of ours."""
    before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    quiet.logto_console = quiet.logto_file = False
    quiet.set()
    try:
        yield
    finally:
        before.set()


def checked_states(states: Floats) -> Floats:
    """States ``[B, 63]``, float64.

    Raises:
        ValueError: another shape, or numbers that are not finite.
    """
    array = np.asarray(states, np.float64)
    if array.ndim != 2 or array.shape[1] != STATE_SIZE:
        raise ValueError(f"states: expected shape [B, {STATE_SIZE}], got {list(array.shape)}")
    if not np.isfinite(array).all():
        raise ValueError("states: must be finite")
    return array


def end_effectors(states: Floats) -> Floats:
    """Positions of the fingertip in ``states[B, 63]``, m: ``[B, 3]``."""
    return panda.tool_positions(states[:, ARM], BASE)


def block_positions(states: Floats) -> Floats:
    """Centres of the cubes in ``states[B, 63]``, m: ``[B, 3, 3]``."""
    return states[:, BLOCKS].reshape(len(states), 3, 7)[:, :, :3]


OBSERVABLES = (
    *(f"end_effector_{axis}" for axis in "xyz"),
    "door",
    "drawer",
    *(f"button_{name}" for name in ("left", "middle", "right")),
    *(f"{block}_{axis}" for block in ("red", "green", "blue") for axis in "xyz"),
)
"""Names of what :func:`observables` gives, m."""


def observables(states: Floats) -> Floats:
    """What can be seen of ``states[B, 63]``, for probes: ``[B, 17]``, m, named ``OBSERVABLES``."""
    return np.concatenate(
        [
            end_effectors(states),
            states[:, [DOOR, DRAWER]],
            states[:, BUTTONS],
            block_positions(states).reshape(len(states), 9),
        ],
        axis=1,
    )
