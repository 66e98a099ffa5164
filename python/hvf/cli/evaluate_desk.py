"""``hvf eval desk``: success rates at the Franka desk."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import tyro

from hvf.cli.evaluate import Measured, measure
from hvf.cli.presets import begin_with_preset as prepare
from hvf.domains.desk.trials import DeskEvaluation, DeskTask, Preset

__all__ = ["desk", "prepare"]


@dataclasses.dataclass(frozen=True)
class EvalDesk(Measured):
    """Success of an agent at the desk.

    Attributes:
        evaluation: which agent, world and task, and how it plans.
        preset: settings to begin with; the options below show and change them one by one.
        workers: processes that simulate and draw; 0 for as many as there are cores.
    """

    evaluation: Annotated[DeskEvaluation, tyro.conf.OmitArgPrefixes] = DeskEvaluation()
    preset: Preset = "default"
    workers: int = 0


def desk(config: Annotated[EvalDesk, tyro.conf.arg(name="")]) -> None:
    """Measure how often an agent does a task at the desk, with its confidence interval.

    The same command goes on where it was stopped. Planning with the simulator is slow: the preset
    of that name says what two cores can pay. Examples:

        hvf eval desk --task door_two_block --agent hvf --subgoals 2
        hvf eval desk --task door --agent none --model simulator --preset simulator
    """
    with DeskTask(config.evaluation, config.workers) as task:
        measure(task, config, config.preset)
