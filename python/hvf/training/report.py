"""What a training run tells: progress, TensorBoard, pictures, and a line per validation."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from hvf.images import write_png


@dataclasses.dataclass(frozen=True)
class Validation:
    """What a validation found.

    Attributes:
        metrics: name to value, for TensorBoard, the log and the checkpoint's header.
        pictures: name to image, uint8 ``[height, width, 3]``.
    """

    metrics: Mapping[str, float]
    pictures: Mapping[str, NDArray[np.uint8]] = dataclasses.field(default_factory=dict)


class Reporter:
    """The progress bar, TensorBoard, the pictures, and one line of text per validation.

    Args:
        out: directory of the run.
        steps: steps in all.
        first: steps that were done before.
        console: where the progress bar and the lines go.
    """

    def __init__(self, out: Path, steps: int, first: int, console: Console) -> None:
        from torch.utils.tensorboard import SummaryWriter  # a second to import

        self._out = out
        self._steps = steps
        self._first = first
        self._began = time.monotonic()
        self._console = console
        self._writer = SummaryWriter(os.fspath(out), purge_step=first + 1 if first else None)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("loss {task.fields[loss]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("training", total=steps, completed=first, loss="")

    def __enter__(self) -> Reporter:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
        self._writer.close()

    def training(self, step: int, loss: torch.Tensor, parts: Mapping[str, Any]) -> None:
        """Report the loss of a step and its parts."""
        self._progress.update(self._task, completed=step, loss=f"{float(loss):.5g}")
        self._scalars("train", step, {"loss": loss, **parts})

    def validating(self) -> None:
        """Say that the model is being measured, which may take a while."""
        self._progress.update(self._task, description="validating")

    def validation(self, step: int, found: Validation) -> None:
        """Report what a validation after ``step`` steps found, and write its pictures."""
        self._progress.update(self._task, description="training")
        self._scalars("validation", step, found.metrics)
        for name, image in found.pictures.items():
            write_png(self._out / "pictures" / f"{name}_{step:07d}.png", image)
            self._writer.add_image(name, image, step, dataformats="HWC")
        spent = time.monotonic() - self._began
        left = spent / (step - self._first) * (self._steps - step)
        numbers = "  ".join(f"{name} {float(value):.4g}" for name, value in found.metrics.items())
        self._console.print(f"step {step}/{self._steps}  {numbers}  ({left / 60:.1f} min left)")

    def _scalars(self, group: str, step: int, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(f"{group}/{name}", float(value), step)
