"""Methods: what is compared in an evaluation, by name.

A method of another package is a :class:`Method` registered in ``hvf.registry.METHODS`` or by an
entry point of the group ``hvf.methods``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvf.agents.planning import PlanningAgent
from hvf.agents.policy import PolicyAgent
from hvf.agents.random import RandomAgent
from hvf.agents.subgoals import Amortised, Searched, ground_truth, no_subgoals, proposed
from hvf.protocols import (
    Agent,
    Policy,
    Proposals,
    Proposer,
    Proposing,
    SubgoalModel,
    SubgoalSource,
    WorldModel,
)
from hvf.settings import Planning


@dataclass(frozen=True)
class Means:
    """What an agent is made of.

    Attributes:
        planning: how it plans.
        subgoals: number of subgoals, ``K``.
        action_low: lowest action, float32 ``[A]``.
        action_high: highest action, float32 ``[A]``.
        world: what it plans with; None for a method that needs no dynamics.
        generator: what draws subgoals; None for a method that needs none.
        model: what the method asks of its own: a :class:`~hvf.protocols.Proposer`,
            :class:`~hvf.protocols.Proposals`, a :class:`~hvf.protocols.Policy`; None for
            a method that asks nothing.
        privileged: plans start from frames of the trials (:class:`hvf.protocols.Privileged`) and
            not from what is observed.
    """

    planning: Planning
    subgoals: int
    action_low: NDArray[np.float32]
    action_high: NDArray[np.float32]
    world: WorldModel[Any] | None = None
    generator: SubgoalModel[Any] | None = None
    model: Any = None
    privileged: bool = False

    def planner(self, source: SubgoalSource) -> PlanningAgent:
        """An agent that plans towards the subgoals of ``source``.

        Raises:
            ValueError: no world to plan with.
        """
        if self.world is None:
            raise ValueError("world: a planning agent needs dynamics to plan with")
        planning = self.planning
        return PlanningAgent(self.world, planning.mpc, source, planning.replanning, self.privileged)


@dataclass(frozen=True)
class Method:
    """A method.

    Attributes:
        about: what it does, in a line.
        title: its name in tables; ``{}`` stands for the number of subgoals.
        agent: makes it.
        needs_dynamics: whether it plans with a model.
        needs_generator: whether it draws subgoals with a model.
        has_subgoals: whether the number of subgoals is a setting of it.
        asks: the model that it asks beside dynamics and generator, by its name among the domain's
            weights; another of the same role will do. None for none.
    """

    about: str
    title: str
    agent: Callable[[Means], Agent]
    needs_dynamics: bool = True
    needs_generator: bool = False
    has_subgoals: bool = False
    asks: str | None = None

    def label(self, subgoals: int) -> str:
        """Its name in tables, with this many subgoals."""
        return self.title.format(subgoals)


def _search(means: Means) -> Agent:
    if not means.subgoals:
        return means.planner(no_subgoals)
    if means.world is None or means.generator is None:
        raise ValueError("generator: a search for subgoals needs a model that draws them")
    search = means.planning.search
    return means.planner(Searched(search, means.subgoals, means.world, means.generator))


def _proposing(means: Means) -> Proposing[Any]:
    """The generator with the proposals of the method's model."""
    if means.generator is None:
        raise ValueError("generator: proposals of subgoals need a model that draws them")
    if not isinstance(means.model, Proposals):
        raise ValueError("method_model: a method that asks for proposals needs a model of them")
    return means.model.of(means.generator)


def _search_from_proposals(means: Means) -> Agent:
    if not means.subgoals:
        return means.planner(no_subgoals)
    return _search(dataclasses.replace(means, generator=_proposing(means)))


def _amortised(means: Means) -> Agent:
    if not means.subgoals:
        return means.planner(no_subgoals)
    if means.world is None:
        raise ValueError("world: subgoals are drawn in the frames of dynamics")
    planning, generator = means.planning, _proposing(means)
    draws = planning.subgoal_draws
    return means.planner(Amortised(planning.search, means.subgoals, means.world, generator, draws))


def _proposal(means: Means) -> Agent:
    if not means.subgoals:
        return means.planner(no_subgoals)
    if not isinstance(means.model, Proposer):
        raise ValueError("method_model: a method that proposes subgoals needs a model that does")
    return means.planner(proposed(means.subgoals, means.model))


def _policy(means: Means) -> Agent:
    if not isinstance(means.model, Policy):
        raise ValueError("method_model: a method without plans needs a model that acts")
    return PolicyAgent(means.model)


NONE = Method(
    "visual foresight: plans straight to the goal image (Finn & Levine, 2017)",
    "no subgoals",
    lambda means: means.planner(no_subgoals),
)
HVF = Method(
    "hierarchical visual foresight: searches for subgoal images, then plans to each in turn",
    "HVF-{}",
    _search,
    needs_generator=True,
    has_subgoals=True,
)
HVF_PROPOSALS = Method(
    "hierarchical visual foresight whose search begins where a network proposes",
    "HVF-{} from proposals",
    _search_from_proposals,
    needs_generator=True,
    has_subgoals=True,
    asks="layers-proposals",
)
AMORTISED = Method(
    "amortised subgoals: the best of a few draws that a network proposes, without a search",
    "amortised-{}",
    _amortised,
    needs_generator=True,
    has_subgoals=True,
    asks="layers-proposals",
)
TAP = Method(
    "time-agnostic prediction: proposes subgoal images without a search, then plans to each",
    "TAP-{}",
    _proposal,
    has_subgoals=True,
    asks="tap",
)
GROUND_TRUTH = Method(
    "gets the domain's own subgoals: an upper bound",
    "ground truth-{}",
    lambda means: means.planner(ground_truth(means.subgoals)),
    has_subgoals=True,
)
RIG = Method(
    "acts by a policy that learned to reach imagined goals, without a plan (Nair et al., 2018)",
    "RIG",
    _policy,
    needs_dynamics=False,
    asks="rig",
)
RANDOM = Method(
    "acts at random: the floor",
    "random",
    lambda means: RandomAgent(means.action_low, means.action_high),
    needs_dynamics=False,
)
