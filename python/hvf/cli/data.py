"""``hvf data import SOURCE``: data sets that others recorded, as files of episodes."""

from __future__ import annotations

from collections.abc import Sequence

from hvf.cli.arguments import named, parsed


def run(words: Sequence[str]) -> None:
    """Import a data set; a stopped import is gone on with.

    Raises:
        ValueError: something else than ``import``.
    """
    from rich.console import Console

    from hvf.data.importing import SOURCES

    if words and words[0] != "import" and not words[0].startswith("-"):
        raise ValueError(f"there is `hvf data import`, and no `hvf data {words[0]}`")
    rest = words[1:] if words[:1] == ["import"] else words
    name, rest = named("data import", SOURCES, rest, lambda source: _first_line(source.__doc__))
    config = parsed(SOURCES[name], f"data import {name}", rest)
    console = Console()
    for path in config.run(console):
        console.print(f"{path}: {_held(path)}", highlight=False)


def _first_line(text: str | None) -> str:
    return (text or "").partition("\n")[0]


def _held(path: object) -> str:
    from hvf.data.formats import open_episodes

    with open_episodes(str(path)) as file:
        height, width, _ = file.frame_shape
        cameras = ", ".join(file.metadata.cameras)
        return (
            f"{len(file)} episodes of up to {file.metadata.steps} steps for "
            f"{file.metadata.parameters['split']}, frames of {height}x{width} ({cameras}), "
            f"{file.action_dim or 'no'} action dimensions"
        )
