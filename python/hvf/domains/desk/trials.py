"""Episodes of the Franka desk, side by side, in the true simulator."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hvf.envs.desk.pool import DeskPool
from hvf.envs.desk.rendering import project
from hvf.envs.desk.simulator import DeskSimulator, DivergenceError, Floats, end_effectors
from hvf.envs.desk.tasks import TaskName, make_episodes, object_success
from hvf.protocols import Images, Indices
from hvf.worlds.mujoco import DeskFrames


class DeskTrials:
    """Episodes ``first..first + count`` of a task, side by side, in the true simulator.

    Args:
        pool: draws the images; its image size ``S`` is theirs.
        seed: seed of the episodes.
        first: number of the first.
        count: how many, ``B``.
        task: name of the task.

    Attributes:
        states: where they are, float64 ``[B, 63]``.
        episodes: where they begin and should end.
    """

    def __init__(self, pool: DeskPool, seed: int, first: int, count: int, task: TaskName) -> None:
        self.pool = pool
        self.simulator = DeskSimulator()
        self.episodes = make_episodes(self.simulator, task, seed, first, count)
        self.states = self.episodes.starts.copy()
        self._seed, self._first = seed, first
        self._taken = np.zeros(count, np.int64)
        self._goals = pool.render(self.episodes.goals)

    @property
    def goals(self) -> Images:
        """Goal images, uint8 ``[B, S, S, 3]``."""
        return self._goals

    def __len__(self) -> int:
        """Return the number of episodes, ``B``."""
        return len(self.states)

    def observe(self, which: Indices) -> Images:
        """Return images of the desks now."""
        return self.pool.render(self.states[which])

    def frames(self, which: Indices) -> DeskFrames:
        """Return images and states of the desks now."""
        return DeskFrames(self.observe(which), self.states[which])

    def step(self, which: Indices, actions: NDArray[np.float32]) -> dict[int, str]:
        """Apply ``actions[N, 3]`` for 0.2 s.

        Returns:
            Those of which the simulation diverged, which stay where they were: number of the
            trial to words that name seed, episode and step.
        """
        errors: dict[int, str] = {}
        while len(which):
            try:
                self.states[which] = self.simulator.step(self.states[which], actions)
                break
            except DivergenceError as error:
                for trial in which[error.which].tolist():
                    where = f"episode {self._first + trial}, step {self._taken[trial]}"
                    errors[trial] = f"the simulation diverged: seed {self._seed}, {where}"
                which, actions = np.delete(which, error.which), np.delete(actions, error.which, 0)
        self._taken[which] += 1
        return errors

    def success(self, which: Indices) -> NDArray[np.bool_]:
        """Return whether everything is where the task wants it."""
        blocks, states = self.episodes.blocks[which], self.states[which]
        objects = object_success(self.episodes.task, blocks, states)
        return np.asarray(objects.all(axis=1))

    def true_subgoals(self, count: int) -> Images:
        """Return images of states on the way, ``[B, count, S, S, 3]``.

        These are the states after each of the task's ``J`` objects but the last. Where that is
        fewer than asked for, also those in which the finger is beside each object, ready to push
        it: ``2 J - 1`` in all. Where that is still fewer, five states for each object, see
        :class:`~hvf.envs.desk.tasks.Episodes`: ``5 J - 1``. They are chosen evenly; beyond that,
        the last is repeated.
        """
        ways, stages = self.episodes.ways, self.episodes.stages
        objects = stages.shape[1]
        if count < objects:
            ways = stages[:, :, None]
        elif count < 2 * objects:
            ways = np.stack([self.episodes.approaches, stages], axis=2)
        way = ways.reshape(len(self), -1, stages.shape[-1])[:, :-1]
        most = way.shape[1]
        # All of them, or the middle ones of equal parts.
        chosen = np.minimum(np.arange(count), most - 1)
        if count < most:
            chosen = (np.arange(1, count + 1) * (most + 1)) // (count + 1) - 1
        images = self.pool.render(way[:, chosen].reshape(-1, stages.shape[-1]))
        return images.reshape(len(self), count, *images.shape[1:])

    def positions(self, which: Indices) -> Floats:
        """Return where the fingertips are in the images now, pixels, ``[N, 2]``."""
        return project(end_effectors(self.states[which]), self.pool.image_size)

    def target(self, trial: int) -> None:
        """Return nothing: the fingertip may end anywhere."""
