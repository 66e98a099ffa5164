"""``hvf export``: weights as the package ships them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from hvf.models.checkpoint import export_half


@dataclass(frozen=True)
class Export:
    """Copy a trained model in half precision, at half the size.

    Attributes:
        source: checkpoint to read (``runs/.../model.safetensors``).
        target: checkpoint to write.
    """

    source: Path
    target: Path


def export(config: Annotated[Export, tyro.conf.arg(name="")]) -> None:
    """Write a trained model in half precision, as the weights in the package are.

    Example: hvf export --source runs/cvae/model.safetensors --target cvae.safetensors
    """
    size = export_half(config.source, config.target)
    Console().print(f"{config.target}: {size / 1e6:.1f} MB", highlight=False)
