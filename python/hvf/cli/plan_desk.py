"""``hvf plan desk``: one episode at the Franka desk, with pictures."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import tyro

from hvf.cli.plan import Drawn, draw
from hvf.cli.presets import begin_with_preset as prepare
from hvf.domains.desk.trials import DeskEvaluation, DeskTask, Preset

__all__ = ["desk", "prepare"]


@dataclasses.dataclass(frozen=True)
class PlanDesk(Drawn):
    """One episode at the desk.

    Attributes:
        evaluation: which agent, world and task, and how it plans.
        preset: settings to begin with; the options below show and change them one by one.
        workers: processes that simulate and draw; 0 for as many as there are cores.
    """

    evaluation: Annotated[DeskEvaluation, tyro.conf.OmitArgPrefixes] = DeskEvaluation()
    preset: Preset = "default"
    workers: int = 0


def desk(config: Annotated[PlanDesk, tyro.conf.arg(name="")]) -> None:
    """Plan and act in one episode at the desk; write a picture of the plan and a film.

    The picture shows start, subgoals, goal and the fingertip's path; the film shows the episode
    beside what it aims at. Example:

        hvf plan desk --task door --agent ground-truth --model simulator --preset simulator
    """
    with DeskTask(config.evaluation, config.workers) as task:
        draw(task, config)
