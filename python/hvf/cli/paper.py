"""``hvf paper DOMAIN``: the paper's tables, ours beside them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from hvf.cli.arguments import domain_named, parsed
from hvf.experiments.cells import Setup
from hvf.experiments.paper import all_tables, paper


@dataclasses.dataclass(frozen=True)
class Paper:
    """Run the evaluations behind the paper's tables, and print them with ours beside.

    Each cell is a JSON file; those that are finished are read, and a stopped one goes on with the
    same command. A finished cell of other weights than ship now is kept, and named under its
    table; remove its file to run it anew. Examples:

        hvf paper maze --only subgoals horizon

        hvf paper maze --preset default --world simulator --no-run

        hvf paper maze --only methods --models tap runs/tap/model.safetensors

    Attributes:
        only: names of tables; all if none.
        world: dynamics to plan with: a name or a checkpoint; the preset's if none.
        generator: what draws subgoals; the preset's if none.
        models: name and checkpoint of models that methods and costs ask and that do not ship:
            "tap", "rig", "tdm".
        preset: settings to begin with; the paper's if none, where the domain has these.
        trials: episodes of each evaluation.
        split: which episodes; test is for tables that are published.
        out: folder of the JSON files; results and the domain's name if none.
        workers: evaluations at a time, each on one core; 0 for as many as there are cores.
        chunk: trials that run together, and that a stop loses; 0 for what suits.
        run: run what is missing, or only show what is there.
    """

    only: tuple[str, ...] = ()
    world: str | None = None
    generator: str | None = None
    models: dict[str, str] = dataclasses.field(default_factory=dict)
    preset: str | None = None
    trials: int = 100
    split: str = "test"
    out: Path | None = None
    workers: int = 0
    chunk: int = 0
    run: bool = True


def run(words: Sequence[str]) -> None:
    """Run what is missing, and print the tables.

    Raises:
        RuntimeError: evaluations failed; the tables are printed without them.
    """
    domain, rest = domain_named("paper", words)
    usual = "paper" if "paper" in domain.presets else "default"
    names = ", ".join(table.name for table in all_tables(Setup(domain.name, usual)))
    config = parsed(
        Paper, f"paper {domain.name}", rest, description=f"{_about()}\n\nTables: {names}."
    )
    text, failures = paper(
        Setup(
            domain.name,
            config.preset or usual,
            config.world,
            config.generator,
            config.split,
            tuple(config.models.items()),
        ),
        config.out or Path("results", domain.name),
        only=config.only,
        trials=config.trials,
        workers=config.workers,
        chunk=config.chunk,
        run=config.run,
        console=Console(stderr=True),
    )
    print(text)
    if failures:
        words = [f"{failure.evaluation.name}: {failure.message}" for failure in failures]
        raise RuntimeError(f"{len(failures)} evaluations failed: {'; '.join(words)}")


def _about() -> str:
    return (Paper.__doc__ or "").partition("\n\n    Attributes:")[0]
