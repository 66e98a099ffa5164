"""Acting in episodes, success rates, and pictures of both."""

from hvf.evaluation.acting import Outcome, Trial, act
from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.report import Report
from hvf.evaluation.run import evaluate
from hvf.evaluation.task import Task

__all__ = ["Evaluation", "Outcome", "Report", "Task", "Trial", "act", "evaluate"]
