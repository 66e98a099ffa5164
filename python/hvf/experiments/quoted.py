"""Tables in documents are what a command prints, not what somebody typed.

A document quotes a command's output between two marks::

    <!-- table: hvf results maze results/maze -->
    | settings | ...
    <!-- end -->

``python -m hvf.experiments.quoted README.md docs/results.md`` prints all of them anew, in the
folder of the repository; a test compares.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

_QUOTE = re.compile(r"(<!-- table: hvf (.+?) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


class Quote(NamedTuple):
    """A table in a document.

    Attributes:
        command: words of the command after ``hvf``.
        text: what the document says that it prints.
    """

    command: tuple[str, ...]
    text: str


def quotes(document: str) -> list[Quote]:
    """All tables that a document quotes."""
    return [Quote(tuple(shlex.split(found[2])), found[3]) for found in _QUOTE.finditer(document)]


def refreshed(document: str, printed: Callable[[tuple[str, ...]], str]) -> str:
    """A document with its tables as they are printed now.

    Args:
        document: Markdown.
        printed: gives what a command prints, from its words.
    """
    return _QUOTE.sub(
        lambda found: f"{found[1]}{block(printed(tuple(shlex.split(found[2]))))}{found[4]}",
        document,
    )


def block(output: str) -> str:
    """A command's output as it stands between the marks."""
    return f"{output.strip()}\n"


def printed(command: tuple[str, ...]) -> str:
    """What ``hvf COMMAND`` prints here.

    Raises:
        RuntimeError: it fails.
    """
    from hvf.cli import main

    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        status = main(command)
    if status:
        raise RuntimeError(f"hvf {shlex.join(command)}: ended with status {status}")
    return output.getvalue()


def refresh(*documents: Path) -> None:
    """Print the tables of documents anew.

    Raises:
        FileNotFoundError: no such document.
        RuntimeError: a command fails.
    """
    for document in documents:
        document.write_text(refreshed(document.read_text(), printed))


if __name__ == "__main__":
    refresh(*map(Path, sys.argv[1:]))
