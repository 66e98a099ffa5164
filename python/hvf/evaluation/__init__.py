"""Agents, the loop they act in, and success rates."""

from hvf.domains.maze import MazeEvaluation, MazePlanning, MazeTrials
from hvf.evaluation.acting import Agent, Decision, Outcome, Trial, Trials, act
from hvf.evaluation.run import Report, evaluate
from hvf.evaluation.statistics import wilson_interval
from hvf.settings import Acting

__all__ = [
    "Acting",
    "Agent",
    "Decision",
    "MazeEvaluation",
    "MazePlanning",
    "MazeTrials",
    "Outcome",
    "Report",
    "Trial",
    "Trials",
    "act",
    "evaluate",
    "wilson_interval",
]
