"""Weights that lie: safetensors files and the headers of this program in them."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file

from hvf.domains.weights import WEIGHTS
from hvf.models.checkpoint import load_any, read_tensors

GENUINE = WEIGHTS / "maze_temporal_distance.safetensors"
"""What the attacks begin with: the smallest that ships."""


def attempt(path: Path) -> object:
    """Open an attack as a user would."""
    return load_any(path)


def raw(path: Path, header: bytes, data: bytes = b"", length: int | None = None) -> None:
    """A safetensors file of any header; its length as said, true or not."""
    said = len(header) if length is None else length
    path.write_bytes(struct.pack("<Q", said) + header + data)


def changed(
    path: Path,
    metadata: Mapping[str, str] | None = None,
    weights: Callable[[dict[str, torch.Tensor]], object] | None = None,
) -> None:
    """The genuine file with other metadata or weights."""
    tensors, words = read_tensors(GENUINE)
    if weights is not None:
        weights(tensors)
    save_file(tensors, path, {**words, **(metadata or {})})


def config(path: Path, **fields: Any) -> None:
    """The genuine file with other fields of its config."""
    own = json.loads(read_tensors(GENUINE)[1]["config"])
    changed(path, {"config": json.dumps({**own, **fields})})


def numbers(path: Path, value: int) -> None:
    """The genuine file with ``value`` for every whole number of its config."""
    own = json.loads(read_tensors(GENUINE)[1]["config"])

    def replaced(part: Any) -> Any:
        if isinstance(part, dict):
            return {name: replaced(each) for name, each in part.items()}
        if isinstance(part, list):
            return [replaced(each) for each in part]
        return value if type(part) is int else part

    changed(path, {"config": json.dumps(replaced(own))})


def any_weight(tensors: dict[str, torch.Tensor], change: Callable[[torch.Tensor], Any]) -> None:
    """Replace the first of the weights of floating point."""
    name = next(name for name, each in tensors.items() if each.is_floating_point())
    tensors[name] = change(tensors[name])


def tensor(shape: list[int], end: int) -> bytes:
    """A header with one tensor of that shape in so many bytes."""
    return json.dumps({"w": {"dtype": "F32", "shape": shape, "data_offsets": [0, end]}}).encode()


def overlapping() -> bytes:
    """A header with two tensors in the same bytes."""
    one = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
    return json.dumps({"a": one, "b": one}).encode()


ATTACKS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "header longer than the file": lambda path: raw(path, b"{}", length=2**40),
    "header of 2**64 - 1 bytes": lambda path: raw(path, b"{}", length=2**64 - 1),
    "header that nests 100,000 deep": lambda path: raw(path, b"[" * 100_000),
    "header that is no UTF-8": lambda path: raw(path, b'{"\xff\xfe": 1}'),
    "tensor of 2**60 numbers": lambda path: raw(path, tensor([2**30, 2**30], 4), b"\0" * 4),
    "shape whose product wraps to 4 bytes": lambda path: raw(
        path, tensor([2**62 + 1, 4], 16), b"\0" * 16
    ),
    "tensor beyond the end": lambda path: raw(path, tensor([1024], 4096), b"\0" * 8),
    "tensors that overlap": lambda path: raw(path, overlapping(), b"\0" * 4),
    "pickle": lambda path: torch.save({"w": torch.zeros(3)}, path),
    "config that nests 100,000 deep": lambda path: changed(path, {"config": "[" * 100_000}),
    "config that is a list": lambda path: changed(path, {"config": "[1, 2]"}),
    "config with an unknown field": lambda path: config(path, __class__="os.system"),
    "config of other types": lambda path: config(
        path, **dict.fromkeys(json.loads(read_tensors(GENUINE)[1]["config"]), "rm -rf")
    ),
    "config of networks of 2**40": lambda path: numbers(path, 2**40),
    "config of networks of a million": lambda path: numbers(path, 10**6),
    "config of networks of 20,000": lambda path: numbers(path, 20_000),
    "config of numbers below zero": lambda path: numbers(path, -5),
    "config of a number of 5,000 digits": lambda path: changed(
        path, {"config": '{"hidden": 1' + "0" * 5_000 + "}"}
    ),
    "class that is no model": lambda path: changed(path, {"model": "Popen"}),
    "class of another model": lambda path: changed(path, {"model": "Vae"}),
    "class name of a megabyte": lambda path: changed(path, {"model": "x" * 2**20}),
    "weights of NaN": lambda path: changed(
        path, weights=lambda all_: any_weight(all_, lambda each: each * np.nan)
    ),
    "weights of integers": lambda path: changed(
        path, weights=lambda all_: any_weight(all_, lambda each: each.to(torch.int64))
    ),
    "weights of complex numbers": lambda path: changed(
        path, weights=lambda all_: any_weight(all_, lambda each: each.to(torch.complex64))
    ),
    "weights of another shape": lambda path: changed(
        path, weights=lambda all_: any_weight(all_, lambda each: each.flatten()[:1].clone())
    ),
    "weights missing": lambda path: changed(
        path, weights=lambda all_: all_.pop(next(iter(all_)))
    ),
    "weights that nobody asked for": lambda path: changed(
        path, weights=lambda all_: all_.update({"__init__": torch.zeros(1)})
    ),
}  # fmt: skip
