"""The command line: ``hvf <command> [options]``.

A command is a function of one config dataclass; its options are generated from the dataclass.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from typing import Any

import tyro
from rich.console import Console
from rich.markup import escape

# Name to (module:function, summary). Modules are imported when their command is run.
COMMANDS: dict[str, tuple[str, str]] = {
    "collect maze": ("hvf.cli.collect:maze", "Collect episodes of the maze under random actions."),
    "train dynamics": ("hvf.cli.train:dynamics", "Train the compact dynamics model."),
    "train subgoals": ("hvf.cli.train:subgoals", "Train the generator of subgoal images."),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status: 0, 1 on an error, 2 on usage, 130 on Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = next((" ".join(words[:n]) for n in (2, 1) if " ".join(words[:n]) in COMMANDS), None)
    if name is None:
        return _usage(words)
    console = Console(stderr=True)
    try:
        tyro.cli(_load(name), prog=f"hvf {name}", args=words[len(name.split()) :])
    except KeyboardInterrupt:
        return 130
    except (ValueError, TypeError, OSError, RuntimeError) as error:
        message = f"[red]hvf {name}:[/red] {escape(str(error))}"
        console.print(message, highlight=False, soft_wrap=True)
        return 1
    return 0


def _load(name: str) -> Callable[..., Any]:
    module, function = COMMANDS[name][0].split(":")
    command: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return command


def _usage(words: Sequence[str]) -> int:
    asked = not words or words[0] in ("-h", "--help")
    console = Console(stderr=not asked)
    if not asked:
        console.print(f"[red]hvf:[/red] no command {escape(' '.join(words[:2]))!r}")
    console.print(r"usage: hvf <command> \[options]; hvf <command> --help lists the options" "\n")
    width = max(map(len, COMMANDS))
    for name, (_, summary) in COMMANDS.items():
        console.print(f"  [bold]{name:{width}}[/bold]  {summary}", highlight=False)
    return 0 if asked else 2
