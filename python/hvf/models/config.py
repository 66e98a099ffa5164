"""Configs of models: dataclasses as JSON and back, and what a config asks for before it is built.

A config may come from anybody's file. It is bounded by the size of that file, and the weights that
it asks for are compared with those that are there before any memory is taken for them.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import torch
from torch.overrides import TorchFunctionMode

ModelT = TypeVar("ModelT", bound=torch.nn.Module)

_SMALL = 100_000
"""A number that no config needs a reason for; a depth that is still built in seconds."""


def config_to_json(model: torch.nn.Module) -> dict[str, Any]:
    """The config of ``model`` as JSON's types.

    Raises:
        TypeError: ``model.config`` is not a dataclass.
    """
    config = getattr(model, "config", None)
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        raise TypeError(f"model: {type(model).__name__} has no config dataclass")
    parsed: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config)))
    return parsed


def config_from_json(config_type: type[Any] | None, values: Mapping[str, Any]) -> Any:
    """Build a dataclass, with its nested dataclasses and tuples, from JSON's types.

    A field that is missing takes its default.

    Raises:
        TypeError: ``config_type`` is not a dataclass.
        ValueError: an unknown field, a missing one that has no default, or a value that the
            dataclass refuses.
    """
    if not dataclasses.is_dataclass(config_type):
        raise TypeError("config_type must be a dataclass")
    hints = typing.get_type_hints(config_type)
    fields = {field.name: field for field in dataclasses.fields(config_type)}
    for name in sorted(values.keys() - fields.keys()):
        raise ValueError(f"{config_type.__name__} has no field {name!r}")
    for name, field in fields.items():
        needed = field.default is field.default_factory is dataclasses.MISSING
        if needed and name not in values:
            raise ValueError(f"field {name!r} of {config_type.__name__} is missing")
    return config_type(**{name: _restore(hints[name], value) for name, value in values.items()})


def _restore(hint: Any, value: Any) -> Any:
    """``value`` as JSON gave it, in the type that the field's ``hint`` asks for."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        members = [member for member in typing.get_args(hint) if member is not type(None)]
        return None if value is None or not members else _restore(members[0], value)
    if dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return config_from_json(typing.cast(type[Any], hint), value)
    if isinstance(value, list):
        arguments = typing.get_args(hint)
        return tuple(_restore(arguments[0] if arguments else Any, item) for item in value)
    return value


def check_numbers(config: Any, size: int) -> None:
    """Refuse whole numbers that weights in a file of ``size`` bytes cannot have a use for.

    Raises:
        ValueError: one is larger than the file and than any that sizes no network.
    """
    if isinstance(config, Mapping):
        config = config.values()
    if isinstance(config, Iterable) and not isinstance(config, str):
        for each in config:
            check_numbers(each, size)
    elif type(config) is int and abs(config) > max(size, _SMALL):
        raise ValueError(f"asks for {config} of something, in a file of {size} bytes")


def outline(model_class: type[ModelT], config: Any) -> ModelT | None:
    """A model whose weights have shapes but no memory and no values; None if it cannot be had.

    It cannot of a model that looks into its weights while it is made.
    """
    try:
        with torch.device("meta"), _Uninitialised():
            return model_class(config)
    except RuntimeError:
        return None


class _Uninitialised(TorchFunctionMode):
    """First values of weights are not drawn: some of it would import half of torch."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        named = dict(kwargs or {})
        if getattr(func, "__module__", "") == "torch.nn.init":
            return args[0] if args else named["tensor"]
        return func(*args, **named)
