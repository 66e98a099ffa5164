"""``hvf export``: weights as the package ships them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from hvf.cli.arguments import parsed


@dataclass(frozen=True)
class Export:
    """Copy a trained model in half precision, at half the size.

    What would lose meaning in half precision (places on a grid, axes) stays in single precision.
    Example: hvf export --source runs/cvae/model.safetensors --target cvae.safetensors

    Attributes:
        source: checkpoint to read (``runs/.../model.safetensors``).
        target: checkpoint to write.
    """

    source: Path
    target: Path


def run(words: Sequence[str]) -> None:
    """Write a trained model in half precision, as the weights in the package are."""
    from hvf.models.checkpoint import export_half

    config = parsed(Export, "export", words)
    size = export_half(config.source, config.target)
    Console().print(f"{config.target}: {size / 1e6:.1f} MB", highlight=False, soft_wrap=True)
