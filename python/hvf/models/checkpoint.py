"""Weights on disk: a safetensors file that says which model it holds and how it was trained.

The header of the file carries, as JSON, the class of the model, its config, the environment that
it was trained for and the training run. Nothing is unpickled.

The class leads to the model's entry in :data:`hvf.registry.MODELS`, so that a checkpoint can be
loaded by anyone who has only its path (:func:`load_any`). A field that its config did not have yet
when it was written takes the default of today, which must therefore mean what went without saying.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialise

from hvf.files import write_bytes
from hvf.models.config import check_numbers, config_from_json, config_to_json, outline
from hvf.models.entry import ModelEntry
from hvf.registry import MODELS

FORMAT = "hvf-model-1"


class Configured(Protocol):
    """A ``torch.nn.Module`` that is built from one frozen dataclass.

    ``Model(config)`` must work, and ``config`` must hold only JSON's types, tuples and dataclasses.
    A class may also have ``keep_float32``, names of weights that half precision is too coarse for
    (:func:`export_half`).
    """

    config_type: ClassVar[type[Any]]

    @property
    def config(self) -> Any:
        """The config that the model was built from."""
        ...


ModelT = TypeVar("ModelT", bound=torch.nn.Module)


@dataclasses.dataclass(frozen=True)
class Header:
    """What a checkpoint says about itself.

    Attributes:
        model: class name of the model.
        config: its config, as JSON.
        environment: name of the environment it was trained for, such as ``maze``.
        training: the run that made it: command, seed, steps, last validation.
        package: where the class came from, such as ``hvf``; empty in older checkpoints.
    """

    model: str
    config: Mapping[str, Any]
    environment: str
    training: Mapping[str, Any]
    package: str = ""


@dataclasses.dataclass(frozen=True)
class LoadedModel:
    """A model that was loaded by its path alone.

    Attributes:
        name: its name in :data:`hvf.registry.MODELS`.
        entry: what is known of models of this kind.
        module: the model, in evaluation mode.
        header: what the checkpoint says about itself.
    """

    name: str
    entry: ModelEntry
    module: torch.nn.Module
    header: Header


def save_model(
    path: str | Path,
    model: torch.nn.Module,
    *,
    environment: str,
    training: Mapping[str, Any] | None = None,
) -> None:
    """Write the weights of ``model`` to ``path``, whole or not at all.

    Args:
        path: file to write; an existing one is replaced.
        model: a module with a ``config`` dataclass (:class:`Configured`).
        environment: name of the environment the model is for.
        training: anything JSON can hold about the run.

    Raises:
        TypeError: ``model`` has no config dataclass.
        ValueError: ``training`` holds NaN or infinity, which JSON cannot hold.
        OSError: the file cannot be written; what was there stays.
    """
    header = {
        "format": FORMAT,
        "model": type(model).__name__,
        "package": type(model).__module__.partition(".")[0],
        "config": json.dumps(config_to_json(model), sort_keys=True, allow_nan=False),
        "environment": environment,
        "training": json.dumps(dict(training or {}), sort_keys=True, allow_nan=False),
    }
    write_tensors(path, model.state_dict(), header)


def read_header(path: str | Path) -> Header:
    """Read what a checkpoint says about itself, without its weights.

    Raises:
        FileNotFoundError: no file at ``path``.
        ValueError: not a checkpoint of this program, or damaged; names ``path``.
    """
    return _header(path, read_metadata(path))


def entry_of(model: str, package: str = "") -> tuple[str, ModelEntry]:
    """Name and entry, in :data:`hvf.registry.MODELS`, of the models whose class is ``model``.

    Of several classes of that name the one of ``package`` is taken, else the first.

    Raises:
        ValueError: no entry has that class; names those that there are.
    """
    known, absent = {}, []
    found: tuple[str, ModelEntry] | None = None
    for name in MODELS:
        try:
            entry = MODELS[name]
        except ImportError as error:  # of another package; what is asked for may be there
            absent.append(str(error))
            continue
        if model == entry.class_name or model in entry.formerly:
            if package in ("", entry.package):
                return name, entry
            found = found or (name, entry)
        known[name] = entry.class_name
    if found is not None:
        return found
    listed = ", ".join(f"{name} ({kind})" for name, kind in known.items())
    missing = f"; not to be imported: {', '.join(absent)}" if absent else ""
    raise ValueError(f"no model has the class {model!r}; known are {listed}{missing}")


def load_any(
    path: str | Path, *, environment: str | None = None, device: str | torch.device = "cpu"
) -> LoadedModel:
    """Load whatever model the checkpoint at ``path`` holds, in evaluation mode.

    Args:
        path: a file written by :func:`save_model`.
        environment: if given, the environment that the checkpoint must be for.
        device: where to put the weights.

    Raises:
        FileNotFoundError: no file at ``path``.
        ValueError: as :func:`load_model`; or a class that no entry of
            :data:`hvf.registry.MODELS` has.
    """
    tensors, metadata = read_tensors(path)
    header = _header(path, metadata)
    try:
        name, entry = entry_of(header.model, header.package)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    model = _build(path, entry.resolved("module"), header, tensors, environment)
    return LoadedModel(name, entry, model.to(device).eval(), header)


def load_model(
    path: str | Path,
    model_class: type[ModelT],
    *,
    environment: str | None = None,
    device: str | torch.device = "cpu",
) -> ModelT:
    """Build a ``model_class`` from the checkpoint at ``path``, in evaluation mode.

    Args:
        path: a file written by :func:`save_model`.
        model_class: the class that the checkpoint must hold.
        environment: if given, the environment that the checkpoint must be for.
        device: where to put the weights.

    Raises:
        FileNotFoundError: no file at ``path``.
        ValueError: damaged, not a checkpoint, another class or environment, or weights that do
            not fit the config; names ``path`` and what was expected.
    """
    tensors, metadata = read_tensors(path)
    header = _header(path, metadata)
    if header.model != model_class.__name__ and not _formerly(header.model, model_class.__name__):
        raise ValueError(f"{path}: holds a {header.model}, expected a {model_class.__name__}")
    return _build(path, model_class, header, tensors, environment).to(device).eval()


def _formerly(model: str, today: str) -> bool:
    """Whether ``model`` is what checkpoints called the class ``today`` before it was renamed."""
    try:
        entry = entry_of(model)[1]
    except ValueError:
        return False
    return entry.class_name == today and model in entry.formerly


def _build(
    path: str | Path,
    model_class: type[ModelT],
    header: Header,
    tensors: Mapping[str, torch.Tensor],
    environment: str | None,
) -> ModelT:
    if environment is not None and header.environment != environment:
        raise ValueError(
            f"{path}: was trained for environment {header.environment!r}, expected {environment!r}"
        )
    config_type: Any = getattr(model_class, "config_type", None)
    with _config_named(path, header):
        check_numbers(header.config, Path(path).stat().st_size)
        config = config_from_json(config_type, header.config)
        planned = outline(model_class, config)
    if planned is not None:
        _check_weights(path, planned, tensors)
    with _config_named(path, header):
        model = model_class(config)
    if planned is None:
        _check_weights(path, model, tensors)
    model.load_state_dict(dict(tensors))
    return model


@contextlib.contextmanager
def _config_named(path: str | Path, header: Header) -> Iterator[None]:
    """What is wrong with a config, or with a model of it, is said of its file."""
    try:
        yield
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: config of {header.model} is not valid: {error}") from error


def export_half(source: str | Path, target: str | Path) -> int:
    """Copy the checkpoint at ``source`` to ``target`` in half precision; returns its bytes.

    :func:`load_model` reads either; sums and products are in single precision all the same. What
    the model's class names in ``keep_float32`` stays as it is: half precision has 11 bits, which
    is less than a coordinate needs.

    Raises:
        FileNotFoundError: no file at ``source``.
        ValueError: not a checkpoint of this program, of a model that it does not know, or weights
            beyond half precision's range.
        OSError: ``target`` cannot be written.
    """
    tensors, metadata = read_tensors(source)
    header = _header(source, metadata)
    try:
        model_class = entry_of(header.model, header.package)[1].resolved("module")
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    kept = getattr(model_class, "keep_float32", ())
    halves = {}
    for name, tensor in tensors.items():
        coarse = tensor.is_floating_point() and name not in kept
        halves[name] = tensor.half() if coarse else tensor
        if coarse and not bool(torch.isfinite(halves[name]).all()):
            raise ValueError(f"{source}: {name} does not fit into half precision")
    write_tensors(Path(target), halves, metadata)
    return Path(target).stat().st_size


def load_weights(
    path: str | Path, model: torch.nn.Module, tensors: Mapping[str, torch.Tensor]
) -> None:
    """Copy ``tensors`` into ``model``, all of them and in their shapes.

    Raises:
        ValueError: a tensor is missing, unknown, of another shape or not finite; names ``path``.
    """
    _check_weights(path, model, tensors)
    model.load_state_dict(dict(tensors))


def _check_weights(
    path: str | Path, model: torch.nn.Module, tensors: Mapping[str, torch.Tensor]
) -> None:
    """Refuse ``tensors`` that are not all of the model's weights, in their shapes and finite."""
    own = model.state_dict()
    for name in own.keys() - tensors.keys():
        raise ValueError(f"{path}: lacks the weights {name!r} of {type(model).__name__}")
    for name, tensor in tensors.items():
        if name not in own:
            raise ValueError(f"{path}: holds {name!r}, which {type(model).__name__} does not have")
        if tensor.shape != own[name].shape:
            expected, found = tuple(own[name].shape), tuple(tensor.shape)
            raise ValueError(f"{path}: {name} has shape {found}, expected {expected}")
        if tensor.is_floating_point() != own[name].is_floating_point() or tensor.is_complex():
            raise ValueError(f"{path}: {name} is {tensor.dtype}, expected {own[name].dtype}")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{path}: {name} holds NaN or infinite weights")


