"""Write what ``help(hvf_core)`` says into the stub; the Rust sources are where it is from.

    python tests/stub_docs.py

``test_stub.py`` holds that this would change nothing.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hvf_core

STUB = Path(__file__).parents[1] / "python" / "hvf_core" / "__init__.pyi"


def public() -> Iterator[tuple[str, Any]]:
    """What the module has to explain, by name: classes, their attributes and methods, functions."""
    for name in hvf_core.__all__:
        thing = getattr(hvf_core, name)
        if callable(thing):
            yield name, thing
        if isinstance(thing, type):
            for part in vars(thing):
                if not part.startswith("_"):
                    yield f"{name}.{part}", getattr(thing, part)


def documented(source: str) -> str:
    """A stub with the module's docstrings in the place of its own."""
    docs = {name: inspect.cleandoc(thing.__doc__ or "") for name, thing in public()}
    lines = source.splitlines()
    for name, node in reversed(list(definitions(ast.parse(source)))):
        rewrite(lines, node, docs.get(name, ""))
    return "\n".join(lines) + "\n"


Definition = ast.ClassDef | ast.FunctionDef


def definitions(node: ast.Module | ast.ClassDef, prefix: str = "") -> Iterator[Any]:
    """Classes and functions with their names, in the order of the source."""
    for child in node.body:
        if isinstance(child, Definition):
            yield prefix + child.name, child
        if isinstance(child, ast.ClassDef):
            yield from definitions(child, f"{child.name}.")


def rewrite(lines: list[str], node: Definition, doc: str) -> None:
    """Put a docstring at the head of a definition, which is all that a function's body is."""
    first = node.body[0]
    place = first.lineno - 1
    is_doc = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    if isinstance(node, ast.ClassDef):
        end = first.end_lineno if is_doc and isinstance(first.value.value, str) else place
        rest = [""] if doc and lines[end].strip() else []
        lines[place:end] = quoted(doc, node) + rest
        return
    head = lines[place][: first.col_offset].rstrip()
    begun = [head] if head else []
    if not doc:
        if begun:
            begun = [f"{head} ..."]
        else:
            place -= 1
            begun = [f"{lines[place]} ..."]
    lines[place : first.end_lineno] = begun + quoted(doc, node)


def quoted(doc: str, node: Definition) -> list[str]:
    """The lines of a docstring within a definition."""
    if not doc:
        return []
    assert '"""' not in doc, doc
    assert "\\" not in doc, doc
    text = f'"""{doc}' + ('\n"""' if "\n" in doc else '"""')
    indent = " " * (node.col_offset + 4)
    return [indent + line if line else "" for line in text.splitlines()]


if __name__ == "__main__":
    STUB.write_text(documented(STUB.read_text()))
