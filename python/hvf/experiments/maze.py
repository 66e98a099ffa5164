"""The maze's tables in Nair & Finn (ICLR 2020), and an ablation of our own settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hvf.evaluation.evaluation import Evaluation
from hvf.experiments.cells import Cell, PaperTable, Setup, varied
from hvf.experiments.judging import Claim, Way, judging
from hvf.experiments.methods import methods
from hvf.experiments.planners import planners
from hvf.registry import COSTS, METHODS

Published = Mapping[str, Mapping[int, float]]

_BY_SUBGOALS = {0: 0.33, 1: 0.47, 2: 0.54, 3: 0.39, 5: 0.02, 10: 0.0}
_BY_REDUCTION: Published = {"max": {1: 0.47, 2: 0.54}, "mean": {1: 0.45, 2: 0.53}}
_BY_SAMPLES: Published = {
    "200": {0: 0.33, 1: 0.47, 2: 0.54},
    "1000": {0: 0.35, 1: 0.54, 2: 0.55},
}
_BY_HORIZON: Published = {
    "5": {0: 0.33, 1: 0.47, 2: 0.54},
    "10": {0: 0.46, 1: 0.55, 2: 0.37},
    "15": {0: 0.31, 1: 0.39, 2: 0.24},
}
_BY_COST = {
    "pixel": {"easy": 0.93, "medium": 0.68, "hard": 0.33},
    "latent": {"easy": 0.62, "medium": 0.49, "hard": 0.23},
}


_WAYS = (Way("paper"), Way("default"), Way("default", "latent"))
"""What the paper's numbers are judged beside: settings, and what they plan with."""


def maze(setup: Setup) -> list[PaperTable]:
    """The maze's tables: the paper's, and those of our own."""
    return [
        *_published(setup),
        _ablation(setup),
        _objectives(setup),
        planners(setup, "hard"),
        *judging(setup, _WAYS, _published, _claims()),
    ]


def _published(setup: Setup) -> list[PaperTable]:
    """The tables of the paper.

    Elites and the steps towards a subgoal stay as they are when samples or the horizon change.
    """
    difficulties = ("easy", "medium", "hard")

    def subgoals(count: int, **settings: Any) -> Evaluation:
        return setup.evaluation("hvf" if count else "none", count, task="hard", **settings)

    def grid(
        name: str, title: str, corner: str, numbers: Published, settings: Callable[[str], Any]
    ) -> PaperTable:
        counts = next(iter(numbers.values()))
        rows = {
            row: tuple(
                Cell(subgoals(count, **{corner: settings(row)}), published)
                for count, published in values.items()
            )
            for row, values in numbers.items()
        }
        return PaperTable(name, title, corner, tuple(map(_counted, counts)), rows)

    def cost(name: str) -> tuple[Cell, ...]:
        # A simulator has states, no images to be measured.
        possible = name == "pixel" or setup.dynamics != "simulator"
        return tuple(
            Cell(
                setup.evaluation("none", task=task, cost=name) if possible else None,
                _BY_COST.get(name, {}).get(task),
            )
            for task in difficulties
        )

    # The paper's own temporal distance is in none of its tables, and does not ship.
    costs = [*_BY_COST, *(["tdm"] if setup.has(COSTS["tdm"].model) else [])]

    return [
        methods(setup, "Methods by difficulty"),
        PaperTable(
            "subgoals",
            "Number of subgoals, hard",
            "subgoals",
            ("success",),
            {str(k): (Cell(subgoals(k), number),) for k, number in _BY_SUBGOALS.items()},
        ),
        grid(
            "reduction",
            "Cost of a sample: the maximum or the mean over its segments, hard",
            "reduction",
            _BY_REDUCTION,
            str,
        ),
        grid("samples", "Samples of the search for actions (D), hard", "samples", _BY_SAMPLES, int),
        grid("horizon", "Planning horizon (H), hard", "horizon", _BY_HORIZON, int),
        PaperTable(
            "cost",
            "Cost without subgoals: pixels, or the latent of the VAE",
            "cost",
            difficulties,
            {name: cost(name) for name in costs},
        ),
    ]


