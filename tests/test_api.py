"""The package from Python: names, load, evaluate, train, and the programs of the README."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import hvf
import hvf_core
import processes
from hvf.domains.domain import Domain, Place
from hvf.evaluation.report import load
from hvf.registry import DOMAINS

CHEAP: dict[str, Any] = {"samples": 30, "elites": 6, "iterations": 2, "steps": 3}


def test_every_public_name_is_there() -> None:
    for name in hvf.__all__:
        assert getattr(hvf, name) is not None
    assert set(hvf.__all__) <= set(dir(hvf))
    assert hvf.VisualMPC is hvf_core.VisualMPC
    assert re.fullmatch(r"\d+\.\d+.*", hvf.__version__) or hvf.__version__ == "0+unknown"
    with pytest.raises(AttributeError, match="module 'hvf' has no attribute 'Sim'"):
        hvf.Sim  # noqa: B018
    assert list(hvf.DOMAINS)[:2] == ["maze", "desk"]
    assert {"none", "hvf", "ground-truth", "random"} <= set(hvf.METHODS)


def test_a_world_is_loaded_and_planned_with() -> None:
    pytest.importorskip("torch")
    world, generator = hvf.load("maze")
    assert isinstance(world, hvf.protocols.WorldModel)
    env = gymnasium.make("hvf/Maze-v0", difficulty="hard")
    image, info = env.reset(seed=0)
    mpc = hvf.VisualMPC(horizon=5, samples=60, elites=10)
    search = hvf.HVF(mpc=mpc, subgoals=2, samples=12, elites=3, iterations=2)
    found = search.search(world, generator, image, info["goal"], seed=0)
    assert len(found.subgoals) == 2
    plan = mpc.plan(world, image, found.subgoals.images[0], seed=0)
    assert plan.actions.shape == (5, 2)
    env.close()


def test_settings_of_what_is_loaded_are_those_of_an_evaluation() -> None:
    world, generator = hvf.load("maze", dynamics="simulator", blur=0.0, over_horizon="last")
    assert isinstance(world, hvf_core.MazeWorld)
    assert isinstance(generator, hvf_core.MazeSubgoals)
    # A blur changes what a plan costs.
    states, targets = hvf_core.maze_episodes(0, 0, 1, "hard")
    start, goal = (
        hvf_core.MazeFrames(x) for x in (states, np.concatenate([targets, states[:, 2:]], axis=1))
    )
    actions = np.ones((1, 4, 3, 2), np.float32)
    blurred = hvf.load("maze", dynamics="simulator", blur=3.0)[0]
    plain = np.asarray(world.rollout_costs(start, goal, actions.copy()))
    assert not np.array_equal(plain, np.asarray(blurred.rollout_costs(start, goal, actions)))
    with pytest.raises(TypeError, match=r"^blurr: there is no such setting"):
        hvf.load("maze", blurr=3.0)
    with pytest.raises(ValueError, match=r"^domain: must be one of maze, desk"):
        hvf.load("moon")
    with pytest.raises(ValueError, match=r"^preset: "):
        hvf.load("maze", "moon")


def test_models_of_a_domain_without_trials_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    class Kitchen(Place):
        def simulator(self, planning: Any) -> Any:
            return ("world", planning.blur)

        def oracle(self) -> Any:
            return "generator"

    monkeypatch.setattr(DOMAINS, "_targets", dict(DOMAINS._targets))
    DOMAINS.register("kitchen", Domain("kitchen", "video", lambda _: Kitchen(), (-1.0,), (1.0,)))
    settings = {"dynamics": "simulator", "generator": "oracle", "blur": 2.0}
    assert hvf.load("kitchen", **settings) == (("world", 2.0), "generator")


def test_a_method_is_evaluated(tmp_path: Path) -> None:
    out = tmp_path / "report.json"
    report = hvf.evaluate(
        "maze", method="none", trials=2, out=str(out), dynamics="simulator", task="easy", **CHEAP
    )
    assert (report.task, report.split, len(report.trials)) == ("easy", "validation", 2)
    assert load(out).trials == report.trials
    again = hvf.evaluate(
        "maze", "paper", method="ground-truth", subgoals=1, trials=1, dynamics="simulator", **CHEAP
    )
    assert (again.preset, again.subgoals, again.planning["initial"]) == ("paper", 1, "normal")


def test_an_evaluation_is_a_value() -> None:
    evaluation = hvf.Evaluation.of("maze", method="none")
    assert evaluation == hvf.Evaluation.of("maze", method="none")
    assert hash(evaluation) == hash(dataclasses.replace(evaluation))
    assert evaluation.name == "maze hard: no subgoals, keypoint"


def test_a_model_is_trained(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from rich.console import Console

    from hvf.domains.maze_collection import MazeCollection

    quiet = Console(quiet=True)
    data = MazeCollection(tmp_path / "maze.h5", episodes=6, steps=4, image_size=16).run(quiet)
    model = {"channels": (4, 8), "strides": (2, 2), "pyramid_levels": 1}
    loop = {"steps": 2, "warmup_steps": 0, "device": "cpu", "threads": 1}
    trained = hvf.train(
        "cvae", data, out=tmp_path / "run", batch_size=2, model=model, loop=loop, console=quiet
    )
    assert trained.config.image_size == (16, 16)
    assert (tmp_path / "run" / "model.safetensors").is_file()


# ---- the README --------------------------------------------------------------------------------

README = Path(__file__).parent.parent / "README.md"
BLOCK = re.compile(r"(<!-- not run -->\s*)?^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def programs() -> list[str]:
    """The README's blocks of Python that are meant to run."""
    if not README.is_file():
        return []
    return [code for skipped, code in BLOCK.findall(README.read_text()) if not skipped]


@pytest.mark.parametrize("number", range(len(programs())))
def test_a_program_of_the_readme_runs(number: int, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    program = f"import os\nos.chdir({str(tmp_path)!r})\n{programs()[number]}"
    processes.run(processes.python(program), check=True)


def test_blocks_are_told_apart() -> None:
    blocks = ["x", "```python\na\n```", "<!-- not run -->\n```python\nb\n```", "```\nc\n```"]
    text = "\n".join([*blocks, "```python\nd\n```"])
    found = [code for skipped, code in BLOCK.findall(text) if not skipped]
    assert found == ["a\n", "d\n"]
