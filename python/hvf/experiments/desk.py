"""The desk's figure in Nair & Finn (ICLR 2020), and what acting and search go by here."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from hvf.evaluation.evaluation import Evaluation
from hvf.experiments.cells import Cell, PaperTable, Setup, varied
from hvf.experiments.judging import Claim, Way, judging
from hvf.experiments.methods import methods
from hvf.registry import DOMAINS, METHODS

_CHOSEN = {"two_block": 1, "door_block": 1, "door_two_block": 2}
"""Subgoals of each task with more than the door to it, chosen on validation."""

_NO_SCENE: Mapping[str, Any] = {"scene_weight": 0.0}

_CHOICES: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "no subgoals": ("none", {}),
    "HVF": ("hvf", {}),
    "true subgoals": ("ground-truth", {}),
    "no subgoals, whole images alone": ("none", _NO_SCENE),
    "HVF, whole images alone": ("hvf", _NO_SCENE),
    "true subgoals, whole images alone": ("ground-truth", _NO_SCENE),
    "HVF, whole images alone, mean of segments": ("hvf", {**_NO_SCENE, "reduction": "mean"}),
}

_STEPS: Mapping[str, Any] = {"segment_cost": "distance"}

_OBJECTIVES: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "likelihood, hardest segment": ("hvf", {}),
    "likelihood, mean of segments": ("hvf", {"reduction": "mean"}),
    "likelihood, hardest and sum": ("hvf", {"reduction": "max-sum"}),
    "steps of play, hardest segment": ("hvf", _STEPS),
    "steps of play, mean of segments": ("hvf", {**_STEPS, "reduction": "mean"}),
    "steps of play, hardest and sum": ("hvf", {**_STEPS, "reduction": "max-sum"}),
}

_ACTING: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "no subgoals, pixels": ("none", {}),
    "no subgoals, steps of play": ("none", {"cost": "temporal"}),
    "true subgoals, pixels": ("ground-truth", {}),
    "true subgoals, steps of play": ("ground-truth", {"cost": "temporal"}),
}

_ONE_AT_A_TIME: Mapping[str, Mapping[str, Any]] = {
    "default": {},
    "T = 100": {"steps": 100},
    "T* = 10": {"steps_per_subgoal": 10},
    "T* = 10, chosen anew": {"steps_per_subgoal": 10, "choose_anew": True},
    "reached below 0.002": {"threshold": 2e-3},
    "scene counts 0 times": _NO_SCENE,
    "scene counts 10 times": {"scene_weight": 10.0},
    "scene counts 30 times": {"scene_weight": 30.0},
    "last frame": {"over_horizon": "last"},
    "H = 24": {"horizon": 24},
    "D = 200, D* = 10": {"samples": 200, "elites": 10},
    "a plan at every step": {"replan_every": 1},
    "no warm start": {"warm_start": False},
}
_OF_SUBGOALS = {"steps_per_subgoal", "threshold"}
"""Settings that make no difference without subgoals."""

_SMALL: Mapping[str, Any] = {"subgoal_samples": 128, "subgoal_elites": 12, "subgoal_iterations": 3}

_PROPOSALS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "HVF": ("hvf", {}),
    "HVF from proposals": ("hvf-proposals", {}),
    "HVF, M = 128, 3 iterations": ("hvf", _SMALL),
    "HVF from proposals, M = 128, 3 iterations": ("hvf-proposals", _SMALL),
    "128 proposals, no search": ("amortised", {}),
}


_WAYS = (Way("default"), Way("video"))
"""What the paper's numbers are judged beside: settings, with what they plan with."""


def desk(setup: Setup) -> list[PaperTable]:
    """The desk's tables."""
    return [
        *_published(setup),
        _choices(setup),
        _objectives(setup),
        _acting(setup),
        _sweep(setup),
        _proposals(setup),
        _video(setup),
        *judging(setup, _WAYS, _published, _claims()),
    ]


def _published(setup: Setup) -> list[PaperTable]:
    """The paper's figure."""
    return [methods(setup, "Methods by task")]


def _claims() -> list[Claim]:
    """Orders that the paper has in words: two subgoals are over 20 points better on each task.

    Better than none, than TAP and than RIG. It does not say what one does, but on the last task,
    where it is as good as none; and it has no true subgoals at the desk, beside which searched
    ones are set here.
    """
    none = {"method": "none", "subgoals": 0}
    claims = [
        Claim(
            f"HVF-{count} than no subgoals, {task}",
            {"method": "hvf", "subgoals": count, "task": task},
            {**none, "task": task},
            "higher" if count == 2 else None,
        )
        for task in DOMAINS["desk"].tasks
        for count in (1, 2)
    ]
    last = {"method": "hvf", "task": "door_two_block"}
    claims.append(
        Claim(
            "HVF-2 than HVF-1, door_two_block",
            {**last, "subgoals": 2},
            {**last, "subgoals": 1},
            "higher",
        )
    )
    claims += [
        Claim(
            f"ground truth-{count} than HVF-{count}, {task}",
            {"method": "ground-truth", "subgoals": count, "task": task},
            {"method": "hvf", "subgoals": count, "task": task},
            None,
        )
        for task, count in _CHOSEN.items()
    ]
    claims += [
        Claim(
            f"HVF-2 than {METHODS[method].label(count)}, {task}",
            {"method": "hvf", "subgoals": 2, "task": task},
            {"method": method, "subgoals": count, "task": task},
            "higher",
        )
        for method, count in (("tap", 1), ("rig", 0))
        for task in DOMAINS["desk"].tasks
    ]
    return claims


