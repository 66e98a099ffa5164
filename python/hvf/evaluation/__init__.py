"""Agents, the loop they act in, and success rates."""

from hvf.evaluation.acting import Acting, Agent, Decision, Outcome, Trial, Trials, act
from hvf.evaluation.evaluate import Report, evaluate, wilson_interval
from hvf.evaluation.maze import MazeEvaluation, MazePlanning, MazeTrials

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
