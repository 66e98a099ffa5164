"""Random interaction at the Franka desk: what is collected, on how many cores, and resumed."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import processes

pytest.importorskip("mujoco", reason="MuJoCo 4 needs Python 3.11")

from rich.console import Console

from hvf.data.formats.hdf5 import EpisodeFile
from hvf.domains.desk.collection import DeskCollection, random_episodes, stream
from hvf.envs.desk.arrangement import START, random_arrangement, settled
from hvf.envs.desk.pool import Worker
from hvf.envs.desk.rendering import DeskRenderer
from hvf.envs.desk.simulator import OBSERVABLES, DeskSimulator, Floats, observables
from hvf.envs.desk.tasks import TASKS, make_episodes

STEPS = 7
COLLECTION = 0xC0113C7
"""What ends the key of a collected episode's stream: files depend on it."""


class Never:
    """The word to stop that is never given."""

    def is_set(self) -> bool:
        return False


@pytest.fixture(scope="module")
def worker() -> Any:
    return Worker(16, None, Never())


def collected(path: Path, episodes: int = 5, **options: Any) -> Path:
    config = DeskCollection(path, episodes, STEPS, seed=3, image_size=16, **options)
    return config.run(Console(quiet=True))


def test_processes_and_parts_do_not_show(tmp_path: Path, worker: Worker) -> None:
    one = collected(tmp_path / "one.h5", workers=1, part=5)
    two = collected(tmp_path / "two.h5", workers=2, part=3)
    assert one.read_bytes() == two.read_bytes()
    episodes, diverged = random_episodes(worker, 3, range(5), STEPS, 1)
    with EpisodeFile(one, "desk") as file:
        found = file.read(0, 5)
        assert file.metadata.parameters["action_repeat"] == 1
        assert file.metadata.parameters["states"] == list(OBSERVABLES)
        assert "mujoco" in file.metadata.versions
        assert file.metadata.diverged == 0
        assert (file.metadata.cameras, file.metadata.action_names) == (
            ("front",),
            ("dx", "dy", "dz"),
        )
        assert (file.metadata.action_low, file.metadata.action_high) == (
            (-1.0, -1.0, -1.0),
            (1.0, 1.0, 1.0),
        )
    for name in ("frames", "actions", "states"):
        np.testing.assert_array_equal(getattr(found, name), getattr(episodes, name))
    assert diverged == []


def test_episodes_are_what_the_simulator_and_the_camera_give(worker: Worker) -> None:
    """Stepped one by one, from the start that (seed, number) gives."""
    episodes, _ = random_episodes(worker, 8, [2, 5], STEPS, 3)
    simulator, renderer = DeskSimulator(), DeskRenderer(worker.simulator.model, 16)
    for place, number in enumerate((2, 5)):
        rng = np.random.default_rng([8, number, 0, COLLECTION])
        state = settled(simulator, [random_arrangement(rng, None)])
        for step in range(STEPS + 1):
            np.testing.assert_array_equal(episodes.states[place, step], observables(state)[0])
            np.testing.assert_array_equal(episodes.frames[place, step], renderer.render(state)[0])
            if step < STEPS:
                state = simulator.step(state, episodes.actions[place, step : step + 1])
    # Each random action is held for three steps.
    held = episodes.actions
    np.testing.assert_array_equal(held[:, 0:6:3], held[:, 2:6:3])
    assert (held[:, 2] != held[:, 3]).all()
    assert (np.abs(held) <= 1).all()
    renderer.close()