def _choices(setup: Setup) -> PaperTable:
    """What a frame costs in acting, and how segments are reduced in the search."""
    title = "What counts, in acting and in the search for subgoals"
    return _of_tasks(setup, "choices", title, "choice", _CHOSEN, _CHOICES)


def _objectives(setup: Setup) -> PaperTable:
    """What a segment costs in the search, and how the costs of segments are reduced."""
    title = "What the search for subgoals goes by"
    first = next(iter(_OBJECTIVES))
    with_first = dict.fromkeys([name for name in _OBJECTIVES if name != first], first)
    return _of_tasks(setup, "objectives", title, "segments cost", _CHOSEN, _OBJECTIVES, with_first)


def _acting(setup: Setup) -> PaperTable:
    """What a predicted frame costs in acting."""
    title = "What acting goes by"
    with_pixels = {
        f"{method}, steps of play": f"{method}, pixels"
        for method in ("no subgoals", "true subgoals")
    }
    return _of_tasks(setup, "acting", title, "frames cost", _CHOSEN, _ACTING, with_pixels)


def _sweep(setup: Setup) -> PaperTable:
    """Settings of acting, one at a time, on the task that subgoals help least."""
    task = "two_block"

    def cell(method: str, changed: Mapping[str, Any]) -> Cell:
        count = 0 if method == "none" else _CHOSEN[task]
        # True subgoals are not chosen, so not anew either.
        fixed = {"none": _OF_SUBGOALS, "ground-truth": {"choose_anew"}}
        if changed.keys() & fixed.get(method, set()):
            return Cell(None)
        return varied(setup, method, count, changed, task=task)

    chosen = ("none", "hvf", "ground-truth")
    return PaperTable(
        "sweep",
        "Settings of acting, one at a time, 2 Block",
        "settings",
        tuple(METHODS[each].label(0 if each == "none" else _CHOSEN[task]) for each in chosen),
        {
            name: tuple(cell(method, changed) for method in chosen)
            for name, changed in _ONE_AT_A_TIME.items()
        },
        extra=True,
    )


def _proposals(setup: Setup) -> PaperTable:
    """What proposals by a network are worth to the search, and without it."""
    title = "Subgoals that a network proposes"
    return _of_tasks(setup, "proposals", title, "subgoals", _CHOSEN, _PROPOSALS)


def _of_tasks(
    setup: Setup,
    name: str,
    title: str,
    heading: str,
    tasks: Mapping[str, int],
    choices: Mapping[str, tuple[str, Mapping[str, Any]]],
    compared: Mapping[str, str] | None = None,
) -> PaperTable:
    """A table of our own: methods and their settings by task, with its number of subgoals.

    Rows of ``compared`` stand beside others, in pairs.
    """

    def evaluation(choice: str, task: str) -> Evaluation:
        method, settings = choices[choice]
        count = 0 if method == "none" else tasks[task]
        return setup.evaluation(method, count, task=task, **settings)

    beside = compared or {}
    rows = {
        choice: tuple(
            Cell(
                evaluation(choice, task),
                baseline=evaluation(beside[choice], task) if choice in beside else None,
            )
            for task in tasks
        )
        for choice in choices
    }
    columns = tuple(f"{task}, K = {count}" for task, count in tasks.items())
    return PaperTable(name, title, heading, columns, rows, extra=True)


_WIDE: Mapping[str, Any] = {"samples": 1000, "elites": 40, "iterations": 5}

_BUDGETS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "no subgoals": ("none", {}),
    "HVF": ("hvf", {}),
    "true subgoals": ("ground-truth", {}),
    "no subgoals, D = 1000, 5 iterations": ("none", _WIDE),
    "true subgoals, D = 1000, 5 iterations": ("ground-truth", _WIDE),
}


def _video(setup: Setup) -> PaperTable:
    """Video models throughout: what true subgoals, and more candidates, are worth."""
    tasks = {task: count for task, count in _CHOSEN.items() if task != "two_block"}
    title = "Video models throughout, and the budget of the search for actions"
    with_preset = dataclasses.replace(setup, preset="video")
    return _of_tasks(with_preset, "video", title, "method", tasks, _BUDGETS)
