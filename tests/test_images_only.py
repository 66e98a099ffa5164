"""Every method reads images only; what knows more says so, and cannot do without."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from blind import Blind
from hvf.evaluation import Evaluation, Outcome, Task, act
from hvf.models.checkpoint import save_model
from hvf.models.rig import RIG, RIGConfig
from hvf.models.tap import TAP, TAPConfig
from hvf.registry import METHODS

QUICK: dict[str, Any] = {
    "samples": 12,
    "elites": 4,
    "keep_elites": 0,
    "iterations": 1,
    "horizon": 3,
    "steps": 4,
    "steps_per_subgoal": 2,
    "choose_anew": True,
    "subgoals": 2,
    "subgoal_samples": 8,
    "subgoal_elites": 3,
    "subgoal_iterations": 1,
}
KNOWING = {"ground-truth"}
"""Methods that are told more than what is seen: bounds to compare with."""


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Checkpoints of untrained models of the maze, for methods that ask what does not ship."""
    folder = tmp_path_factory.mktemp("models")
    torch.manual_seed(0)
    models = {
        "tap": TAP(TAPConfig(channels=(4, 4, 8, 8), hidden=16)),
        "rig": RIG(RIGConfig(action_low=(-3.0, -3.0), action_high=(3.0, 3.0), layers=(16, 16))),
    }
    paths = {name: folder / f"{name}.safetensors" for name in models}
    for name, model in models.items():
        save_model(paths[name], model, environment="maze")
    return {name: str(path) for name, path in paths.items()}


def blindfolded(domain: str, own: dict[str, str], **settings: Any) -> tuple[Blind, Outcome, Task]:
    """Two short episodes of a method that sees images only."""
    asked = METHODS[settings["method"]].asks
    if asked in own:
        settings["method_model"] = own[asked]
    evaluation = Evaluation.of(domain, **{**QUICK, **settings})
    with Task.open(evaluation, workers=1) as task:
        trials = Blind(task.trials(0, 2))
        outcome = act(trials, task.agent, evaluation.acting, task.seeds(0, 2))  # type: ignore[arg-type]
    return trials, outcome, task


def check(domain: str, own: dict[str, str], **settings: Any) -> None:
    trials, outcome, task = blindfolded(domain, own, **settings)
    assert trials.refused == []
    assert all(trial.steps and trial.error is None for trial in outcome.trials)
    method = METHODS[task.evaluation.method]
    drawn = 2 if method.has_subgoals else 0
    assert [len(found) for found in outcome.subgoals] == [drawn] * 2
    assert task.kind != "simulator"


@pytest.mark.parametrize("method", [name for name in METHODS if name not in KNOWING])
def test_every_method_reads_images_only(method: str, own: dict[str, str]) -> None:
    if METHODS[method].asks == "layers-proposals":
        pytest.importorskip("mujoco", reason="the desk, which its proposals are for")
        check("desk", own, method=method, task="door")
    else:
        check("maze", own, method=method)


@pytest.mark.parametrize("dynamics", ["keypoint", "latent"])
@pytest.mark.parametrize("method", ["none", "hvf", "tap"])
def test_so_it_does_with_every_kind_of_dynamics(
    method: str, dynamics: str, own: dict[str, str]
) -> None:
    check("maze", own, method=method, dynamics=dynamics)


@pytest.mark.parametrize(
    "settings",
    [
        {"segment_cost": "likelihood", "horizon": 3, "action_repeat": 3},
        {"preset": "video", "horizon": 3, "action_repeat": 3},
    ],
)
def test_so_it_does_at_the_desk(settings: dict[str, Any], own: dict[str, str]) -> None:
    pytest.importorskip("mujoco")
    for method in ("none", "hvf"):
        check("desk", own, method=method, task="door", replan_every=3, **settings)


def test_true_subgoals_are_no_images_that_a_method_may_read(own: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="'ground-truth' needs true_subgoals, which Blind lacks"):
        blindfolded("maze", own, method="ground-truth")


def test_true_dynamics_are_refused_what_no_image_tells(own: dict[str, str]) -> None:
    pytest.importorskip("mujoco")
    with pytest.raises(ValueError, match="plan from true states, which Blind does not tell"):
        blindfolded("desk", own, preset="simulator", method="none", task="door", replan_every=3)
    with pytest.raises(ValueError, match="needs learned dynamics at the desk: no simulator can"):
        blindfolded("desk", own, preset="simulator", method="hvf", task="door", replan_every=3)


def test_a_blindfold_hides_what_is_no_image(own: dict[str, str]) -> None:
    evaluation = Evaluation.of("maze", method="random", **QUICK)
    with Task.open(evaluation) as task:
        trials = task.trials(0, 1)
    for name in ("states", "targets", "layout", "true_subgoals", "positions"):
        assert hasattr(trials, name)
        assert not hasattr(Blind(trials), name)
