"""The command line: ``hvf <command> [options]``.

A command is a function of one config dataclass; its options are generated from the dataclass.
Each command's file is imported when it is run. A file may have ``prepare(command, words)``, which
gives the command its defaults by what stands on the command line.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from typing import Any

import tyro
from rich.console import Console
from rich.markup import escape

from hvf.interrupts import sigterm_as_interrupt

# Name to (module:function, summary). Modules are imported when their command is run.
COMMANDS: dict[str, tuple[str, str]] = {
    "collect maze": ("hvf.cli.collect:maze", "Collect episodes of the maze under random actions."),
    "collect desk": (
        "hvf.cli.collect_desk:desk",
        "Collect episodes of the Franka desk under random actions.",
    ),
    "train dynamics": ("hvf.cli.train:dynamics", "Train the compact dynamics model."),
    "train desk-dynamics": (
        "hvf.cli.train:desk_dynamics",
        "Train the compact dynamics model of the desk.",
    ),
    "train desk-dynamics-large": (
        "hvf.cli.train:desk_dynamics_large",
        "The same at a size for a GPU.",
    ),
    "train desk-generator": (
        "hvf.cli.train:desk_generator",
        "Train the generator of subgoals that draws states of the desk.",
    ),
    "train subgoals": ("hvf.cli.train:subgoals", "Train the paper's CVAE of subgoal images."),
    "train desk-subgoals": (
        "hvf.cli.train:desk_subgoals",
        "Train the paper's VAE of subgoal images of the desk.",
    ),
    "train keypoint-generator": (
        "hvf.cli.train:keypoint_generator",
        "Train the generator of subgoals for the compact dynamics model.",
    ),
    "train temporal-distance": (
        "hvf.cli.train:temporal_distance",
        "Train the learned distance in steps, a planning cost.",
    ),
    "probe desk": (
        "hvf.cli.probe:desk",
        "Errors of the desk's dynamics model, in images and in millimetres.",
    ),
    "export weights": ("hvf.cli.export:weights", "Copy a trained model at half its size."),
    "eval maze": ("hvf.cli.evaluate:maze", "Success of an agent in the maze, with its interval."),
    "eval desk": (
        "hvf.cli.evaluate_desk:desk",
        "Success of an agent at the Franka desk, with its interval.",
    ),
    "results maze": ("hvf.cli.results:maze", "Evaluations in a folder as a Markdown table."),
    "results desk": (
        "hvf.cli.results_desk:desk",
        "Evaluations in a folder as a Markdown table.",
    ),
    "plan maze": ("hvf.cli.plan:maze", "Plan and act in one episode of the maze; pictures."),
    "plan desk": (
        "hvf.cli.plan_desk:desk",
        "Plan and act in one episode at the Franka desk; pictures.",
    ),
    "demo maze": ("hvf.cli.demo:maze", "Reach a few goal images with and without subgoals."),
    "demo desk": ("hvf.cli.demo_desk:desk", "The same at the Franka desk."),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        Exit status: 0; 2 for input that cannot be used (a wrong option, value or file), 1 for
        what failed on the way (a full disk, an error of torch), 130 on Ctrl-C or SIGTERM.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = next((" ".join(words[:n]) for n in (2, 1) if " ".join(words[:n]) in COMMANDS), None)
    if name is None:
        return _usage(words)
    console = Console(stderr=True)
    try:
        words = words[len(name.split()) :]
        with sigterm_as_interrupt():
            tyro.cli(_load(name, words), prog=f"hvf {name}", args=words)
    except KeyboardInterrupt:
        return 130
    except (ValueError, TypeError, OSError, RuntimeError, ImportError) as error:
        message = f"[red]hvf {name}:[/red] {escape(str(error))}"
        console.print(message, highlight=False, soft_wrap=True)
        unusable = (ValueError, TypeError, FileNotFoundError, FileExistsError)
        return 2 if isinstance(error, unusable) else 1
    return 0


def _load(name: str, words: Sequence[str]) -> Callable[..., Any]:
    file, function = COMMANDS[name][0].split(":")
    module = importlib.import_module(file)
    command: Callable[..., Any] = getattr(module, function)
    if hasattr(module, "prepare"):
        command = module.prepare(command, words)
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
