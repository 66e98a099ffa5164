"""What acts: plans with and without subgoals, and the random floor."""

from hvf.agents.method import Means, Method
from hvf.agents.planning import PlanningAgent
from hvf.agents.policy import PolicyAgent
from hvf.agents.random import RandomAgent
from hvf.agents.subgoals import Searched, ground_truth, no_subgoals, proposed

__all__ = [
    "Means",
    "Method",
    "PlanningAgent",
    "PolicyAgent",
    "RandomAgent",
    "Searched",
    "ground_truth",
    "no_subgoals",
    "proposed",
]