def _claims() -> list[Claim]:
    """Orders that the paper has in numbers (its tables) or in words (its figure of methods)."""

    def hard(method: str, count: int, **settings: Any) -> dict[str, Any]:
        return {"method": method, "subgoals": count, "task": "hard", **settings}

    none = hard("none", 0)
    by_subgoals = [
        Claim(
            f"HVF-{count} than no subgoals, hard",
            hard("hvf", count),
            none,
            "higher" if rate > _BY_SUBGOALS[0] else "lower",
        )
        for count, rate in _BY_SUBGOALS.items()
        if count
    ]
    medium = [
        Claim(
            f"HVF-{count} than no subgoals, medium",
            hard("hvf", count, task="medium"),
            hard("none", 0, task="medium"),
            "higher",
        )
        for count in (1, 2)
    ]
    latent = [
        Claim(
            f"cost in the latent than in pixels, no subgoals, {task}",
            hard("none", 0, task=task, cost="latent"),
            hard("none", 0, task=task),
            "lower",
        )
        for task in _BY_COST["latent"]
    ]
    # TAP with one subgoal is about as good as HVF but on hard episodes, where both of TAP fail;
    # with two, drawn recursively, it is lower everywhere.
    tap = [
        *(
            Claim(
                f"TAP-1 than HVF-1, {task} (paper: about equal)",
                hard("tap", 1, task=task),
                hard("hvf", 1, task=task),
                None,
            )
            for task in ("easy", "medium")
        ),
        Claim("TAP-1 than HVF-1, hard", hard("tap", 1), hard("hvf", 1), "lower"),
        *(
            Claim(f"HVF-2 than TAP-{count}, hard", hard("hvf", 2), hard("tap", count), "higher")
            for count in (1, 2)
        ),
        *(
            Claim(
                f"TAP-2 than TAP-1, {task}",
                hard("tap", 2, task=task),
                hard("tap", 1, task=task),
                "lower",
            )
            for task in ("easy", "medium", "hard")
        ),
    ]
    return [
        *by_subgoals,
        *medium,
        Claim("HVF-2 than HVF-1, hard", hard("hvf", 2), hard("hvf", 1), "higher"),
        Claim("ground truth-2 than HVF-2, hard", hard("ground-truth", 2), hard("hvf", 2), "higher"),
        Claim("HVF-1 than no subgoals, H = 10", *_at(10, hard, 1), "higher"),
        Claim("HVF-2 than no subgoals, H = 10", *_at(10, hard, 2), "lower"),
        Claim("no subgoals: H = 10 than 5", hard("none", 0, horizon=10), none, "higher"),
        *latent,
        *tap,
    ]


def _at(
    horizon: int, of: Callable[..., dict[str, Any]], count: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """So many subgoals, and none, at another horizon."""
    return of("hvf", count, horizon=horizon), of("none", 0, horizon=horizon)


_STEPS_TO_PAPER: Mapping[str, Mapping[str, Any]] = {
    "no blur": {"blur": 0.0},
    "last frame": {"over_horizon": "last"},
    "first actions from N(0, 1)": {"initial": "normal"},
    "M = 200, M* = 40": {"subgoal_samples": 200, "subgoal_elites": 40},
    "subgoals by the CVAE": {"generator": "cvae"},
}
"""In what the paper's settings of the maze differ from our own, one at a time."""


def _ablation(setup: Setup) -> PaperTable:
    """Which of our own settings do what: each taken back alone, and each added alone."""
    ours = setup.evaluation("hvf", preset="default")

    def cells(preset: str, changed: Mapping[str, Any]) -> tuple[Cell, ...]:
        # Without subgoals it does not matter how they are searched for.
        searches = any(name.startswith(("subgoal_", "generator")) for name in changed)
        none: dict[str, Any] = {"method": "none", "subgoals": 0}
        both = (None if searches else none, {"method": "hvf", "subgoals": 2})
        return tuple(
            Cell(setup.evaluation(**{"preset": preset, "task": "hard", **method, **changed}))
            if method
            else Cell(None)
            for method in both
        )

    def reverse(changed: Mapping[str, Any]) -> dict[str, Any]:
        """The same settings as ours has them."""
        return {
            name: getattr(ours.world if name == "generator" else ours.planning, name)
            for name in changed
        }

    rows = {"default": cells("default", {})}
    rows |= {f"default, {name}": cells("default", to) for name, to in _STEPS_TO_PAPER.items()}
    rows["paper"] = cells("paper", {})
    rows |= {
        f"paper but not: {name}": cells("paper", reverse(to))
        for name, to in _STEPS_TO_PAPER.items()
    }
    return PaperTable(
        "ablation",
        "Our own settings against the paper's, one at a time, hard",
        "settings",
        (METHODS["none"].label(0), METHODS["hvf"].label(2)),
        rows,
        extra=True,
    )


_STEPS: Mapping[str, Mapping[str, Any]] = {
    "as they are": {},
    "search by steps of play": {"segment_cost": "distance"},
    "acting by steps of play": {"cost": "temporal"},
    "both by steps of play": {"segment_cost": "distance", "cost": "temporal"},
}


def _objectives(setup: Setup) -> PaperTable:
    """A distance in steps as what segments cost in the search, and frames in acting."""

    def cell(count: int, changed: Mapping[str, Any]) -> Cell:
        # Without subgoals no segment can cost anything else. And plans by this cost are made in
        # torch: a search of plans takes minutes.
        if "segment_cost" in changed if not count else changed.keys() == {"cost"}:
            return Cell(None)
        return varied(setup, "hvf" if count else "none", count, changed, task="hard")

    counts = (0, 1, 2, 3)
    return PaperTable(
        "objectives",
        "What search and acting go by, hard",
        "settings",
        tuple(map(_counted, counts)),
        {name: tuple(cell(k, changed) for k in counts) for name, changed in _STEPS.items()},
        extra=True,
    )


def _counted(subgoals: int) -> str:
    return "no subgoals" if not subgoals else f"{subgoals} subgoal{'s' if subgoals > 1 else ''}"
