"""Agents that plan with visual MPC; they differ in where their subgoals come from."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hvf_core
from hvf.agents.frames import has_images, images_of, joined, observed
from hvf.protocols import (
    Decision,
    Frames,
    Images,
    Indices,
    Measuring,
    Privileged,
    Remembering,
    SubgoalSource,
    SubgoalSourceAnew,
    Trials,
    WorldModel,
)
from hvf.settings import Replanning
from hvf_core import VisualMPC


class PlanningAgent:
    """Plans with visual MPC, towards subgoals of one source.

    Args:
        world: what it plans with.
        mpc: how it plans.
        source: where its subgoals come from.
        replanning: when it plans anew; at every step, if nothing else is said.
        privileged: plans start from frames of the trials (:class:`~hvf.protocols.Privileged`) and
            not from what is observed: for a simulator whose state cannot be read off an image.
    """

    def __init__(
        self,
        world: WorldModel[Any],
        mpc: VisualMPC,
        source: SubgoalSource,
        replanning: Replanning = Replanning(),
        privileged: bool = False,
    ) -> None:
        replanning.check(mpc.horizon)
        self.world = world
        self.mpc = mpc
        self.source = source
        self.replanning = replanning
        self.privileged = privileged
        self._trials: Trials | None = None
        # What each trial aims at, one after the other: images, or frames of the world.
        self._targets: dict[int, list[Any]] = {}
        self._plans: dict[int, _Current] = {}
        self._memory = _Memory(world) if isinstance(world, Remembering) else None

    def begin(self, trials: Trials) -> None:
        """Forget what was.

        Raises:
            ValueError: trials that tell no frames, for an agent that plans from them.
        """
        if self.privileged and not isinstance(trials, Privileged):
            kind = type(trials).__name__
            raise ValueError(f"dynamics: plan from true states, which {kind} does not tell")
        self._trials = trials
        self._targets.clear()
        self._plans.clear()
        if self._memory is not None:
            self._memory.clear()

    def choose(self, trial: int, seed: int) -> Frames:
        """Choose the subgoals of a trial."""
        assert self._trials is not None, "begin comes first"
        return self._aimed(trial, self.source(self._trials, trial, seed))

    def choose_anew(self, trial: int, seed: int, count: int) -> Frames | None:
        """Choose ``count`` subgoals from where a trial is now, if its source can."""
        assert self._trials is not None, "begin comes first"
        if not isinstance(self.source, SubgoalSourceAnew):
            return None
        start = None
        if self._memory is not None:
            which = np.array([trial])
            start = self._memory.recall(which, self._trials.observe(which))
        return self._aimed(trial, self.source.anew(self._trials, trial, seed, count, start))

    def _aimed(self, trial: int, found: Frames) -> Frames:
        """``found``, once they are what a trial aims at, before its goal."""
        assert self._trials is not None
        goal = self._trials.goals[trial]
        if has_images(found):
            self._targets[trial] = [*images_of(found), goal]
        else:
            each = [found[np.array([k])] for k in range(len(found))]
            self._targets[trial] = [*each, observed(self.world, goal[None])]
        return found

    def act(
        self, which: Indices, observations: Images, aims: Indices, seeds: Sequence[int]
    ) -> Decision:
        """Return the next actions of the best plans."""
        targets = [self._targets[int(b)][int(aim)] for b, aim in zip(which, aims, strict=True)]
        if self._memory is not None:
            self._memory.see(which, observations)
        due = [
            n
            for n, (trial, target) in enumerate(zip(which, targets, strict=True))
            if self._is_due(int(trial), target)
        ]
        if due:
            wanted, chosen = [targets[n] for n in due], [seeds[n] for n in due]
            self._plan(which[due], observations[due], wanted, chosen)
        current = [self._plans[int(trial)] for trial in which]
        actions = np.stack([plan.next_action() for plan in current])
        return Decision(actions, np.array([plan.cost for plan in current], np.float32))

    def acted(self, which: Indices, actions: NDArray[np.float32]) -> None:
        """Remember what was seen and done, for a world with context."""
        if self._memory is not None:
            self._memory.keep(which, actions)

    def distances(
        self, which: Indices, observations: Images, aims: Indices, blur: float
    ) -> NDArray[np.floating]:
        """Return how far observations are from what is aimed at.

        The world's own distance where it has one, else squared pixels through a blur.
        """
        targets = [self._targets[int(b)][int(aim)] for b, aim in zip(which, aims, strict=True)]
        aimed = _batch(self.world, targets)
        if isinstance(self.world, Measuring):
            frames = observed(self.world, aimed) if _are_images(targets) else aimed
            return np.asarray(self.world.distances(observed(self.world, observations), frames))
        images = aimed if _are_images(targets) else self.images(aimed)
        return hvf_core.image_cost(observations, images, blur=blur)

    def images(self, frames: Frames) -> Images:
        """Return images of frames of the world."""
        return images_of(frames, self.world)

    def _is_due(self, trial: int, target: Any) -> bool:
        """Whether a trial needs a new plan."""
        plan = self._plans.get(trial)
        if plan is None or plan.since >= self.replanning.every or plan.left == 0:
            return True
        return not _same(plan.target, target)

    def _plan(
        self, which: Indices, observations: Images, targets: list[Any], seeds: Sequence[int]
    ) -> None:
        last = elites = None
        if self.replanning.warm_start and all(int(trial) in self._plans for trial in which):
            before = [self._plans[int(trial)] for trial in which]
            last = np.stack([plan.before_last_action(plan.actions) for plan in before])
            elites = np.stack([plan.before_last_action(plan.elites) for plan in before])
        plans = self.mpc.plan_batch(
            self.world,
            self._starts(which, observations),
            _batch(self.world, targets),
            seeds=seeds,
            warm_start=last,
            warm_elites=elites,
        )
        found = zip(plans.actions, plans.elites, plans.costs, strict=True)
        for n, (trial, (actions, best, cost)) in enumerate(zip(which.tolist(), found, strict=True)):
            new = _Current(actions, best, float(cost), targets[n])
            old = self._plans.get(trial)
            if self.replanning.keep_better and old is not None and old.still_better(new):
                old.since = 0
            else:
                self._plans[trial] = new

    def _starts(self, which: Indices, observations: Images) -> Any:
        """Where plans start from."""
        if self.privileged:
            assert isinstance(self._trials, Privileged)
            return self._trials.frames(which)
        if self._memory is not None:
            return self._memory.recall(which, observations)
        return observations


@dataclasses.dataclass
class _Current:
    """A plan that is being acted; ``since`` counts steps since it was last weighed."""

    actions: NDArray[np.float32]
    elites: NDArray[np.float32]
    cost: float
    target: Any
    acted: int = 0
    since: int = 0

    @property
    def left(self) -> int:
        """Steps that have not been acted."""
        return len(self.actions) - self.acted

    def next_action(self) -> NDArray[np.float32]:
        action: NDArray[np.float32] = self.actions[self.acted]
        self.acted += 1
        self.since += 1
        return action

    def still_better(self, new: _Current) -> bool:
        """Whether the rest of this plan is worth more than a new one."""
        return self.left > 0 and self.cost <= new.cost and _same(self.target, new.target)

    def before_last_action(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """``actions [.., H, A]`` as the search wants them for a warm start.

        They begin with the last action acted; their last one is repeated where the plan has come to
        its end.
        """
        first = max(self.acted - 1, 0)
        steps = np.minimum(np.arange(len(self.actions)) + first, len(self.actions) - 1)
        rest: NDArray[np.float32] = actions[..., steps, :]
        return rest


class _Memory:
    """What trials have seen and done, as far back as a world with context looks."""

    def __init__(self, world: Any) -> None:
        self._world = world
        self._before = max(world.context - 1, 0)
        self._seen: dict[int, Images] = {}
        self._past: dict[int, list[tuple[Images, NDArray[np.float32]]]] = {}

    def clear(self) -> None:
        self._seen.clear()
        self._past.clear()

    def see(self, which: Indices, observations: Images) -> None:
        self._seen.update(zip(map(int, which), observations, strict=True))

    def keep(self, which: Indices, actions: NDArray[np.float32]) -> None:
        for trial, action in zip(map(int, which), actions, strict=True):
            past = self._past.setdefault(trial, [])
            past.append((self._seen[trial], action))
            del past[: max(len(past) - self._before, 0)]

    def recall(self, which: Indices, observations: Images) -> Any:
        images, actions = [], []
        size = len(self._world.action_low)
        for trial, now in zip(map(int, which), observations, strict=True):
            past = self._past.get(trial, [])
            first = past[0][0] if past else now
            missing = self._before - len(past)
            images.append(np.stack([first] * missing + [image for image, _ in past] + [now]))
            zeros = [np.zeros(size, np.float32)] * missing
            done = [*zeros, *(action for _, action in past)]
            actions.append(np.array(done, np.float32).reshape(self._before, size))
        return self._world.observe_history(np.stack(images), np.stack(actions))


def _are_images(targets: Sequence[Any]) -> bool:
    """Whether all targets are single images ``[H, W, 3]``, and not frames of a world."""
    return all(isinstance(target, np.ndarray) and target.ndim == 3 for target in targets)


def _batch(world: Any, targets: Sequence[Any]) -> Any:
    """Targets as the planner takes them: images ``[N, H, W, 3]`` where all are, else frames."""
    if _are_images(targets):
        return np.stack(targets)
    each = [target[None] if _are_images([target]) else target for target in targets]
    return joined(each, world)


def _same(a: Any, b: Any) -> bool:
    """Whether two targets are the same: the same object, or equal images."""
    if a is b:
        return True
    images = isinstance(a, np.ndarray) and isinstance(b, np.ndarray)
    return images and np.array_equal(a, b)
