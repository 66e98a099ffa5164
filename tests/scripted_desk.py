"""A controller that reads the desk's state: it shows that the tasks can be done, nothing more.

Alone it counts successes, over as many trials as asked for:

    python tests/scripted_desk.py --trials 50
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hvf.envs.desk.scene import (
    BLOCK_SIZE,
    DRAWER_HANDLE_GAP,
    HANDLE_CLOSED_Y,
    HANDLE_RADIUS,
    HANDLE_X,
    HUTCH_X,
)
from hvf.envs.desk.simulator import (
    DOOR,
    DRAWER,
    STEP_LENGTH,
    WORKSPACE,
    DeskSimulator,
    Floats,
    block_positions,
    end_effectors,
)
from hvf.envs.desk.tasks import MAX_STEPS, OFF_TABLE, TASKS, TaskName, make_episodes, object_success

HIGH, LOW = 0.12, 0.03
BESIDE = BLOCK_SIZE / np.sqrt(2) + 0.022 + 0.012
"""From a cube's centre to the finger's, beside it however it is turned."""
BESIDE_HANDLE = HANDLE_RADIUS + 0.022 + 0.014


class Script:
    """Does one episode's objects one after the other: outer cubes first, the door last."""

    def __init__(self, task: TaskName, blocks: NDArray[np.bool_], goal: Floats) -> None:
        self.task, self.blocks, self.goal = task, blocks, goal
        self._plan: Iterator[Floats] | None = None
        self.state = np.zeros(0)

    def act(self, state: Floats) -> Floats:
        """The action ``[3]`` in ``state[63]``."""
        self.state = state
        if self._plan is None:
            self._plan = self._script()
        return next(self._plan, np.zeros(3))

    # ---- what the state says -------------------------------------------------------------------

    def tip(self) -> Floats:
        return end_effectors(self.state[None])[0]

    def block(self, i: int) -> Floats:
        return block_positions(self.state[None])[0, i]

    # ---- what to do ----------------------------------------------------------------------------

    def _script(self) -> Iterator[Floats]:
        for _ in range(4):
            order = sorted(np.flatnonzero(self.blocks), key=lambda i: -abs(self.block(i)[1]))
            for i in order:
                if self.block(i)[2] > OFF_TABLE:
                    yield from self._push_off(int(i))
            if "door" in self.task:
                yield from self._close_door()

    def _push_off(self, i: int) -> Iterator[Floats]:
        # To the side on which the goal has it.
        side = np.sign(block_positions(self.goal[None])[0, i, 1])
        yield from self._rise()
        x, y, _ = self.block(i)
        yield from self._over(x, y - side * BESIDE)
        yield from self._go((x, y - side * BESIDE, LOW), 4)
        for _ in range(14):
            x, y, z = self.block(i)
            if z < OFF_TABLE:
                break
            # Stay behind the cube's middle while it slides.
            yield self._towards((x, self.tip()[1] + side * STEP_LENGTH, LOW), speed=0.9)
        yield from self._rise()

    def _close_door(self) -> Iterator[Floats]:
        if self.state[DOOR] < 0.015:
            return
        handle = HANDLE_CLOSED_Y + self.state[DOOR]
        start = min(handle + BESIDE_HANDLE, WORKSPACE[1, 1])
        yield from self._rise()
        # Between cubes and handle: behind it in y first, and from the front.
        yield from self._go((HANDLE_X - 0.09, start, HIGH), 12)
        yield from self._go((HANDLE_X, start, HIGH), 4)
        for _ in range(12):
            if self.state[DOOR] < 0.012:
                break
            yield self._towards((HANDLE_X, self.tip()[1] - STEP_LENGTH, HIGH))
        yield from self._go((HANDLE_X - 0.09, self.tip()[1] + 0.02, HIGH), 3)

    def open_drawer(self) -> Iterator[Floats]:
        """Not part of a task: hook the drawer's bar from behind and pull."""
        front = HUTCH_X - self.state[DRAWER]
        behind = front - DRAWER_HANDLE_GAP / 2 - 0.002
        yield from self._rise()
        yield from self._go((behind, 0.20, HIGH), 12)
        yield from self._go((behind, 0.20, LOW), 5)
        for _ in range(4):
            yield self._towards((self.tip()[0] - 0.06, 0.20, LOW))

    def _rise(self) -> Iterator[Floats]:
        x, y, _ = self.tip()
        yield from self._go((min(x, 0.52), y, HIGH), 3)

    def _over(self, x: float, y: float) -> Iterator[Floats]:
        yield from self._go((x, y, HIGH), 12)

    def _go(self, place: tuple[float, float, float], steps: int) -> Iterator[Floats]:
        wanted = np.clip(place, *WORKSPACE)
        for _ in range(steps):
            if np.abs(self.tip() - wanted).max() < 0.006:
                return
            yield self._towards(place)

    def _towards(self, place: tuple[float, float, float], speed: float = 1.0) -> Floats:
        move = (np.clip(place, *WORKSPACE) - self.tip()) / STEP_LENGTH
        return move / max(1.0, np.abs(move).max() / speed)


def successes(task: TaskName, trials: int, seed: int = 0, threads: int = 1) -> NDArray[np.bool_]:
    """Which of the first ``trials`` episodes of a task the script does in the paper's limit."""
    simulator = DeskSimulator(threads=threads)
    episodes = make_episodes(simulator, task, seed, 0, trials)
    scripts = [
        Script(task, blocks, goal)
        for blocks, goal in zip(episodes.blocks, episodes.goals, strict=True)
    ]
    states, done = episodes.starts, np.zeros(trials, bool)
    for _ in range(MAX_STEPS[task]):
        actions = np.stack(
            [script.act(state) for script, state in zip(scripts, states, strict=True)]
        )
        states = simulator.step(states, actions)
        done |= object_success(task, episodes.blocks, states).all(axis=1)
        if done.all():
            break
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for task in TASKS:
        done = successes(task, arguments.trials, arguments.seed)
        failed = np.flatnonzero(~done).tolist()
        print(f"{task}: {done.sum()} of {len(done)}, failed {failed}")


if __name__ == "__main__":
    main()
