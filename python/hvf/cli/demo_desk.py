"""``hvf demo desk``: the main job on a few episodes at the Franka desk, with pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from hvf.cli.demo import Shown, show
from hvf.cli.presets import begin_with_preset as prepare
from hvf.domains.desk.trials import DeskEvaluation, DeskTask, Preset
from hvf.envs.desk.pool import DeskPool
from hvf.evaluation.task import AgentName

__all__ = ["desk", "prepare"]


@dataclasses.dataclass(frozen=True)
class DemoDesk(Shown):
    """A few episodes at the desk.

    Attributes:
        evaluation: which task and world, and how it plans; agent hvf is compared with none.
        preset: settings to begin with; the options below show and change them one by one.
        workers: processes that simulate and draw; 0 for as many as there are cores.
    """

    # A task that the learned models mostly do.
    begins_with: ClassVar[Mapping[str, Any]] = {"task": "door", "subgoals": 1}

    episodes: int = 4
    pictures: int = 2
    out: Path = Path("outputs/demo_desk")
    evaluation: Annotated[DeskEvaluation, tyro.conf.OmitArgPrefixes] = DeskEvaluation()
    preset: Preset = "default"
    workers: int = 0


def desk(config: Annotated[DemoDesk, tyro.conf.arg(name="")]) -> None:
    """Reach goal images at the Franka desk, with subgoals and without; write pictures and a table.

    Searches for subgoal images with the learned models, plans to each in turn, and acts in the true
    simulator. Example:

        hvf demo desk --task door_block --subgoals 2
    """
    evaluation = config.evaluation
    with DeskPool(config.workers) as pool:

        def task(agent: AgentName) -> DeskTask:
            return DeskTask(dataclasses.replace(evaluation, agent=agent), pool=pool)

        show(task, evaluation.agent, config, f"{config.episodes} episodes of {evaluation.task}")
