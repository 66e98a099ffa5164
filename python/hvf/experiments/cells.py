"""What a table of experiments is made of: cells, each an evaluation beside a published number."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from hvf.evaluation.evaluation import Evaluation
from hvf.registry import COSTS, DOMAINS, METHODS

Order: TypeAlias = Literal["higher", "lower"]
"""Whether the paper has one rate above another, or below it."""


@dataclass(frozen=True)
class Setup:
    """What all evaluations of an experiment share.

    Attributes:
        domain: where.
        preset: settings that they begin with.
        dynamics: what they plan with; None for the preset's.
        generator: what draws subgoals; None for the preset's.
        split: which episodes.
        models: name and checkpoint of models that methods or costs ask and that do not ship, such
            as "tap".

    Raises:
        ValueError: the name of a model that none asks.
    """

    domain: str
    preset: str = "paper"
    dynamics: str | None = None
    generator: str | None = None
    split: str = "test"
    models: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        methods, costs = METHODS.importable(), COSTS.importable()
        each = [*(method.asks for method in methods), *(cost.model for cost in costs)]
        asked = sorted({name for name in each if name is not None})
        for name, _ in self.models:
            if name not in asked:
                raise ValueError(f"models: methods and costs ask {', '.join(asked)}; got {name!r}")

    def has(self, asked: str | None) -> bool:
        """Whether a model is there that a method or a cost asks; one that asks none has it."""
        return asked in (None, *DOMAINS[self.domain].weights, *dict(self.models))

    def evaluation(self, method: str, subgoals: int = 0, **settings: Any) -> Evaluation:
        """One of them; ``settings`` may have another ``preset``.

        Raises:
            ValueError, TypeError: a setting that there is not, or out of range.
        """
        world = {
            "dynamics": self.dynamics,
            "generator": self.generator,
            "method_model": dict(self.models).get(METHODS[method].asks or ""),
        }
        named = {name: value for name, value in world.items() if value is not None}
        cost = settings.get("cost")
        if cost is not None and COSTS[cost].model in dict(self.models):
            named["cost_model"] = dict(self.models)[str(COSTS[cost].model)]
        own: dict[str, Any] = {
            "preset": self.preset,
            "method": method,
            "subgoals": subgoals,
            "split": self.split,
        }
        return Evaluation.of(self.domain, **{**own, **named, **settings})

    @property
    def options(self) -> str:
        """As options of the command."""
        words = [f"--preset {self.preset}"]
        words += [f"--world {self.dynamics}"] if self.dynamics else []
        words += [f"--generator {self.generator}"] if self.generator else []
        words += [f"--split {self.split}"] if self.split != "test" else []
        words += [f"--models {' '.join(itertools.chain(*self.models))}"] if self.models else []
        return " ".join(words)


@dataclass(frozen=True)
class Cell:
    """A number of a table.

    Attributes:
        evaluation: gives ours; None where there is none to have.
        published: the paper's, as a fraction; None where it is in a figure only.
        baseline: what ours is compared with, in pairs, on the same episodes; None for nothing.
        order: how the paper has it beside the baseline; None where it does not say.
    """

    evaluation: Evaluation | None
    published: float | None = None
    baseline: Evaluation | None = None
    order: Order | None = None


def varied(
    setup: Setup, method: str, subgoals: int, changed: Mapping[str, Any], **shared: Any
) -> Cell:
    """A cell with some settings ``changed``, beside what they are in the preset, in pairs."""
    ours = setup.evaluation(method, subgoals, **shared, **changed)
    other = setup.evaluation(method, subgoals, **shared) if changed else None
    return Cell(ours, baseline=other)


@dataclass(frozen=True)
class PaperTable:
    """A table.

    Attributes:
        name: for ``--only``.
        title: what it shows.
        corner: what the rows are.
        columns: names.
        rows: name to cells, one a column.
        extra: whether it is not the paper's: made only when it is named.
    """

    name: str
    title: str
    corner: str
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[Cell, ...]]
    extra: bool = False

    def __post_init__(self) -> None:
        for name, cells in self.rows.items():
            if len(cells) != len(self.columns):
                raise ValueError(f"rows: {name} must have {len(self.columns)} cells")

    @property
    def evaluations(self) -> list[Evaluation]:
        """All that it needs, without repetition."""
        cells = [cell for row in self.rows.values() for cell in row]
        needed = [each for cell in cells for each in (cell.evaluation, cell.baseline) if each]
        return list(dict.fromkeys(needed))
