"""Golden plans, searches and episodes: what they were, to compare with what they are.

``python tests/golden/record.py`` records them anew from the tree that it is in: after new weights
of the maze's keypoint models, say, and never to make a failing test pass. Names after it record
only those cases that begin with one of them: ``record.py maze/keypoint``.

Letters in shapes: as in :mod:`hvf.protocols`.
"""

from __future__ import annotations

import functools
import json
import platform
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import hvf_core
from hvf.evaluation import Evaluation, Task
from hvf.registry import DOMAINS
from hvf.settings import Planning, World
from hvf.worlds.load import Loaded, load

FOLDER = Path(__file__).parent
PLANS, EPISODES = FOLDER / "plans.json", FOLDER / "episodes.json"
_PLAIN = {"blur": 0.0, "over_horizon": "last"}


def machine() -> str:
    """What the last bits of a learned model depend on, beside torch's threads."""
    import torch

    capability = torch.backends.cpu.get_cpu_capability()
    return f"{platform.machine()} {capability}, torch {version('torch')}"


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch computes with one thread: in how many parts it adds up shows in the last bits."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# ---- plans and searches ------------------------------------------------------------------------


def _maze(**settings: Any) -> Loaded:
    evaluation = Evaluation.of("maze", **{"method": "none", **settings})
    with evaluation.place.open() as place:
        return load(evaluation.place, evaluation.world, evaluation.planning, place)


@functools.cache
def _scenes() -> tuple[Any, Any]:
    """Starts and goals of six hard episodes of the maze, uint8 ``[6, S, S, 3]``."""
    states, targets = hvf_core.maze_episodes(0, 0, 6, "hard")
    goals = np.concatenate([targets, states[:, 2:]], axis=1)
    return hvf_core.maze_render(states), hvf_core.maze_render(goals)


def _maze_plan(problems: int = 6, samples: int = 200, **settings: Any) -> dict[str, Any]:
    starts, goals = _scenes()
    mpc = hvf_core.VisualMPC(horizon=5, samples=samples, elites=10)
    world = _maze(**settings).world
    seeds = list(range(problems))
    return _plans(mpc.plan_batch(world, starts[:problems], goals[:problems], seeds=seeds))


def _maze_search(**settings: Any) -> dict[str, Any]:
    starts, goals = _scenes()
    loaded = _maze(**settings)
    mpc = hvf_core.VisualMPC(horizon=5, samples=50, elites=10)
    search = hvf_core.HVF(mpc=mpc, subgoals=2, samples=30, elites=6, iterations=3)
    return _found(search.search(loaded.world, loaded.generator, starts[0], goals[0], seed=3))


@contextmanager
def _desk(planning: Planning, world: World, generator: bool) -> Iterator[tuple[Loaded, Any]]:
    """Models, and trials of two problems of the desk."""
    desk = DOMAINS["desk"]
    with desk.open(2) as place:
        loaded = load(desk, world, planning, place, generator=generator)
        yield loaded, place.trials("door_two_block", 7, 0, 2)


def _desk_plan() -> dict[str, Any]:
    with _desk(Planning(), World(), False) as (loaded, trials):
        starts = trials.observe(np.arange(2))
        return _plans(_LAYERS.plan_batch(loaded.world, starts, trials.goals, seeds=[0, 1]))


def _desk_search() -> dict[str, Any]:
    with _desk(Planning(), World(), True) as (loaded, trials):
        start, goal = trials.observe(np.arange(1))[0], trials.goals[0]
        search = hvf_core.HVF(mpc=_LAYERS, subgoals=2, samples=12, elites=4, iterations=2)
        return _found(search.search(loaded.world, loaded.generator, start, goal, seed=3))


def _mujoco_plan() -> dict[str, Any]:
    settings: dict[str, Any] = {"initial": "normal", "initial_std": 0.75}
    mpc = hvf_core.VisualMPC(
        horizon=3, samples=12, elites=4, iterations=2, action_repeat=3, **settings
    )
    with _desk(Planning(blur=3.0), World("simulator"), False) as (loaded, trials):
        starts = trials.frames(np.arange(2))
        return _plans(mpc.plan_batch(loaded.world, starts, trials.goals, seeds=[0, 1]))


_LAYERS = hvf_core.VisualMPC(horizon=15, samples=50, elites=10, action_repeat=3, initial="normal")


