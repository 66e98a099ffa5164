"""``hvf results desk``: evaluations at the Franka desk as a table for the README."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from hvf.cli.results import Layout, markdown, read
from hvf.domains.desk.trials import DeskEvaluation
from hvf.envs.desk.tasks import TASKS

# The paper's desk results are in a bar chart only.
DESK = Layout("desk", "task", TASKS, DeskEvaluation)


@dataclasses.dataclass(frozen=True)
class ResultsDesk:
    """A table of evaluations at the desk.

    Attributes:
        folder: the JSON files that ``hvf eval desk`` wrote.
    """

    folder: tyro.conf.Positional[Path]


def desk(config: Annotated[ResultsDesk, tyro.conf.arg(name="")]) -> None:
    """Print the evaluations in a folder as a Markdown table.

    Cells are success rates with 95% Wilson intervals, and the number of trials if it is not 100.
    Example: hvf results desk results/desk
    """
    print(markdown(read(config.folder), DESK))
