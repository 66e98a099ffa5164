"""The Franka desk: its episodes as trials, its settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hvf.envs.desk.pool import DeskPool
from hvf.envs.desk.rendering import project
from hvf.envs.desk.simulator import DeskSimulator, DivergenceError, Floats, end_effectors
from hvf.envs.desk.tasks import MAX_STEPS, TaskName, check_task, make_episodes, object_success
from hvf.evaluation.acting import Images, Indices
from hvf.evaluation.task import EpisodeTask, Evaluation
from hvf.settings import Acting, Planning, Replanning
from hvf.worlds.desk import DeskWorldConfig, GeneratorName, ModelName, load_desk
from hvf.worlds.mujoco import DeskFrames

_HINT = (
    "`hvf train desk-generator` and `hvf train desk-subgoals` make them, and desk_generator and "
    "vae name them"
)

Preset: TypeAlias = Literal["default", "paper", "simulator"]


@dataclasses.dataclass(frozen=True)
class DeskPlanning(Planning):
    """How agents plan and act at the desk; see :class:`~hvf.settings.Planning`.

    By default few elites are kept and compete again, and each search begins around the rest of the
    last plan; the paper does neither. Pushing a cube takes a plan that few candidates come near.

    Attributes:
        initial_std: standard deviation of a normal first distribution, in units of the action;
            the paper's is 1, which for most actions means full speed.
        horizon: model steps that a plan looks ahead (H).
        action_repeat: steps that one planned action is held for; the paper plans 5 actions.
        replan_every: steps of a plan that are acted before the next one is made.
        keep_better: go on with the rest of a plan as long as no new one has a lower predicted
            cost: for budgets so small that a good plan may not be found again.
        steps_per_subgoal: most steps towards one subgoal (T*).
        steps: steps of a trial (T); None for the task's own limit, 50 or 100.
    """

    elites: int = 10
    keep_elites: int = 10
    warm_start: bool = True
    initial: Literal["uniform", "normal"] = "normal"
    initial_std: float = 1.0
    horizon: int = 15
    subgoal_samples: int = 20
    subgoal_elites: int = 5
    subgoal_iterations: int = 2
    action_repeat: int = 3
    replan_every: int = 3
    keep_better: bool = False
    steps_per_subgoal: int = 20
    steps: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps is not None:
            self.rule(self.steps)

    @property
    def replanning(self) -> Replanning:
        """When to make a new plan."""
        return Replanning(self.replan_every, self.keep_better, self.warm_start)

    def _actions(self) -> dict[str, Any]:
        return {
            "initial": self.initial,
            "initial_std": self.initial_std,
            "action_repeat": self.action_repeat,
        }


@dataclasses.dataclass(frozen=True)
class DeskEvaluation(Evaluation):
    """One cell of the results: an agent, a world to plan with, a task.

    The ground-truth subgoals are states on the way; see :meth:`DeskTrials.true_subgoals`.

    Attributes:
        task: what is to be done: "door", "two_block", "door_block" or "door_two_block".
        model: what is planned with: learned models, or the true simulator (not for agent hvf: a
            drawn subgoal has no state that a simulation could start from).
        dynamics: checkpoint of the learned dynamics; None for the shipped one.
        generator: where subgoals come from: learned "states", or the paper's "vae" on images.
        desk_generator: checkpoint of the generator of states; None for the shipped one.
        vae: checkpoint of the VAE; none ships.
        planning: how agents plan and act.
    """

    presets: ClassVar[Mapping[str, Planning]] = {
        "default": DeskPlanning(),
        "paper": DeskPlanning(
            elites=40,
            keep_elites=0,
            warm_start=False,
            replan_every=1,
            subgoal_samples=200,
            subgoal_elites=40,
            subgoal_iterations=5,
        ),
        # What a core can pay for true dynamics: 256 candidates, each one action that is held for
        # three steps and then acted to its end, since it does just what was predicted. So few find
        # the thin arm of a goal image only through a blur.
        "simulator": DeskPlanning(
            samples=64,
            elites=8,
            iterations=4,
            keep_elites=2,
            warm_start=False,
            initial_std=0.75,
            horizon=3,
            replan_every=3,
            blur=3.0,
            steps_per_subgoal=6,
            threshold=5e-4,
            reached_blur=2.0,
        ),
    }

    preset_settings: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "simulator": {"model": "simulator", "agent": "none"},
    }

    task: TaskName = "door_two_block"
    model: ModelName = "learned"
    generator: GeneratorName = "states"
    dynamics: Path | None = None
    desk_generator: Path | None = None
    vae: Path | None = None
    planning: DeskPlanning = DeskPlanning()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_task(self.task)
        _ = self.world
        if self.agent == "hvf" and self.model == "simulator":
            raise ValueError(
                "agent: 'hvf' needs model='learned': no simulation can start from a drawn subgoal"
            )

    @property
    def name(self) -> str:
        """What is evaluated, in a few words."""
        world = "" if self.agent == "random" else f", {self.model}"
        return f"desk {self.task}: {self.agent_name}{world}"

    @property
    def acting(self) -> Acting:
        """The rule of acting."""
        return self.planning.rule(self.planning.steps or MAX_STEPS[self.task])

    @property
    def world(self) -> DeskWorldConfig:
        """What to plan with."""
        return DeskWorldConfig(
            # Acting at random needs no model.
            model="simulator" if self.agent == "random" else self.model,
            blur=self.planning.blur,
            over_horizon=self.planning.over_horizon,
            generator=self.generator,
            dynamics=self.dynamics,
            desk_generator=self.desk_generator,
            vae=self.vae,
        )


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

    def positions(self, states: Floats) -> Floats:
        """Return where the fingertips of ``states[N, 63]`` are in the images, pixels."""
        return project(end_effectors(states), self.pool.image_size)

    def target(self, trial: int) -> None:
        """Return nothing: the fingertip may end anywhere."""


class DeskTask(EpisodeTask[DeskTrials]):
    """An evaluation at the desk with its models loaded, and processes to simulate and draw in.

    Args:
        evaluation: what to evaluate.
        workers: processes, 0 for as many as there are cores; results do not depend on it.
        pool: processes to share with others; the task does not close them.

    Raises:
        FileNotFoundError: models that are not there.
        RuntimeError: no OpenGL; names the Debian package to install.
    """

    evaluation: DeskEvaluation

    def __init__(
        self, evaluation: DeskEvaluation, workers: int = 0, pool: DeskPool | None = None
    ) -> None:
        world = evaluation.world
        self.pool = pool or DeskPool(workers)
        self._shared = pool is not None
        try:
            loaded, generator = load_desk(world, self.pool)
            if evaluation.agent == "hvf" and generator is None:
                raise FileNotFoundError(f"{evaluation.generator}: no such generator; {_HINT}")
            told = world.model == "simulator"
            super().__init__(evaluation, loaded, generator, world.checkpoints, told)
        except BaseException:
            self.close()
            raise

    def trials(self, first: int, count: int) -> DeskTrials:
        """Fresh trials of episodes ``first..first + count``."""
        evaluation = self.evaluation
        return DeskTrials(self.pool, evaluation.seed, first, count, evaluation.task)

    def close(self) -> None:
        """Stop the processes, unless they are shared."""
        if not self._shared:
            self.pool.close()
