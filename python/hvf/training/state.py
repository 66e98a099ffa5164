"""What a run needs to go on after it was stopped: weights, optimiser and step, in safetensors.

Batches and noise are functions of (seed, step), so there is no generator to keep; a sampler whose
batches are not says what it remembers. What is fitted without gradient before a training, or after
it, is kept too (:func:`fitted`).
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch

from hvf.models.checkpoint import load_weights, read_tensors, write_tensors

FORMAT = "hvf-training-1"
FITTED = "hvf-fitted-1"

ModelT = TypeVar("ModelT", bound=torch.nn.Module)


@runtime_checkable
class Memory(Protocol):
    """What has something to remember, beside a model: a sampler that acts by it."""

    def memory(self) -> Mapping[str, torch.Tensor]:
        """Return what the batches to come depend on beside the model: CPU tensors."""
        ...

    def recall(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Go on from what :meth:`memory` returned, in this run or another one.

        Raises:
            ValueError: tensors that are not this sampler's.
        """
        ...


@dataclasses.dataclass(frozen=True)
class TrainingState:
    """A model, the optimiser that moves it, and a sampler with a memory, if it has one."""

    model: torch.nn.Module
    optimiser: torch.optim.Optimizer
    sampler: Memory | None = None


def save_state(path: Path, state: TrainingState, identity: Mapping[str, Any], step: int) -> None:
    """Write weights, optimiser and step to ``path``, whole or not at all.

    Args:
        path: file to write.
        state: what to keep.
        identity: what a continuation must agree on, as JSON's types.
        step: steps done.

    Raises:
        OSError: the file cannot be written; what was there stays.
    """
    tensors = {f"model.{name}": tensor for name, tensor in state.model.state_dict().items()}
    for name, weights in state.model.named_parameters():
        for key, value in state.optimiser.state.get(weights, {}).items():
            tensors[f"optimiser.{key}.{name}"] = torch.as_tensor(value)
    if state.sampler is not None:
        tensors |= {f"sampler.{name}": value for name, value in state.sampler.memory().items()}
    header = {"format": FORMAT, "identity": json.dumps(identity), "step": str(step)}
    write_tensors(path, tensors, header)


def load_state(path: Path, state: TrainingState, identity: Mapping[str, Any]) -> int:
    """Restore ``state`` from ``path`` and return the steps done; 0 if there is no such file.

    Raises:
        ValueError: the file is damaged, or belongs to a run that differs in ``identity``; names
            ``path`` and what differs.
    """
    if not path.exists():
        return 0
    tensors, metadata = read_tensors(path)
    found = _identity(path, metadata, FORMAT, "a training state")
    try:
        step = int(metadata["step"])
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: is not a training state of this program ({error})") from error
    _refuse_another_run(path, found, identity)
    _restore(path, state, tensors)
    return step


def fitted(
    path: Path, model: ModelT, identity: Mapping[str, Any], fit: Callable[[ModelT], object]
) -> ModelT:
    """``model`` as ``fit`` leaves it, which is called once in a run's life.

    Args:
        path: file that keeps the weights, written after ``fit``.
        model: what to fit, in place.
        identity: what the result is a function of, as JSON's types.
        fit: fits the model.

    Raises:
        ValueError: the file is damaged, or belongs to a run that differs in ``identity``; names
            ``path`` and what differs.
        OSError: the file cannot be written.
    """
    wanted = json.loads(json.dumps({"class": type(model).__name__, **identity}, allow_nan=False))
    if path.exists():
        tensors, metadata = read_tensors(path)
        _refuse_another_run(path, _identity(path, metadata, FITTED, "what was fitted"), wanted)
        load_weights(path, model, tensors)
        return model
    fit(model)
    header = {"format": FITTED, "identity": json.dumps(wanted)}
    write_tensors(path, model.state_dict(), header)
    return model


def _identity(path: Path, metadata: Mapping[str, str], kind: str, name: str) -> dict[str, Any]:
    try:
        if metadata["format"] != kind:
            raise ValueError(f"format {metadata['format']!r}, expected {kind!r}")
        found: dict[str, Any] = json.loads(metadata["identity"])
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: is not {name} of this program ({error})") from error
    return found


def _refuse_another_run(path: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    difference = _difference(found, wanted)
    if difference:
        raise ValueError(
            f"{path}: belongs to another run ({difference}); choose another out, or remove it"
        )


def _restore(path: Path, state: TrainingState, tensors: Mapping[str, torch.Tensor]) -> None:
    weights = {name[6:]: value for name, value in tensors.items() if name.startswith("model.")}
    load_weights(path, state.model, weights)
    for name, parameter in state.model.named_parameters():
        kept: dict[str, torch.Tensor] = {}
        for key in ("step", "exp_avg", "exp_avg_sq"):
            value = tensors.get(f"optimiser.{key}.{name}")
            if value is None:
                continue
            if value.shape == parameter.shape and key != "step":
                kept[key] = torch.empty_like(parameter, requires_grad=False).copy_(value)
            elif key == "step" and value.ndim == 0:
                kept[key] = value.to(parameter.device)
            else:
                raise ValueError(f"{path}: the optimiser's {key} of {name} has another shape")
        if kept:
            state.optimiser.state[parameter] = kept
    if state.sampler is not None:
        memory = {name[8:]: value for name, value in tensors.items() if name[:8] == "sampler."}
        try:
            state.sampler.recall(memory)
        except KeyError as error:
            raise ValueError(f"{path}: lacks {error} of the sampler's memory") from error
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def _difference(found: Any, wanted: Any, name: str = "") -> str:
    """The first place where two trees of JSON's types differ, in words; empty if none."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in sorted(found.keys() | wanted.keys()):
            inner = _difference(found.get(key), wanted.get(key), f"{name}.{key}" if name else key)
            if inner:
                return inner
        return ""
    return "" if found == wanted else f"{name} is {found!r} there, {wanted!r} here"
