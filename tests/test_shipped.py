"""What ships is good for something: floors of success, on validation episodes."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from hvf.domains.weights import WEIGHTS
from hvf.evaluation import Evaluation, evaluate
from hvf.evaluation.scenes import scene_figures
from hvf.models.checkpoint import load_any
from hvf.models.vae_config import DESK_CVAE
from hvf.registry import DOMAINS
from hvf.worlds.images import ImageSubgoals

QUIET = Console(file=io.StringIO())


@pytest.mark.parametrize("domain", ["maze", "desk"])
def test_every_checkpoint_that_ships_is_the_model_that_its_name_says(domain: str) -> None:
    for name, path in DOMAINS[domain].weights.items():
        assert load_any(path).name == name
        assert path.stat().st_size < 15e6


def test_all_that_ships_is_small() -> None:
    assert sum(path.stat().st_size for path in WEIGHTS.glob("*.safetensors")) <= 30e6


def test_hard_mazes_are_mostly_done_without_subgoals() -> None:
    evaluation = Evaluation.of("maze", method="none", task="hard")
    report = evaluate(evaluation, 20, console=QUIET)
    # 75% of 100 test episodes; 20 trials of that go below 10 once in 250 times.
    assert report.successes >= 10
    assert report.kind == "object"


@pytest.mark.slow
def test_a_small_search_does_nearly_all_hard_mazes() -> None:
    few = {"subgoal_samples": 40, "subgoal_elites": 8, "subgoal_iterations": 3, "samples": 100}
    evaluation = Evaluation.of("maze", task="hard", subgoals=2, elites=20, **few)
    assert evaluate(evaluation, 12, console=QUIET).successes >= 8


def test_images_that_are_drawn_at_the_desk_are_of_the_scene_that_is_shown() -> None:
    pytest.importorskip("mujoco")
    model = load_any(DOMAINS["desk"].weights["cvae"]).module
    assert model.config == DESK_CVAE
    generator = ImageSubgoals(model)
    with DOMAINS["desk"].open(1) as place:
        trials = place.trials("door_two_block", 7, 0, 8)
        scenes = trials.observe(np.arange(8))
    # Of its own episode the shown frame itself does not count, so here it is there twice.
    episodes = [np.stack([one, one]) for one in scenes]
    latents = np.random.default_rng(0).standard_normal((16, 1, generator.latent_dim))
    for number, scene in enumerate(scenes):
        drawn = generator.decode(scene[None], latents.astype(np.float32))
        figures = scene_figures(drawn, number, episodes)
        # By chance 1 of 8; the arm, which is elsewhere, is larger than a cube.
        assert figures["kept"] >= 0.75
        assert figures["spread"] > 1e-3


@pytest.mark.slow
def test_the_door_is_mostly_closed(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    evaluation = Evaluation.of("desk", method="none", task="door")
    report = evaluate(evaluation, 6, tmp_path / "door.json", console=QUIET)
    # 99% of 100 test episodes.
    assert report.successes >= 4


@pytest.mark.slow
def test_video_models_mostly_close_the_door(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    evaluation = Evaluation.of("desk", "video", method="none", task="door")
    report = evaluate(evaluation, 6, tmp_path / "door.json", console=QUIET)
    # 98% of 50 test episodes.
    assert report.successes >= 4
    assert report.kind == "video"