def test_no_collected_scene_is_that_of_a_task_at_whatever_seed(worker: Worker) -> None:
    """Cubes' angles are drawn alike in both, so that one stream would give both the same."""

    def drawn(rng: np.random.Generator, finger: Any = None) -> tuple[float, ...]:
        arrangement = random_arrangement(rng, finger)
        return (arrangement.drawer, *arrangement.yaws.tolist())

    collected, of_tasks = set(), set()
    for seed in (*range(12), 1_000_000_007, 2**32, 2**32 + COLLECTION, COLLECTION):
        for number in range(5):
            for key in range(len(TASKS)):
                collected.add(drawn(stream(seed, number, key)))
                of_tasks.add(drawn(np.random.default_rng([seed, number, key]), START))
    assert len(collected) == 16 * 5 * len(TASKS)
    assert not collected & of_tasks
    # The same of the two as they are used, in the position of the drawer after settling.
    episodes, _ = random_episodes(worker, 0, range(3), 1, 1)
    drawers = episodes.true_states[:, 0, OBSERVABLES.index("drawer")]
    for task in TASKS:
        starts = observables(make_episodes(worker.simulator, task, 0, 0, 3).starts)
        assert (np.abs(drawers - starts[:, OBSERVABLES.index("drawer")]) > 1e-4).all()


def test_actions_are_uniform_and_things_move() -> None:
    episodes, _ = random_episodes(Worker(8, None, Never()), 0, range(20), 100, 3)
    drawn = episodes.actions[:, ::3].ravel()
    # The variance of a uniform draw is 1/3; of 2040 draws the mean is within five deviations.
    assert abs(drawn.mean()) < 5 * np.sqrt(1 / 3 / drawn.size)
    assert abs(np.abs(drawn).mean() - 0.5) < 5 * np.sqrt(1 / 12 / drawn.size)
    moved = np.ptp(episodes.states, axis=1) > 0.01
    assert moved[:, OBSERVABLES.index("door")].mean() > 0.3
    assert moved[:, 8:].any(axis=1).mean() > 0.7


class Fragile(DeskSimulator):
    """Gives a cube an absurd spin, once in the third step for each of some desks."""

    def __init__(self, desks: list[int]) -> None:
        super().__init__()
        self.desks = desks
        self.steps = 0

    def step(self, states: Floats, actions: Any) -> Floats:
        self.steps += 1
        if self.steps == 3:
            states = states.copy()
            states[self.desks, 60] = 1e9
        return super().step(states, actions)


def test_a_simulation_that_diverges_is_drawn_anew_and_counted(worker: Worker) -> None:
    fragile = Worker(16, None, Never())
    fragile.simulator = Fragile([1])
    episodes, lines = random_episodes(fragile, 3, range(4), STEPS, 1)
    assert lines == ["seed 3, episode 1: the simulation diverged in step 2"]
    expected, _ = random_episodes(worker, 3, range(4), STEPS, 1)
    same = (episodes.frames == expected.frames).all(axis=(1, 2, 3, 4))
    assert same.tolist() == [True, False, True, True]
    # The second try of an episode is a function of (seed, number) too.
    rng = np.random.default_rng([3, 1, 1, COLLECTION])
    start = settled(worker.simulator, [random_arrangement(rng, None)])
    np.testing.assert_array_equal(episodes.states[1, 0], observables(start)[0])
    assert np.isfinite(episodes.states).all()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_stops_all_processes_and_the_same_command_goes_on(
    tmp_path: Path, number: signal.Signals
) -> None:
    out = tmp_path / "desk.h5"
    words = ["collect", "desk", "--out", str(out), "--episodes", "12", "--steps", str(STEPS)]
    words += ["--seed", "3", "--image-size", "16", "--workers", "2", "--part", "1"]
    parts = tmp_path / "desk.h5.parts"
    with processes.started([*processes.HVF, *words]) as child:
        child.wait_until(lambda: len(list(parts.glob("0*.h5"))) >= 2)
        child.tell(number)
        assert child.wait() in (130, 0)
        child.wait_until_gone()
    assert "Traceback" not in child.errors
    collected(out, 12, workers=2, part=1)
    assert out.read_bytes() == collected(tmp_path / "other.h5", 12, workers=1).read_bytes()


@pytest.mark.parametrize("field", ["action_repeat", "workers", "episodes", "part"])
def test_the_config_names_a_bad_number(field: str) -> None:
    with pytest.raises(ValueError, match=field):
        DeskCollection(Path("x.h5"), **{field: -1})
