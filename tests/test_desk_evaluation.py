"""The Franka desk in evaluations: trials, the simulator as a world, agents, commands."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo 4 needs Python 3.11")

import hvf_core
from hvf.cli import main
from hvf.domains.desk.place import Desk
from hvf.domains.desk.trials import DeskTrials
from hvf.envs.desk.env import DeskEnv
from hvf.envs.desk.pool import DeskPool
from hvf.envs.desk.rendering import project
from hvf.envs.desk.scene import BLOCKS
from hvf.envs.desk.simulator import (
    DOOR,
    STATE_SIZE,
    STEP_LENGTH,
    WORKSPACE,
    DeskSimulator,
    Floats,
    block_positions,
    end_effectors,
)
from hvf.envs.desk.tasks import MAX_STEPS, TASKS, TaskName, make_episodes, object_success
from hvf.evaluation import Evaluation, Task
from hvf.evaluation.report import load
from hvf.evaluation.run import evaluate_task
from hvf.registry import DOMAINS
from hvf.settings import Planning
from hvf.worlds.mujoco import DeskFrames, MujocoWorld

SIZE = 32
SEED = 5
CHEAP = {
    "samples": 4,
    "elites": 2,
    "keep_elites": 1,
    "iterations": 2,
    "horizon": 3,
    "replan_every": 2,
    "steps": 3,
}


@pytest.fixture(scope="module")
def pool() -> Iterator[DeskPool]:
    with DeskPool(2, SIZE) as pool:
        yield pool


@pytest.fixture(scope="module")
def single() -> Iterator[DeskPool]:
    with DeskPool(1, SIZE) as pool:
        yield pool


def place_of(pool: DeskPool) -> Desk:
    """The desk with a pool that stays open after it."""
    place = Desk.__new__(Desk)
    place.pool = pool
    return place


@pytest.fixture(scope="module")
def simulator() -> DeskSimulator:
    return DeskSimulator()


# ---- trials ------------------------------------------------------------------------------------


def test_trials_are_the_episodes_of_the_environment(pool: DeskPool) -> None:
    trials = DeskTrials(pool, SEED, 3, 2, "door_block")
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
    both = np.arange(2)
    first = trials.observe(both)
    for action in actions:
        trials.step(both, np.stack([action, -action]))
    env = DeskEnv("door_block", image_size=SIZE)
    observation, info = env.reset(seed=SEED, options={"episode": 4})
    np.testing.assert_array_equal(first[1], observation)
    np.testing.assert_array_equal(trials.goals[1], info["goal"])
    for action in actions:
        observation, _, _, _, info = env.step(-action)
    env.close()
    np.testing.assert_array_equal(trials.states[1], info["state"])
    np.testing.assert_array_equal(trials.observe(both)[1], observation)
    assert trials.success(both)[1] == info["success"]
    assert len(trials) == 2


def test_a_step_moves_only_the_trials_that_take_it(pool: DeskPool) -> None:
    trials = DeskTrials(pool, SEED, 0, 3, "door")
    before = trials.states.copy()
    trials.step(np.array([2]), np.ones((1, 3), np.float32))
    np.testing.assert_array_equal(trials.states[:2], before[:2])
    assert not np.array_equal(trials.states[2], before[2])
    frames = trials.frames(np.array([2, 0]))
    np.testing.assert_array_equal(frames.states, trials.states[[2, 0]])
    np.testing.assert_array_equal(frames.images, trials.observe(np.array([2, 0])))


@pytest.mark.parametrize("task", TASKS)
def test_success_is_that_of_the_goal_state(pool: DeskPool, task: TaskName) -> None:
    trials = DeskTrials(pool, SEED, 0, 2, task)
    trials.states[0] = trials.episodes.goals[0]
    assert trials.success(np.arange(2)).tolist() == [True, False]


@pytest.mark.parametrize(
    ("task", "count", "way"),
    [
        ("door", 0, []),
        ("door", 1, ["before 0"]),
        ("two_block", 1, ["after 0"]),
        ("two_block", 3, ["before 0", "after 0", "before 1"]),
        ("door", 4, ["0", "1", "2", "3"]),
        ("two_block", 4, ["1", "3", "5", "7"]),
        ("two_block", 10, ["0", "1", "2", "3", "4", "5", "6", "7", "8", "8"]),
        ("door_two_block", 1, ["after 0"]),
        ("door_two_block", 2, ["after 0", "after 1"]),
        ("door_two_block", 5, ["before 0", "after 0", "before 1", "after 1", "before 2"]),
    ],
)
def test_true_subgoals_are_states_on_the_way(
    pool: DeskPool, task: TaskName, count: int, way: list[str]
) -> None:
    trials = DeskTrials(pool, SEED, 0, 2, task)
    subgoals = trials.true_subgoals(count)
    assert subgoals.shape == (2, count, SIZE, SIZE, 3)
    episodes = trials.episodes
    kinds = {
        "before": episodes.approaches,
        "after": episodes.stages,
        "": episodes.ways.reshape(2, -1, STATE_SIZE),
    }
    for k, words in enumerate(way):
        when, _, number = words.rpartition(" ")
        np.testing.assert_array_equal(subgoals[:, k], pool.render(kinds[when][:, int(number)]))


def test_before_an_object_nothing_has_moved_and_a_straight_push_does_it(
    simulator: DeskSimulator,
) -> None:
    episodes = make_episodes(simulator, "door_two_block", SEED, 0, 6)
    done = 0
    for j in range(3):
        before = episodes.starts if j == 0 else episodes.stages[:, j - 1]
        states = episodes.approaches[:, j]
        np.testing.assert_allclose(states[:, 7:9], before[:, 7:9], atol=2e-3)
        np.testing.assert_allclose(block_positions(states), block_positions(before), atol=5e-3)
        aim = end_effectors(episodes.stages[:, j])
        for _ in range(12):
            move = (aim - end_effectors(states)) / STEP_LENGTH
            states = simulator.step(states, np.clip(move, -1, 1))
        wanted = object_success("door_two_block", episodes.blocks, episodes.stages[:, j])
        found = object_success("door_two_block", episodes.blocks, states)
        done += int((found | ~wanted).all(axis=1).sum())
    # A cube may turn away from a push that nobody corrects.
    assert done >= 15


def test_the_way_goes_over_an_object_then_beside_it_and_pushes_it_all_the_way(
    simulator: DeskSimulator,
) -> None:
    episodes = make_episodes(simulator, "door_block", SEED, 0, 6)
    tips = end_effectors(episodes.ways.reshape(-1, STATE_SIZE)).reshape(6, 2, 5, 3)
    rows = np.arange(6)
    # The cube: above, then low; behind it while it goes; it falls last.
    cube = episodes.blocks.argmax(axis=1)
    places = np.stack([block_positions(way)[:, cube] for way in episodes.ways[:, 0]])
    places = places[rows, :, rows]
    np.testing.assert_allclose(tips[:, 0, 0, 2], WORKSPACE[1, 2], atol=3e-3)
    np.testing.assert_allclose(tips[:, 0, 1:4, 2], WORKSPACE[0, 2], atol=3e-3)
    np.testing.assert_allclose(tips[:, 0, 0, :2], tips[:, 0, 1, :2], atol=3e-3)
    side = np.sign(places[:, 4, 1])
    assert (np.diff(side[:, None] * places[:, 1:, 1]) > 0).all()
    assert (side[:, None] * (places - tips[:, 0])[:, 1:4, 1] > 0.05).all()
    np.testing.assert_allclose(places[:, :4, 2], 0.035, atol=2e-3)
    assert (places[:, 4, 2] < 0).all()
    # The door: by thirds, and the finger beside the handle all the while.
    doors = episodes.ways[:, 1, :, DOOR]
    parts = doors / doors[:, :1]
    np.testing.assert_allclose(parts, np.tile([1, 1, 2 / 3, 1 / 3, 0], (6, 1)), atol=0.04)
    beside = tips[:, 1, 2:, 1] - doors[:, 2:]
    np.testing.assert_allclose(beside, beside[0, 0], atol=5e-3)


def test_points_are_projected_to_where_they_are_drawn(pool: DeskPool) -> None:
    states = make_episodes(DeskSimulator(), "door", SEED, 0, 3).starts
    images = pool.render(states).astype(int)
    for block, channel in zip(range(len(BLOCKS)), (0, 1, 2), strict=True):
        places = project(block_positions(states)[:, block], SIZE)
        for image, (column, row) in zip(images, places, strict=True):
            others = np.delete(image, channel, axis=2).max(axis=2)
            rows, columns = np.nonzero(image[:, :, channel] - others > 110)
            if len(rows) > 4:  # else it is hidden
                assert np.hypot(columns.mean() - column, rows.mean() - row) < 1.5


# ---- the simulator as a world ------------------------------------------------------------------


def problems(pool: DeskPool, simulator: DeskSimulator) -> tuple[DeskFrames, DeskFrames, np.ndarray]:
    """Two problems with three candidates of four steps each."""
    episodes = make_episodes(simulator, "two_block", SEED, 0, 2)
    starts = DeskFrames(pool.render(episodes.starts), episodes.starts)
    goals = MujocoWorld(pool).observe(pool.render(episodes.goals))
    actions = np.random.default_rng(1).uniform(-1, 1, (2, 3, 4, 3)).astype(np.float32)
    return starts, goals, actions


def slow_costs(
    pool: DeskPool, simulator: DeskSimulator, start: Floats, goal: np.ndarray, actions: np.ndarray
) -> list[float]:
    """Costs after every step, one desk and one step at a time."""
    state, costs = start[None], []
    for action in actions:
        state = simulator.step(state, action[None])
        difference = pool.render(state)[0] / 255.0 - goal / 255.0
        costs.append(float((difference**2).sum(axis=2).mean()))
    return costs


@pytest.mark.parametrize("over_horizon", ["last", "sum", "min"])
def test_costs_are_those_of_stepping_drawing_and_comparing_one_by_one(
    pool: DeskPool, simulator: DeskSimulator, over_horizon: str
) -> None:
    starts, goals, actions = problems(pool, simulator)
    world = MujocoWorld(pool, over_horizon=over_horizon)  # type: ignore[arg-type]
    costs = world.rollout_costs(starts, goals, actions)
    assert (costs.shape, costs.dtype) == ((2, 3), np.float32)
    reduce = {"last": lambda path: path[-1], "sum": sum, "min": min}[over_horizon]
    for b in range(2):
        for d in range(3):
            path = slow_costs(pool, simulator, starts.states[b], goals.images[b], actions[b, d])
            np.testing.assert_allclose(costs[b, d], reduce(path), rtol=1e-5)


def test_costs_may_be_of_blurred_frames(pool: DeskPool, simulator: DeskSimulator) -> None:
    starts, goals, actions = problems(pool, simulator)
    costs = MujocoWorld(pool, blur=2.0).rollout_costs(starts, goals, actions)
    last, images = pool.rollout(starts.states, actions[:, 1])
    np.testing.assert_array_equal(images, pool.render(last))
    expected = hvf_core.image_cost(images, goals.images, blur=2.0)
    np.testing.assert_allclose(costs[:, 1], expected, rtol=1e-5)


def test_one_process_and_two_plan_the_same(
    pool: DeskPool, single: DeskPool, simulator: DeskSimulator
) -> None:
    starts, goals, _ = problems(pool, simulator)
    mpc = hvf_core.VisualMPC(horizon=3, action_repeat=3, samples=6, elites=2, iterations=2)
    alone = mpc.plan_batch(MujocoWorld(single), starts, goals, seeds=[7, 8])
    together = mpc.plan_batch(MujocoWorld(pool), starts, goals, seeds=[7, 8])
    np.testing.assert_array_equal(alone.actions, together.actions)
    np.testing.assert_array_equal(alone.costs, together.costs)


def test_a_candidate_that_diverges_costs_nan_and_spoils_no_other(
    pool: DeskPool, simulator: DeskSimulator
) -> None:
    starts, goals, actions = problems(pool, simulator)
    world = MujocoWorld(pool)
    good = world.rollout_costs(starts, goals, actions)
    states = starts.states.copy()
    states[0, 40:] = 1e12
    costs = world.rollout_costs(DeskFrames(starts.images, states), goals, actions)
    assert np.isnan(costs[0]).all()
    np.testing.assert_array_equal(costs[1], good[1])


def test_frames_that_do_not_fit_are_refused(pool: DeskPool, simulator: DeskSimulator) -> None:
    starts, goals, actions = problems(pool, simulator)
    world = MujocoWorld(pool)
    with pytest.raises(ValueError, match=r"^starts: their states are not known"):
        world.rollout_costs(goals, goals, actions)
    with pytest.raises(ValueError, match=r"^images: expected shape \[N, 32, 32, 3\]"):
        world.observe(np.zeros((1, 16, 16, 3), np.uint8))
    with pytest.raises(TypeError, match=r"^images: must be uint8"):
        world.observe(np.zeros((1, 32, 32, 3)))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"^states: expected shape"):
        DeskFrames(starts.images, starts.states[:1])
    with pytest.raises(ValueError, match=r"images: expected shape"):
        hvf_core.VisualMPC(horizon=3).plan_batch(
            world, starts, np.zeros((2, 16, 16, 3), np.uint8), seeds=0
        )


@pytest.mark.parametrize("blur", [-1.0, float("nan"), float("inf")])
def test_a_bad_blur_is_refused(pool: DeskPool, blur: float) -> None:
    with pytest.raises(ValueError, match=r"^blur: "):
        MujocoWorld(pool, blur)
    with pytest.raises(ValueError, match=r"^blur: "):
        Planning(blur=blur)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"dynamics": "no/such.safetensors"},
            r"^dynamics: 'no/such.safetensors' is neither a file",
        ),
        (
            {"generator": "vae"},
            r"^generator: 'vae' is neither .* `hvf train vae --data FILE` makes",
        ),
        ({"generator": "oracle"}, r"^generator: 'oracle' is not available here"),
    ],
)
def test_models_that_are_not_there_are_one_clear_error(
    pool: DeskPool, settings: dict[str, str], message: str
) -> None:
    pytest.importorskip("torch")
    with pytest.raises((FileNotFoundError, ValueError), match=message):
        Task(Evaluation.of("desk", subgoals=1, **settings), place_of(pool))


# ---- evaluations -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"task": "window"}, "^task: "),
        ({"method": "clever"}, "^method: "),
        ({"method": "hvf", "dynamics": "simulator"}, "^method: 'hvf' needs learned dynamics"),
        ({"blur": -1.0}, "^blur: "),
        ({"over_horizon": "first"}, "^over_horizon: "),
        ({"action_repeat": 4}, "^action_repeat: "),
        ({"replan_every": 16}, "^replan_every: "),
        ({"replan_every": 0}, "^replan_every: "),
        ({"steps": 0}, "^steps: "),
        ({"initial": "normal", "initial_std": 0.0}, "^initial_std: "),
        ({"reached_blur": -1.0}, "^reached_blur: "),
        ({"initial": "rightward"}, "^initial: "),
    ],
)
def test_settings_out_of_range_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Evaluation.of("desk", **settings)


def test_settings_are_the_papers_unless_said_otherwise() -> None:
    paper = Evaluation.of("desk", "paper")
    mpc = paper.planning.mpc
    assert (mpc.samples, mpc.elites, mpc.iterations, mpc.keep_elites) == (200, 40, 5, 0)
    assert not paper.planning.warm_start
    assert (mpc.horizon, mpc.action_repeat, mpc.initial) == (15, 3, "normal")
    assert (paper.planning.blur, paper.planning.over_horizon) == (0.0, "last")
    assert paper.acting.steps_per_subgoal == 20
    assert list(DOMAINS["desk"].tasks) == list(TASKS)
    limits = [Evaluation.of("desk", task=task).acting.steps for task in TASKS]
    assert limits == [MAX_STEPS[task] for task in TASKS] == [50, 50, 100, 100]
    assert Evaluation.of("desk", planning=Planning(steps=7)).acting.steps == 7


@pytest.mark.parametrize("method", ["none", "ground-truth", "random"])
def test_processes_and_neighbours_do_not_change_a_trial(
    pool: DeskPool, single: DeskPool, method: str
) -> None:
    settings = {"method": method, "task": "door", "subgoals": 1, "dynamics": "simulator", **CHEAP}
    evaluation = Evaluation.of("desk", steps_per_subgoal=1, threshold=0.0, **settings)
    together = Task(evaluation, place_of(pool)).run(0, 2)
    task = Task(evaluation, place_of(single))
    alone = [task.run(index, 1).trials[0] for index in range(2)]
    assert together.trials == alone
    assert together.decisions == 6
    if method == "ground-truth":
        assert alone[0].switches == (1,)


def test_a_trial_that_diverges_fails_and_says_where_and_the_others_go_on(
    pool: DeskPool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluation = Evaluation.of("desk", method="random", task="door", seed=SEED, steps=4)
    step = DeskTrials.step

    def disturbed(self: DeskTrials, which: np.ndarray, actions: np.ndarray) -> dict[int, str]:
        if (self._taken == 2).all():
            self.states[1, 40:] = 1e12
        return step(self, which, actions)

    task = Task(evaluation, place_of(pool))
    undisturbed = evaluate_task(task, 3, chunk=3)
    monkeypatch.setattr(DeskTrials, "step", disturbed)
    out = tmp_path / "report.json"
    evaluate_task(task, 3, out, chunk=3)
    trials = load(out).trials
    words = f"the simulation diverged: seed {SEED}, episode 1, step 2"
    assert [(trial.success, trial.steps, trial.error) for trial in trials] == [
        (False, 4, None),
        (False, 2, words),
        (False, 4, None),
    ]
    assert [trial.error for trial in undisturbed.trials] == [None] * 3


def test_slow_trials_are_saved_a_few_at_a_time(pool: DeskPool) -> None:
    def chunk(**settings: Any) -> int:
        return Task(Evaluation.of("desk", **settings), place_of(pool)).chunk

    assert chunk(method="random") == 5
    assert chunk(preset="simulator") == 2
    assert chunk(method="none") == 5
    assert chunk(method="hvf") == 1


def test_a_desk_of_ones_own_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[Any] = []
    monkeypatch.setattr(DeskPool, "__init__", lambda self, workers: None)
    monkeypatch.setattr(DeskPool, "close", lambda self: closed.append(self))
    with Task.open(Evaluation.of("desk", method="random"), workers=1):
        assert closed == []
    assert len(closed) == 1
    # Also where what it plans with is not there.
    with pytest.raises(FileNotFoundError):
        Task.open(Evaluation.of("desk", dynamics="no/such"), workers=1)
    assert len(closed) == 2
    with pytest.raises(ValueError, match=r"^workers: "):
        Task.open(Evaluation.of("desk", method="random"), workers=-1)


def test_the_simulators_preset_is_a_whole_command(tmp_path: Path) -> None:
    out = tmp_path / "report.json"
    words = ["--preset=simulator", "--task=door", "--trials=1", f"--out={out}", "--workers=1"]
    cheap = ["--samples=2", "--elites=1", "--keep-elites=1", "--iterations=1", "--steps=1"]
    assert main(["eval", "desk", *words, *cheap]) == 0
    report = load(out)
    assert (report.method, report.preset, report.kind) == ("none", "simulator", "simulator")
    assert report.world == {"dynamics": "simulator", "cost": "pixel"}
    assert report.planning["horizon"] == Evaluation.of("desk", "simulator").planning.horizon


WORDS = [f"--{name.replace('_', '-')}={value}" for name, value in CHEAP.items()]
WORDS += ["--task", "door", "--dynamics", "simulator", "--workers", "1"]


def test_commands_measure_tell_and_draw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "report.json"
    assert main(["eval", "desk", "--method=none", "--trials=1", f"--out={out}", *WORDS]) == 0
    report = load(out)
    assert report.task == "door"
    assert report.planning["samples"] == 4
    assert "workers" not in json.dumps(report.head)
    assert main(["results", "desk", str(tmp_path)]) == 0
    assert "door" in capsys.readouterr().out
    assert main(["results", "maze", str(tmp_path)]) == 2
    plan = ["plan", "desk", "--method=ground-truth", "--subgoals=1", f"--out={tmp_path}", *WORDS]
    assert main([*plan, "--episode=1"]) == 0
    assert iio.imread(tmp_path / "episode-1.png").shape[1] > 4 * 64
    assert len(iio.imread(tmp_path / "episode-1.gif", index=None)) >= 4


def test_the_demo_tells_of_every_episode_and_draws_some(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demo = ["demo", "desk", "--episodes=2", "--pictures=1", f"--out={tmp_path}", *WORDS]
    assert main([*demo, "--method=ground-truth"]) == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"episode-0.png", "episode-0.gif", "ground-truth.json", "none.json"}
    said = " ".join(capsys.readouterr().out.split())
    for method in ("ground truth-2", "no subgoals"):
        for episode in range(2):
            assert f"desk door: {method}, simulator, episode {episode}: goal " in said
    for name in ("ground-truth", "none"):
        assert [trial.index for trial in load(tmp_path / f"{name}.json").trials] == [0, 1]
    assert main([*demo, "--method=none"]) == 0
    assert capsys.readouterr().out.count("episode 0: goal") == 1


def test_the_demo_searches_and_acts_with_the_shipped_models(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    small = "--samples=8 --elites=2 --keep-elites=1 --iterations=1 --steps=4"
    small += " --subgoal-samples=4 --subgoal-elites=2"
    words = ["demo", "desk", "--episodes=1", "--pictures=1", f"--out={tmp_path}", "--workers=1"]
    assert main([*words, *small.split()]) == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"episode-0.png", "episode-0.gif", "hvf.json", "none.json"}
    assert "HVF-2" in capsys.readouterr().out
    searched, straight = (load(tmp_path / f"{name}.json") for name in ("hvf", "none"))
    assert searched.task == straight.task == "door_two_block"
    assert searched.weights.keys() == {"dynamics", "generator"}
    assert straight.weights.keys() == {"dynamics"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["eval", "desk", "--method", "none", "--dynamics", "no/such.safetensors"], "hvf eval:"),
        (["demo", "desk", "--dynamics", "no/such.safetensors"], "no/such.safetensors"),
        (["demo", "desk", "--generator", "vae"], "`hvf train vae --data FILE`"),
        (["demo", "desk", "--episodes", "0"], "episodes: must be at least 1"),
        (["results", "desk", "no/such"], "folder: "),
    ],
)
def test_a_wrong_value_is_one_line_and_status_2(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.strip().splitlines()) == 1
