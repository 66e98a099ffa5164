"""An evaluation with its domain open and its models loaded."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from hvf.agents.method import Means
from hvf.closing import Closing
from hvf.domains.domain import Place
from hvf.evaluation.acting import Outcome, Watcher, act, derived_seed
from hvf.evaluation.evaluation import Evaluation
from hvf.protocols import Agent, Trials
from hvf.registry import METHODS
from hvf.worlds.load import Loaded, Weights, kind_of, load, load_asked

_CHUNK, _CHUNK_IF_SLOW, _CHUNK_IF_SIMULATED = 25, 5, 2


class Task(Closing):
    """A method on the numbered episodes of a domain. Close it, or use it in a ``with`` block.

    Args:
        evaluation: which.
        place: its domain, open.
        own: whether the task closes the place.

    Attributes:
        agent: what acts.
        loaded: what it plans with; None for a method that does not plan.
        weights: the checkpoints that take part, by their part: those of ``loaded``, and "method".

    Raises:
        FileNotFoundError: models that are not there.
        ValueError: a checkpoint of another model, or a name that there is not.
    """

    def __init__(self, evaluation: Evaluation, place: Place, own: bool = False) -> None:
        self.evaluation = evaluation
        self.place = place
        self._own = own
        method, domain = METHODS[evaluation.method], evaluation.place
        searches = method.needs_generator and evaluation.subgoals > 0
        self.loaded: Loaded | None = None
        self.weights: dict[str, Weights] = {}
        if method.needs_dynamics:
            here = place.of_task(evaluation.task)
            self.loaded = load(
                domain, evaluation.world, evaluation.planning, here, generator=searches
            )
            self.weights |= self.loaded.weights
        model: Any = None
        if method.asks is not None and (evaluation.subgoals or not method.has_subgoals):
            self.weights["method"], model = load_asked(domain, evaluation.world, method.asks)
        low, high = domain.action_box
        dynamics = domain.resolved(evaluation.world).dynamics
        self.agent: Agent = method.agent(
            Means(
                evaluation.planning,
                evaluation.subgoals,
                low,
                high,
                None if self.loaded is None else self.loaded.world,
                None if self.loaded is None else self.loaded.generator,
                model,
                privileged=dynamics in domain.privileged,
            )
        )

    @classmethod
    def open(cls, evaluation: Evaluation, workers: int = 0) -> Task:
        """A task with a place of its own, which it closes.

        Args:
            evaluation: which.
            workers: processes that simulate and draw; 0 for as many as there are cores.

        Raises:
            RuntimeError: what the domain needs is not there; FileNotFoundError, ValueError.
        """
        place = evaluation.place.open(workers)
        try:
            return cls(evaluation, place, own=True)
        except BaseException:
            place.close()
            raise

    def close(self) -> None:
        """Close the place, if it is the task's own."""
        if self._own:
            self.place.close()

    @property
    def name(self) -> str:
        """What is evaluated, in a few words."""
        return self.evaluation.name

    @property
    def steps(self) -> int:
        """Most steps of an episode."""
        return self.evaluation.acting.steps

    @property
    def chunk(self) -> int:
        """Episodes that run together: few where one takes long, since a stop loses them.

        One where subgoals are searched for, or plans are made in Python: with a network as the
        dynamics or as the cost, each takes seconds.
        """
        place, loaded = self.evaluation.place, self.loaded
        if loaded is not None and loaded.generator is not None:
            return 1
        if place.resolved(self.evaluation.world).dynamics in place.privileged:
            return _CHUNK_IF_SIMULATED
        if loaded is not None and not _is_native(loaded.world):
            return 1
        return _CHUNK_IF_SLOW if place.slow else _CHUNK

    @property
    def kind(self) -> str:
        """What results may be compared with: see :attr:`hvf.worlds.load.Loaded.kind`."""
        simulated = self.loaded is not None and "dynamics" not in self.loaded.weights
        return "simulator" if simulated else kind_of(self.weights)

    @property
    def config(self) -> Mapping[str, Any]:
        """All settings, and checksums of the weights that take part; JSON's types."""
        evaluation, method = self.evaluation, METHODS[self.evaluation.method]
        return {
            "domain": evaluation.domain,
            "task": evaluation.task,
            "method": evaluation.method,
            "subgoals": evaluation.subgoals if method.has_subgoals else 0,
            "preset": evaluation.preset,
            "split": evaluation.split if evaluation.seed is None else None,
            "seed": evaluation.episode_seed,
            "world": evaluation.world_names,
            "kind": self.kind,
            "planning": dataclasses.asdict(evaluation.planning),
            "weights": {
                part: {"model": file.model, "sha256": file.sha256}
                for part, file in self.weights.items()
            },
        }

    def trials(self, first: int, count: int) -> Trials:
        """Fresh trials of episodes ``first..first + count``."""
        evaluation = self.evaluation
        return self.place.trials(evaluation.task, evaluation.episode_seed, first, count)

    def seeds(self, first: int, count: int) -> list[int]:
        """Seeds of the planning in these episodes."""
        seed = self.evaluation.episode_seed
        return [derived_seed(seed, index) for index in range(first, first + count)]

    def run(self, first: int, count: int, watchers: Sequence[Watcher] = ()) -> Outcome:
        """Run episodes ``first..first + count``."""
        trials, seeds = self.trials(first, count), self.seeds(first, count)
        return act(trials, self.agent, self.evaluation.acting, seeds, watchers)


def _is_native(world: Any) -> bool:
    """Whether the planner has the dynamics and the cost of a world in Rust."""
    return getattr(world, "native", None) is not None or type(world).__module__ == "hvf_core"
