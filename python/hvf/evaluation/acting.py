"""Acting towards subgoals and a goal, many trials in lock-step (design: paper, section 4).

Letters in shapes: ``B`` trials, ``N`` of them still running, ``K`` subgoals, ``A`` action
dimensions, ``T`` steps.

The rule: at every step, plan towards the current subgoal and take the plan's first action (an
agent may keep to a plan for a few steps, to plan less often). Go on to the next subgoal when the
observation is close enough to it, or after ``T*`` steps. The goal comes last. Success is asked of
the environment after every step, and ends a trial.

A trial's result depends on its own seed only, not on which others run beside it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

import hvf_core
from hvf.settings import Acting

Images = NDArray[np.uint8]
Indices = NDArray[np.int64]


class Trials(Protocol):
    """``B`` episodes of an environment, side by side."""

    @property
    def goals(self) -> Images:
        """Goal images, uint8 ``[B, H, W, 3]``."""
        ...

    def __len__(self) -> int:
        """Return ``B``."""
        ...

    def observe(self, which: Indices) -> Images:
        """Return the images that the trials ``which`` see now, uint8 ``[N, H, W, 3]``."""
        ...

    def step(self, which: Indices, actions: NDArray[np.float32]) -> Mapping[int, str]:
        """Apply ``actions[N, A]`` to the trials ``which``.

        Returns:
            Those of them that cannot go on, with the reason: number of the trial to words.
        """
        ...

    def success(self, which: Indices) -> NDArray[np.bool_]:
        """Return whether the trials ``which`` are where they should be, ``[N]``."""
        ...


@dataclass(frozen=True)
class Decision:
    """What an agent does.

    Attributes:
        actions: float32 ``[N, A]``.
        costs: predicted cost of the plans that they begin, float32 ``[N]``; None without plans.
    """

    actions: NDArray[np.float32]
    costs: NDArray[np.float32] | None = None


class Agent(Protocol):
    """Chooses subgoals once per trial, and an action at every step."""

    def subgoals(self, trials: Trials, seeds: Sequence[int]) -> list[Images]:
        """Return the subgoals of every trial, in order: ``B`` arrays uint8 ``[K, H, W, 3]``."""
        ...

    def act(
        self, which: Indices, observations: Images, targets: Images, seeds: Sequence[int]
    ) -> Decision:
        """Decide for the trials ``which``: from ``observations[N]`` towards ``targets[N]``."""
        ...


@dataclass(frozen=True)
class Trial:
    """What became of one trial.

    Attributes:
        success: whether the environment said so within ``T`` steps.
        steps: steps taken.
        switches: steps before which the next subgoal was taken, at most ``K``.
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
        subgoals: the subgoals of each, uint8 ``[K, H, W, 3]``.
        search_seconds: wall time of choosing all subgoals.
        acting_seconds: wall time of deciding on actions.
        decisions: actions decided on.
    """

    trials: list[Trial]
    subgoals: list[Images]
    search_seconds: float
    acting_seconds: float
    decisions: int


def act(
    trials: Trials,
    agent: Agent,
    config: Acting,
    seeds: Sequence[int],
    after_step: Callable[[int, Indices], None] | None = None,
) -> Outcome:
    """Run all trials to their end.

    Args:
        trials: fresh trials; they are stepped.
        agent: chooses subgoals and actions.
        config: the rule.
        seeds: one for each trial, ``[B]``; all of its randomness comes from it.
        after_step: called with the number of steps taken and the trials that took the last one.

    Raises:
        ValueError: seeds that are not as many as trials; whatever agent and environment raise.
    """
    count = len(trials)
    if len(seeds) != count:
        raise ValueError(f"seeds: must be one for each of {count} trials, got {len(seeds)}")
    begin = time.perf_counter()
    subgoals = agent.subgoals(trials, seeds)
    search_seconds = time.perf_counter() - begin
    # What each trial aims at, one after the other.
    aims = [[*chosen, goal] for chosen, goal in zip(subgoals, trials.goals, strict=True)]
    current, since = np.zeros(count, np.int64), np.zeros(count, np.int64)
    switches: list[list[int]] = [[] for _ in range(count)]
    costs: list[list[float]] = [[] for _ in range(count)]
    succeeded, taken = np.zeros(count, bool), np.zeros(count, np.int64)
    errors: dict[int, str] = {}
    acting_seconds, decisions = 0.0, 0

    def aim(which: Indices) -> Images:
        return np.stack([aims[trial][current[trial]] for trial in which])

    def go_on(which: Indices, step: int) -> None:
        for trial in which:
            current[trial] += 1
            since[trial] = 0
            switches[trial].append(step)

    def aiming_at_subgoal(which: Indices) -> NDArray[np.bool_]:
        return np.array([current[trial] + 1 < len(aims[trial]) for trial in which])

    for step in range(config.steps):
        running = np.array([b for b in np.flatnonzero(~succeeded) if b not in errors], np.int64)
        if not len(running):
            break
        observations = trials.observe(running)
        go_on(
            running[aiming_at_subgoal(running) & (since[running] >= config.steps_per_subgoal)], step
        )
        if config.reached == "observed":
            # One at a time: the next subgoal may be reached already.
            while True:
                left = hvf_core.image_cost(observations, aim(running), blur=config.reached_blur)
                close = (left < config.threshold) & aiming_at_subgoal(running)
                if not close.any():
                    break
                go_on(running[close], step)
        begin = time.perf_counter()
        step_seeds = [derived_seed(seeds[int(trial)], 1 + step) for trial in running]
        decision = agent.act(running, observations, aim(running), step_seeds)
        actions, planned = decision.actions.copy(), decision.costs
        if config.reached == "planned" and planned is not None:
            planned = planned.copy()
            close = (planned < config.threshold) & aiming_at_subgoal(running)
            if close.any():
                go_on(running[close], step)
                again = agent.act(
                    running[close],
                    observations[close],
                    aim(running[close]),
                    [seed for seed, is_close in zip(step_seeds, close, strict=True) if is_close],
                )
                actions[close] = again.actions
                assert again.costs is not None
                planned[close] = again.costs
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
        if after_step is not None:
            after_step(step + 1, running)
    results = [
        Trial(bool(succeeded[b]), int(taken[b]), tuple(switches[b]), tuple(costs[b]), errors.get(b))
        for b in range(count)
    ]
    return Outcome(results, subgoals, search_seconds, acting_seconds, decisions)


def derived_seed(*numbers: int) -> int:
    """A seed of its own for each tuple of numbers, from 0 to 2**64 - 1."""
    return int(np.random.SeedSequence(list(numbers)).generate_state(1, np.uint64)[0])