def write_tensors(
    path: str | Path, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, str]
) -> None:
    """Write named tensors and metadata to a safetensors file, whole or not at all.

    Raises:
        OSError: the file cannot be written; what was there stays.
    """
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_bytes(path, serialise(plain, dict(metadata)))


def read_metadata(path: str | Path) -> dict[str, str]:
    """Read the metadata of a safetensors file.

    Raises:
        FileNotFoundError: no file at ``path``.
        ValueError: not a safetensors file, or truncated; names ``path``.
    """
    return _open(path, weights=False)[1]


def read_tensors(path: str | Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Read all tensors and the metadata of a safetensors file, on the CPU.

    Raises:
        FileNotFoundError: no file at ``path``.
        ValueError: not a safetensors file, or truncated; names ``path``.
    """
    return _open(path, weights=True)


def _header(path: str | Path, metadata: Mapping[str, str]) -> Header:
    if metadata.get("format") != FORMAT:
        raise ValueError(
            f"{path}: is not a model checkpoint of this program "
            f"(format {metadata.get('format')!r}, expected {FORMAT!r})"
        )
    try:
        header = Header(
            model=metadata["model"],
            config=json.loads(metadata["config"]),
            environment=metadata["environment"],
            training=json.loads(metadata["training"]),
            package=metadata.get("package", ""),
        )
    except (KeyError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: damaged checkpoint header ({error!r})") from error
    if not isinstance(header.config, dict) or not isinstance(header.training, dict):
        raise ValueError(f"{path}: damaged checkpoint header")
    return header


def _open(path: str | Path, *, weights: bool) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            names = file.keys() if weights else []
            tensors = {name: file.get_tensor(name) for name in names}
            return tensors, dict(file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a safetensors file, or truncated ({error})") from error
