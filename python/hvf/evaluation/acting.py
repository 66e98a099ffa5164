"""Acting towards subgoals and a goal, many trials in lock-step (design: paper, section 4).

Letters in shapes: ``B`` trials, ``N`` of them still running, ``K`` subgoals, ``A`` action
dimensions, ``T`` steps.

The rule: at every step, plan towards the current subgoal and take the plan's first action (an
agent may keep to a plan for a few steps, to plan less often). Go on to the next subgoal when the
observation is close enough to it, or after ``T*`` steps. The goal comes last. Success is asked of
the environment after every step, and ends a trial.

Subgoals may also be chosen anew on the way (``choose_anew``): those that are left, from what is
seen, when one is left behind; and all of them after ``T*`` steps towards the goal in vain, or as
many as there are steps left for.

A trial's result depends on its own seed only, not on which others run beside it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hvf.protocols import Agent, Frames, Images, Indices, Trials
from hvf.settings import Acting


@dataclass(frozen=True)
class Trial:
    """What became of one trial.

    Attributes:
        success: whether the environment said so within ``T`` steps.
        steps: steps taken.
        switches: steps before which the next aim was taken: at most ``K``, but for a trial whose
            subgoals were chosen anew.
        costs: predicted cost of the plan at every step; empty for an agent without plans.
        error: why it ended before its time, in failure: the environment broke down; else None.
    """

    success: bool
    steps: int
    switches: tuple[int, ...]
    costs: tuple[float, ...]
    error: str | None = None


@dataclass(frozen=True)
class Outcome:
    """What became of all trials, and how long it took.

    Attributes:
        trials: one for each, in order.
        subgoals: those that each began with: ``K`` images, or frames of the agent's world.
        search_seconds: wall time of choosing the subgoals of each, on the way, too.
        acting_seconds: wall time of deciding on actions.
        decisions: actions decided on.
    """

    trials: list[Trial]
    subgoals: list[Frames]
    search_seconds: list[float]
    acting_seconds: float
    decisions: int


class Watcher(Protocol):
    """Is told how trials go on, for progress and pictures."""

    def chosen(self, trial: int) -> None:
        """The subgoals of a trial are chosen."""
        ...

    def seen(self, step: int, which: Indices, observations: Images) -> None:
        """Before step ``step``, the trials ``which`` see ``observations[N]``."""
        ...

    def stepped(self, step: int, which: Indices) -> None:
        """The trials ``which`` took a step, their ``step``-th."""
        ...


def act(
    trials: Trials,
    agent: Agent,
    config: Acting,
    seeds: Sequence[int],
    watchers: Sequence[Watcher] = (),
) -> Outcome:
    """Run all trials to their end.

    Args:
        trials: fresh trials; they are stepped.
        agent: chooses subgoals and actions.
        config: the rule.
        seeds: one for each trial, ``[B]``; all of its randomness comes from it.
        watchers: are told of every choice and step.

    Raises:
        ValueError: seeds that are not as many as trials; whatever agent and environment raise.
    """
    count = len(trials)
    if len(seeds) != count:
        raise ValueError(f"seeds: must be one for each of {count} trials, got {len(seeds)}")
    agent.begin(trials)
    subgoals, search_seconds = [], []
    for trial, seed in enumerate(seeds):
        begin = time.perf_counter()
        subgoals.append(agent.choose(trial, derived_seed(seed, 0)))
        search_seconds.append(time.perf_counter() - begin)
        for watcher in watchers:
            watcher.chosen(trial)
    # What each trial aims at, by number: its subgoals, then the goal.
    goal = np.array([len(frames) for frames in subgoals], np.int64)
    most = goal.copy()
    aim, since = np.zeros(count, np.int64), np.zeros(count, np.int64)
    switches: list[list[int]] = [[] for _ in range(count)]
    costs: list[list[float]] = [[] for _ in range(count)]
    succeeded, taken = np.zeros(count, bool), np.zeros(count, np.int64)
    errors: dict[int, str] = {}
    acting_seconds, decisions = 0.0, 0

    def go_on(which: Indices, step: int) -> None:
        for trial in which:
            aim[trial] += 1
            since[trial] = 0
            if config.choose_anew and (not switches[trial] or switches[trial][-1] < step):
                choose_anew(int(trial), step, goal[trial] - aim[trial])
            switches[trial].append(step)

    def choose_anew(trial: int, step: int, count: int) -> bool:
        if count < 1:
            return False
        begin = time.perf_counter()
        found = agent.choose_anew(trial, derived_seed(seeds[trial], 0, step), count)
        search_seconds[trial] += time.perf_counter() - begin
        if found is None:
            return False
        aim[trial], goal[trial] = 0, len(found)
        return True

    def start_over(which: Indices, step: int) -> None:
        # Time for so many subgoals, and the goal.
        possible = (config.steps - step) // config.steps_per_subgoal - 1
        for trial in which:
            since[trial] = 0
            if choose_anew(int(trial), step, min(int(most[trial]), possible)):
                switches[trial].append(step)

    for step in range(config.steps):
        running = np.array([b for b in np.flatnonzero(~succeeded) if b not in errors], np.int64)
        if not len(running):
            break
        observations = trials.observe(running)
        for watcher in watchers:
            watcher.seen(step, running, observations)
        late = since[running] >= config.steps_per_subgoal
        in_vain = running[late & (aim == goal)[running]]
        go_on(running[late & (aim < goal)[running]], step)
        if config.choose_anew:
            start_over(in_vain, step)
        # One at a time: the next subgoal may be reached already.
        while config.reached == "observed" and (aim < goal)[running].any():
            aiming = (aim < goal)[running]
            left = agent.distances(
                running[aiming], observations[aiming], aim[running[aiming]], config.reached_blur
            )
            close = running[aiming][left < config.threshold]
            if not len(close):
                break
            go_on(close, step)
        begin = time.perf_counter()
        step_seeds = [derived_seed(seeds[int(trial)], 1 + step) for trial in running]
        decision = agent.act(running, observations, aim[running], step_seeds)
        actions, planned = decision.actions.copy(), decision.costs
        if config.reached == "planned" and planned is not None:
            planned = planned.copy()
            near = (planned < config.threshold) & (aim < goal)[running]
            if near.any():
                go_on(running[near], step)
                again = agent.act(
                    running[near],
                    observations[near],
                    aim[running[near]],
                    [seed for seed, is_near in zip(step_seeds, near, strict=True) if is_near],
                )
                actions[near] = again.actions
                assert again.costs is not None
                planned[near] = again.costs
        agent.acted(running, actions)
        acting_seconds += time.perf_counter() - begin
        decisions += len(running)
        broken = trials.step(running, actions)
        errors.update(broken)
        sound = np.array([trial not in broken for trial in running])
        running, planned = running[sound], planned if planned is None else planned[sound]
        since[running] += 1
        taken[running] += 1
        if planned is not None:
            for trial, cost in zip(running, planned, strict=True):
                costs[trial].append(float(cost))
        succeeded[running] = trials.success(running)
        for watcher in watchers:
            watcher.stepped(step + 1, running)
    results = [
        Trial(bool(succeeded[b]), int(taken[b]), tuple(switches[b]), tuple(costs[b]), errors.get(b))
        for b in range(count)
    ]
    return Outcome(results, subgoals, search_seconds, acting_seconds, decisions)


def derived_seed(*numbers: int) -> int:
    """A seed of its own for each tuple of numbers, from 0 to 2**64 - 1."""
    return int(np.random.SeedSequence(list(numbers)).generate_state(1, np.uint64)[0])
