"""Where an agent's subgoals come from (:class:`hvf.protocols.SubgoalSource`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvf.agents.frames import begun, observed
from hvf.protocols import (
    Frames,
    Images,
    Judging,
    Proposer,
    Proposing,
    SubgoalModel,
    SubgoalSource,
    Trials,
    TrueSubgoals,
    WorldModel,
)
from hvf_core import HVF


def no_subgoals(trials: Trials, trial: int, seed: int) -> Frames:
    """No subgoals: straight to the goal image (Finn & Levine, 2017)."""
    none: Frames = trials.goals[trial][None][:0]
    return none


def ground_truth(count: int) -> SubgoalSource:
    """The domain's own subgoals: the upper bound that the paper compares with."""

    def of_all(trials: Trials) -> Any:
        if not isinstance(trials, TrueSubgoals):
            kind = type(trials).__name__
            raise ValueError(f"method: 'ground-truth' needs true_subgoals, which {kind} lacks")
        return trials.true_subgoals(count)

    once = _Once(of_all)

    def source(trials: Trials, trial: int, seed: int) -> Frames:
        frames: Frames = once(trials)[trial]
        return frames

    return source


class Searched:
    """HVF: subgoal images found by search (paper, algorithm 2).

    Once, at the start, as in the paper; asked to, again on the way.

    Args:
        search: makes the search for a number of subgoals.
        count: subgoals at the start, ``K``.
        world: what it plans with.
        generator: what draws them.

    Attributes:
        progress: told how each search goes on, if not None: iteration, of how many, cost so far.
    """

    def __init__(
        self,
        search: Callable[[int], HVF],
        count: int,
        world: WorldModel[Any],
        generator: SubgoalModel[Any],
    ) -> None:
        self._search, self._count = search, count
        self._world, self._generator = world, generator
        self.progress: Callable[[int, int, float], object] | None = None
        # All at once, which is cheaper than one by one.
        self._ends = _Once(
            lambda trials: (
                begun(world, trials.observe(np.arange(len(trials)))),
                observed(world, trials.goals),
            )
        )

    def __call__(self, trials: Trials, trial: int, seed: int) -> Frames:
        """Search from the start of a trial."""
        starts, goals = self._ends(trials)
        index = np.array([trial])
        return self._found(starts[index], goals[index], seed, self._count)

    def anew(
        self, trials: Trials, trial: int, seed: int, count: int, start: Frames | None = None
    ) -> Frames:
        """Search from where a trial is now."""
        index = np.array([trial])
        now = begun(self._world, trials.observe(index)) if start is None else start
        return self._found(now, self._ends(trials)[1][index], seed, min(count, self._count))

    def _found(self, start: Any, goal: Any, seed: int, count: int) -> Frames:
        search = self._search(count)
        found = search.search(
            self._world, self._generator, start, goal, seed, progress=self.progress
        )
        frames: Frames = found.subgoals
        return frames


class Amortised(Searched):
    """Subgoals of a network that proposes them, without a search (paper, future work).

    Some are drawn of what the generator proposes, and the best of them by its own word is taken:
    what a search's first iteration is, with a hundredth of its samples.

    Args:
        search: whose reduction of segments counts, for a number of subgoals.
        count: subgoals at the start, ``K``.
        world: what it plans with.
        generator: draws and proposes.
        draws: draws, the first of which are the means; of a generator that cannot tell them apart
            (:class:`~hvf.protocols.Judging`) it is the only one.
    """

    def __init__(
        self,
        search: Callable[[int], HVF],
        count: int,
        world: WorldModel[Any],
        generator: Proposing[Any],
        draws: int,
    ) -> None:
        super().__init__(search, count, world, generator)
        self._proposing, self._draws = generator, draws

    def _found(self, start: Any, goal: Any, seed: int, count: int) -> Frames:
        generator = self._proposing
        found = generator.proposals(start, goal, count) if count else None
        if found is None:
            # Nothing to be asked, or the generator's prior.
            return super()._found(start, goal, seed, count)
        mean, std = (np.asarray(each, np.float32) for each in found)
        best = mean
        if isinstance(generator, Judging) and self._draws > 1:
            noise = np.random.default_rng(seed).standard_normal((self._draws, *mean.shape))
            noise[0] = 0.0
            latents = mean + std * noise.astype(np.float32)
            segments = np.asarray(generator.segment_costs(start, goal, latents))
            hard = _reduced(segments, self._search(count).reduction)
            best = latents[np.argmin(np.where(np.isnan(hard), np.inf, hard))]
        frames: Frames = generator.decode(start, best[None])
        return frames


def _reduced(
    segments: NDArray[np.floating[Any]], reduction: Literal["max", "mean", "max-sum"]
) -> NDArray[np.floating[Any]]:
    """Costs of samples, ``[M]``, from those of their segments, ``[M, K + 1]``, as of a search."""
    costs: NDArray[np.floating[Any]]
    if reduction == "mean":
        costs = segments.mean(axis=1)
        return costs
    costs = segments.max(axis=1)
    if reduction == "max-sum":
        costs = costs + HVF.TIE * segments.sum(axis=1)
    return costs


def proposed(count: int, proposer: Proposer) -> SubgoalSource:
    """Subgoal images that a model proposes between start and goal, once, at the start.

    Reads what trials show and nothing else.
    """

    def source(trials: Trials, trial: int, seed: int) -> Images:
        start = trials.observe(np.array([trial]))[0]
        return proposer.propose(start, trials.goals[trial], count)

    return source


class _Once:
    """What is made once for all trials, at the first one's turn."""

    def __init__(self, make: Callable[[Trials], Any]) -> None:
        self._make = make
        self._trials: Trials | None = None
        self._made: Any = None

    def __call__(self, trials: Trials) -> Any:
        if self._trials is not trials:
            self._trials, self._made = trials, self._make(trials)
        return self._made