def _plans(plans: Any) -> dict[str, Any]:
    return {
        "actions": np.asarray(plans.actions).tolist(),
        "costs": np.asarray(plans.costs).tolist(),
    }


def _found(found: Any) -> dict[str, Any]:
    return {
        "latents": np.asarray(found.latents).tolist(),
        "cost": float(found.cost),
        "segments": np.asarray(found.segment_costs).tolist(),
    }


PLAN_CASES: Mapping[str, Callable[[], dict[str, Any]]] = {
    "maze/keypoint/plan": _maze_plan,
    "maze/keypoint/search": _maze_search,
    "maze/simulator/plan": lambda: _maze_plan(dynamics="simulator"),
    "maze/simulator/search": lambda: _maze_search(dynamics="simulator"),
    "maze/keypoint-paper/plan": lambda: _maze_plan(**_PLAIN),
    "maze/keypoint-paper/search": lambda: _maze_search(**_PLAIN),
    "maze/temporal/plan": lambda: _maze_plan(cost="temporal", **_PLAIN),
    "maze/latent/plan": lambda: _maze_plan(2, 50, cost="latent", **_PLAIN),
    "maze/cvae/search": lambda: _maze_search(generator="cvae", **_PLAIN),
    "desk/layers/plan": _desk_plan,
    "desk/layers/search": _desk_search,
    "desk/mujoco/plan": _mujoco_plan,
}
"""Name to what makes it. All but the maze's simulator pass through torch or OpenGL."""


# ---- episodes ----------------------------------------------------------------------------------

EPISODE_CASES: Mapping[str, tuple[int, dict[str, Any]]] = {
    "maze/random": (10, {"method": "random"}),
    "maze/none-medium": (10, {"method": "none", "task": "medium"}),
    "maze/paper-none": (6, {"method": "none", "preset": "paper"}),
    "maze/ground-truth-temporal": (10, {"method": "ground-truth", "cost": "temporal"}),
    "maze/hvf-2": (1, {}),
    "maze/hvf-1-cvae": (
        2,
        {"subgoals": 1, "generator": "cvae", "subgoal_samples": 20, "subgoal_elites": 5},
    ),
    "maze/simulator-hvf-1": (1, {"subgoals": 1, "dynamics": "simulator"}),
    "desk/random": (4, {"method": "random", "task": "door"}),
    "desk/none": (4, {"method": "none", "task": "two_block"}),
    "desk/ground-truth": (3, {"method": "ground-truth", "task": "door_two_block"}),
    "desk/hvf-1": (1, {"subgoals": 1, "task": "door_block"}),
    "desk/simulator-ground-truth": (
        1,
        {"preset": "simulator", "method": "ground-truth", "task": "door", "subgoals": 4},
    ),
}
"""Name to episodes and settings; episodes are the first ones of the test split."""


def episodes(name: str) -> dict[str, Any]:
    """What becomes of the episodes of a case."""
    count, settings = EPISODE_CASES[name]
    evaluation = Evaluation.of(name.partition("/")[0], **{**settings, "split": "test"})
    with Task.open(evaluation, workers=2) as task:
        trials = task.run(0, count).trials
    return {
        "success": [trial.success for trial in trials],
        "steps": [trial.steps for trial in trials],
        "switches": [list(trial.switches) for trial in trials],
    }


def record(only: tuple[str, ...] = ()) -> None:
    """Write both files; of some cases only, if they are named."""
    makers: dict[Path, dict[str, Callable[[], dict[str, Any]]]] = {
        PLANS: dict(PLAN_CASES),
        EPISODES: {name: functools.partial(episodes, name) for name in EPISODE_CASES},
    }
    for path, cases in makers.items():
        before = json.loads(path.read_text())["cases"] if path.is_file() else {}
        made = {}
        for name, make in cases.items():
            if only and not name.startswith(only):
                made[name] = before[name]
                continue
            made[name] = make()
            print(f"{name}: {'the same' if made[name] == before.get(name) else 'changed'}")
        write(path, made)


def write(path: Path, cases: Mapping[str, Any]) -> None:
    """Write a file, a case in a line."""
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(case)}" for name, case in cases.items())
    path.write_text(f'{{\n "machine": {json.dumps(machine())},\n "cases": {{\n{lines}\n }}\n}}\n')


if __name__ == "__main__":
    with one_thread():
        record(tuple(sys.argv[1:]))
