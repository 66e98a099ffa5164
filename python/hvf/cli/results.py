"""``hvf results DOMAIN FOLDER``: evaluations as Markdown tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from hvf.cli.arguments import domain_named, parsed
from hvf.experiments.tables import markdown, read
from hvf.registry import DOMAINS


@dataclasses.dataclass(frozen=True)
class Results:
    """Print the evaluations in a folder as Markdown tables, with the paper's results below.

    Cells are success rates with 95% Wilson intervals, and the number of trials if it is not 100.
    A second table has the difference that subgoals make on the same episodes, with its interval
    and McNemar's p. Example: hvf results maze results/maze

    Attributes:
        folder: the JSON files that ``hvf eval`` and ``hvf paper`` wrote.
        split: of which episodes, if the folder has several: train, validation or test.
    """

    folder: tyro.conf.Positional[Path]
    split: str | None = None


def run(words: Sequence[str]) -> None:
    """Print the tables."""
    domain, rest = domain_named("results", words)
    config = parsed(Results, f"results {domain.name}", rest)
    print(results(domain.name, config.folder, config.split))


def results(domain: str, folder: Path, split: str | None = None) -> str:
    """The evaluations in a folder as Markdown; see :func:`hvf.experiments.tables.markdown`.

    Raises:
        FileNotFoundError: no such folder, or nothing in it.
        ValueError: files that are no evaluations of this domain, or cannot share a table.
    """
    return markdown(read(folder), DOMAINS[domain], split)
