"""Random interaction at the Franka desk.

Frames are ``image_size`` pixels wide; actions are float32 ``[T, 3]``; states are what
:func:`hvf.envs.desk.simulator.observables` gives, 17 lengths in metres. ``N`` episodes of ``T``
steps.

The paper draws a new random action every step. Here each is held for ``action_repeat`` steps: 1 is
the paper's, 3 moves door and drawer in more episodes, and is what the shipped models learned from.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from concurrent.futures import wait
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from hvf.data.collect import CollectConfig, collect
from hvf.data.episodes import Episodes
from hvf.envs.desk.arrangement import random_arrangement, settled
from hvf.envs.desk.pool import DeskPool, Worker
from hvf.envs.desk.simulator import (
    ACTION_SIZE,
    OBSERVABLES,
    STATE_SIZE,
    DivergenceError,
    Floats,
    observables,
)
from hvf.interrupts import Interrupts

# Ends the key of a random stream. Tasks end theirs with their number or, as NumPy sees it, zeros;
# so no collected episode starts where one of a task does, at whatever seed.
_COLLECTION = 0xC0113C7

_TRIES = 10
# Seconds between two looks whether somebody wants the work to stop.
_PATIENCE = 0.2
# Episodes that a process steps side by side; inverse kinematics is faster on many arms.
_SIDE_BY_SIDE = 25


@dataclasses.dataclass(frozen=True)
class DeskCollection(CollectConfig):
    """How much to collect at the desk, and where to put it.

    Door, drawer, cubes and arm start anywhere.

    Attributes:
        part: episodes written at a time; a stop loses no more than these.
        action_repeat: steps for which each random action is held. The paper draws a new one every
            step; 3 moves door and drawer in more episodes than 1.
        workers: processes; 0 for as many as there are cores. The result does not depend on it.
    """

    part: int = 100
    action_repeat: int = 1
    workers: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action_repeat < 1:
            raise ValueError(f"action_repeat must be at least 1, got {self.action_repeat}")
        if self.workers < 0:
            raise ValueError(f"workers must not be negative, got {self.workers}")

    def run(self, console: Console | None = None) -> Path:
        """Collect, on all cores.

        An episode whose simulation diverges is said so, counted in the file, and drawn anew.

        Raises:
            FileExistsError, ValueError, OSError, KeyboardInterrupt: as
                :func:`hvf.data.collect.collect`.
            RuntimeError: no OpenGL (names the Debian package), or an episode that diverged ten
                times.
        """
        console = console or Console()
        with DeskPool(self.workers, self.image_size) as pool, Interrupts() as interrupts:
            return collect(
                self,
                "desk",
                {
                    "image_size": self.image_size,
                    "policy": "uniform",
                    "action_repeat": self.action_repeat,
                    "states": list(OBSERVABLES),
                    "stream": "collection",
                },
                lambda *which: self._rollouts(pool, interrupts, console, *which),
                console,
                {"mujoco": version("mujoco")},
                cameras=("front",),
                action_names=("dx", "dy", "dz"),
                action_low=(-1.0,) * ACTION_SIZE,
                action_high=(1.0,) * ACTION_SIZE,
            )

    def _rollouts(
        self,
        pool: DeskPool,
        interrupts: Interrupts,
        console: Console,
        seed: int,
        first: int,
        count: int,
        steps: int,
    ) -> Episodes:
        size = max(1, min(_SIDE_BY_SIDE, -(-count // pool.workers)))
        parts = [
            pool.submit(
                random_episodes,
                seed,
                range(begin, min(begin + size, first + count)),
                steps,
                self.action_repeat,
            )
            for begin in range(first, first + count, size)
        ]
        while wait(parts, timeout=_PATIENCE).not_done:
            interrupts.check()
        interrupts.check()
        made = [part.result() for part in parts]
        for _, diverged in made:
            for line in diverged:
                console.print(line)
        frames, actions, states = (
            np.concatenate([getattr(episodes, name) for episodes, _ in made])
            for name in ("frames", "actions", "states")
        )
        return Episodes(frames, actions, states, sum(len(diverged) for _, diverged in made))


def stream(seed: int, number: int, attempt: int = 0) -> np.random.Generator:
    """What draws the start and the actions of a collected episode, in its n-th attempt."""
    return np.random.default_rng((seed, number, attempt, _COLLECTION))


def random_episodes(
    worker: Worker, seed: int, numbers: Iterable[int], steps: int, action_repeat: int
) -> tuple[Episodes, list[str]]:
    """Episodes with these numbers, and a line for each simulation that diverged on the way.

    Raises:
        DivergenceError: an episode diverged in each of ten tries.
    """
    numbers = list(numbers)
    lines: list[str] = []
    states = np.empty((len(numbers), steps + 1, STATE_SIZE))
    actions = np.empty((len(numbers), steps, ACTION_SIZE), np.float32)
    todo = np.arange(len(numbers))
    for attempt in range(_TRIES):
        seeds = [(seed, numbers[i], attempt) for i in todo]
        failed = _try(worker, seeds, action_repeat, states, actions, todo)
        for i, step in failed.items():
            lines.append(
                f"seed {seed}, episode {numbers[i]}: the simulation diverged in step {step}"
            )
        todo = np.array(sorted(failed), np.int64)
        if not len(todo):
            break
    else:
        raise DivergenceError(todo.tolist(), -1, f"{lines[-1]}, as in {_TRIES - 1} tries before")
    size = worker.renderer.image_size
    frames = np.empty((len(numbers), steps + 1, size, size, 3), np.uint8)
    for episode, seen in zip(states, frames, strict=True):
        worker.check()
        seen[...] = worker.renderer.render(episode)
    seen_states = np.stack([observables(episode) for episode in states])
    return Episodes(frames, actions, seen_states), lines


def _try(
    worker: Worker,
    seeds: list[tuple[int, int, int]],
    action_repeat: int,
    states: Floats,
    actions: NDArray[np.float32],
    places: NDArray[np.int64],
) -> dict[int, int]:
    """Fill ``states[places]`` and ``actions[places]``, but for those that diverge.

    Returns:
        Place to the step in which it diverged.
    """
    steps = actions.shape[1]
    starts = []
    for place, key in zip(places, seeds, strict=True):
        rng = stream(*key)
        starts.append(random_arrangement(rng, None))
        drawn = rng.uniform(-1.0, 1.0, (-(-steps // action_repeat), ACTION_SIZE))
        actions[place] = np.repeat(drawn, action_repeat, axis=0)[:steps]
    states[places, 0] = settled(worker.simulator, starts)
    failed: dict[int, int] = {}
    for step in range(steps):
        worker.check()
        while len(places):
            try:
                after = worker.simulator.step(states[places, step], actions[places, step])
            except DivergenceError as error:
                failed |= {int(places[i]): step for i in error.which}
                places = np.delete(places, error.which)
                continue
            states[places, step + 1] = after
            break
    return failed
