"""What ``help`` says of ``hvf_core``: of everything, of every argument, and as the stub says it."""

from __future__ import annotations

import inspect
import re
from typing import Any

import pytest

import stub_docs

PUBLIC = dict(stub_docs.public())
CALLED = {name: thing for name, thing in PUBLIC.items() if callable(thing)}


def explained(doc: str) -> list[str]:
    """The arguments that a docstring explains."""
    _, _, arguments = doc.partition("\nArgs:\n")
    arguments, _, _ = arguments.partition("\n\n")
    return re.findall(r"^    (\w+): \S", arguments, re.MULTILINE)


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_everything_public_is_explained(name: str) -> None:
    doc = inspect.cleandoc(PUBLIC[name].__doc__ or "")
    first = doc.split("\n\n")[0]
    assert first.endswith("."), doc


@pytest.mark.parametrize("name", sorted(CALLED))
def test_every_argument_is_explained(name: str) -> None:
    thing: Any = CALLED[name]
    try:
        taken = list(inspect.signature(thing).parameters)
    except ValueError:
        # Planners and worlds make these.
        with pytest.raises(TypeError, match="cannot create"):
            thing()
        taken = []
    taken = [argument for argument in taken if argument != "self"]
    assert sorted(explained(inspect.cleandoc(thing.__doc__))) == sorted(taken)


def test_the_stub_says_what_help_says() -> None:
    """If not: ``python tests/stub_docs.py``."""
    source = stub_docs.STUB.read_text()
    assert stub_docs.documented(source) == source
