"""The command line: ``hvf <verb> [<domain or model>] [options]``.

A verb is one file with ``run(words)``, imported when it is called. Options are generated from
dataclasses; what a domain or model adds comes from the registries, never from a list here.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from collections.abc import Sequence
from typing import NamedTuple

from rich.console import Console
from rich.markup import escape

from hvf.interrupts import sigterm_as_interrupt
from hvf.memory import keep_freed


class Verb(NamedTuple):
    """A verb: its file, what it takes, and what it does in a line."""

    module: str
    takes: str
    about: str


VERBS: dict[str, Verb] = {
    "demo": Verb("hvf.cli.demo", "DOMAIN", "a few episodes with and without subgoals; pictures"),
    "plan": Verb("hvf.cli.plan", "DOMAIN", "plan and act in one episode; a picture and a film"),
    "subgoals": Verb("hvf.cli.subgoals", "", "find subgoals between two images of your own"),
    "eval": Verb("hvf.cli.eval", "DOMAIN", "success of a method, with its interval; resumable"),
    "results": Verb("hvf.cli.results", "DOMAIN", "evaluations in a folder as a Markdown table"),
    "paper": Verb("hvf.cli.paper", "DOMAIN", "every table of the paper, beside its numbers"),
    "collect": Verb("hvf.cli.collect", "DOMAIN", "episodes under random actions; resumable"),
    "data": Verb("hvf.cli.data", "", "import recordings of real robots as episodes; resumable"),
    "train": Verb("hvf.cli.train", "MODEL", "train a model on any episodes; resumable"),
    "probe": Verb("hvf.cli.probe", "", "what a trained model predicts, in numbers and pictures"),
    "report": Verb("hvf.cli.report", "DOMAIN", "models on many recorded episodes; resumable"),
    "export": Verb("hvf.cli.export", "", "a trained model in half precision"),
}

# `signal.SIGPIPE`, which Windows has not.
_SIGPIPE = 13


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb.

    Returns:
        Exit status: 0; 2 for input that cannot be used (a wrong option, value or file), 1 for
        what failed on the way (a full disk, an error of torch), 130 on Ctrl-C or SIGTERM, 141
        where nobody reads what it prints any more.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    if words[:1] in (["--version"], ["-V"]):
        import hvf

        Console().print(f"hvf {hvf.__version__}", highlight=False)
        return 0
    if not words or words[0] not in VERBS:
        return _usage(words)
    verb, rest = words[0], words[1:]
    console = Console(stderr=True)
    keep_freed()
    try:
        with sigterm_as_interrupt():
            importlib.import_module(VERBS[verb].module).run(rest)
            sys.stdout.flush()
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Who read has gone, as `head` does. Python flushes once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + _SIGPIPE
    except (ValueError, TypeError, OSError, RuntimeError, ImportError) as error:
        if debug:
            console.print(escape(traceback.format_exc()), highlight=False, soft_wrap=True)
        console.print(
            f"[red]hvf {verb}:[/red] {escape(str(error))}", highlight=False, soft_wrap=True
        )
        unusable = (ValueError, TypeError, FileNotFoundError, FileExistsError)
        return 2 if isinstance(error, unusable) else 1
    return 0


def _usage(words: Sequence[str]) -> int:
    asked = not words or words[0] in ("-h", "--help")
    console = Console(stderr=not asked)
    if not asked:
        console.print(f"[red]hvf:[/red] no verb {escape(words[0])!r}")
    console.print(
        "usage: hvf <verb> \\[<domain or model>] \\[options]; hvf <verb> --help says more\n"
        "       --version; --debug keeps the traceback of an error\n",
        highlight=False,
    )
    for name, verb in VERBS.items():
        console.print(f"  [bold]{name:9}[/bold] {verb.takes:7} {verb.about}", highlight=False)
    return 0 if asked else 2
