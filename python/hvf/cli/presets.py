"""Commands whose options begin with a preset: ``--preset paper --horizon 10``.

The preset fills in the defaults of the other options before these are parsed, so that ``--help``
shows what holds and any single setting can be overridden.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable, Sequence
from typing import Any


def begin_with_preset(command: Callable[..., Any], words: Sequence[str]) -> Callable[..., Any]:
    """The command with the preset named in ``words`` as the default of its config.

    Args:
        command: takes one config dataclass, which has ``preset`` and ``evaluation``; its class may
            have ``begins_with``, settings of the evaluation that are this command's own.
        words: the command line after the command's name.
    """
    annotation = typing.get_type_hints(command, include_extras=True)["config"]
    config_type = typing.get_args(annotation)[0]
    hints = typing.get_type_hints(config_type)
    name = _preset(words, typing.get_args(hints["preset"]))
    own = getattr(config_type, "begins_with", {})
    evaluation = dataclasses.replace(hints["evaluation"].of(name), **own)
    default = config_type(evaluation=evaluation, preset=name)

    def prepared(config: Any = default) -> Any:
        return command(config)

    prepared.__doc__ = command.__doc__
    prepared.__annotations__ = {"config": annotation}
    return prepared


def _preset(words: Sequence[str], presets: Sequence[str]) -> str:
    """The last of the presets named; the parser reports one that there is not."""
    name = "default"
    for word, following in zip(words, [*words[1:], ""], strict=True):
        value = word.removeprefix("--preset=") if "=" in word else following
        if word.split("=")[0] == "--preset" and value in presets:
            name = value
    return name
