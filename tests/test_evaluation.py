"""Acting, agents, success rates, pictures and the commands that make them."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.progress import Progress

import hvf_core
import processes
from hvf.agents.planning import NoSubgoals, PlanningAgent
from hvf.cli import main
from hvf.cli.plan import how_it_went, watch
from hvf.domains.maze import MazeTrials
from hvf.evaluation import Acting, Decision, MazeEvaluation, MazePlanning, Outcome, Trial, act
from hvf.evaluation.acting import derived_seed
from hvf.evaluation.pictures import save_film, save_strip
from hvf.evaluation.recording import record
from hvf.evaluation.run import evaluate, load
from hvf.evaluation.statistics import wilson_interval
from hvf.settings import Replanning

CHEAP = {"samples": 30, "elites": 6, "iterations": 2, "subgoal_samples": 12, "subgoal_elites": 4}


def cheap(**settings: object) -> MazeEvaluation:
    """An evaluation with the true simulator and small budgets."""
    return MazeEvaluation.of(model="simulator", **{**CHEAP, "subgoal_iterations": 2, **settings})


class Line:
    """Trials on a line: places 0, 1, 2 ... as images of one pixel; the goal is at 9."""

    def __init__(self, starts: Sequence[int]) -> None:
        self.at = np.array(starts)
        self.goals = images([9] * len(starts))

    def __len__(self) -> int:
        return len(self.at)

    def observe(self, which: np.ndarray) -> np.ndarray:
        return images(self.at[which])

    def step(self, which: np.ndarray, actions: np.ndarray) -> dict[int, str]:
        self.at[which] += actions[:, 0].astype(int)
        return {}

    def success(self, which: np.ndarray) -> np.ndarray:
        return self.at[which] == 9


def images(places: Sequence[int] | np.ndarray) -> np.ndarray:
    return np.repeat(np.asarray(places, np.uint8), 3).reshape(-1, 1, 1, 3)


class Walker:
    """Goes towards its target by `stride` places a step, and remembers its targets."""

    def __init__(self, subgoals: Sequence[int], stride: int = 1) -> None:
        self.chosen = images(subgoals)
        self.stride = stride
        self.aims: list[list[int]] = []

    def subgoals(self, trials: Line, seeds: Sequence[int]) -> list[np.ndarray]:
        return [self.chosen] * len(trials)

    def act(
        self, which: np.ndarray, seen: np.ndarray, targets: np.ndarray, seeds: Sequence[int]
    ) -> Decision:
        here, there = seen[:, 0, 0, 0].astype(int), targets[:, 0, 0, 0].astype(int)
        self.aims.append(there.tolist())
        move = np.clip(there - here, -self.stride, self.stride)
        return Decision(move[:, None].astype(np.float32), np.abs(there - here).astype(np.float32))


def test_goes_on_to_the_next_subgoal_when_it_sees_that_it_is_there() -> None:
    walker = Walker([3, 5])
    outcome = act(Line([0]), walker, Acting(threshold=1e-9), [0])
    assert outcome.trials == [Trial(True, 9, (3, 5), tuple(float(c) for c in "321214321"))]
    assert walker.aims == [[3]] * 3 + [[5]] * 2 + [[9]] * 4


def test_skips_subgoals_that_are_reached_already() -> None:
    outcome = act(Line([3]), Walker([3, 3]), Acting(threshold=1e-9), [0])
    assert outcome.trials[0].switches == (0, 0)


def test_gives_a_subgoal_up_after_so_many_steps_but_never_the_goal() -> None:
    # Cannot move: aims at each subgoal for two steps, then at the goal to the end.
    walker = Walker([3, 5], stride=0)
    outcome = act(Line([0]), walker, Acting(steps=7, steps_per_subgoal=2, threshold=0.0), [0])
    assert outcome.trials == [Trial(False, 7, (2, 4), (3.0, 3.0, 5.0, 5.0, 9.0, 9.0, 9.0))]


def test_planned_cost_may_decide_that_a_subgoal_is_reached() -> None:
    walker = Walker([3])
    config = Acting(threshold=1.5, reached="planned")
    outcome = act(Line([0]), walker, config, [0])
    # One place away is close enough: it plans again, towards the goal.
    assert outcome.trials[0].switches == (2,)
    assert walker.aims[2:4] == [[3], [9]]


def test_success_ends_a_trial_and_the_others_go_on() -> None:
    steps = []
    outcome = act(
        Line([7, 0, 9]),
        Walker([]),
        Acting(steps=5),
        [0, 1, 2],
        lambda t, w: steps.append((t, list(w))),
    )
    assert [trial.success for trial in outcome.trials] == [True, False, True]
    # Success is asked after a step: even the last one, which begins at its goal, takes one.
    assert [trial.steps for trial in outcome.trials] == [2, 5, 1]
    assert steps == [(1, [0, 1, 2]), (2, [0, 1]), (3, [1]), (4, [1]), (5, [1])]
    assert outcome.decisions == 8


def test_a_trial_does_not_depend_on_the_others() -> None:
    task = cheap(difficulty="medium", subgoals=1, steps=4).task()
    together = task.run(0, 3)
    for index in range(3):
        alone = task.run(index, 1)
        assert alone.trials[0] == together.trials[index]
        np.testing.assert_array_equal(alone.subgoals[0], together.subgoals[index])


@pytest.mark.parametrize("agent", ["hvf", "none", "ground-truth", "random"])
def test_every_agent_repeats_itself_from_its_seed(agent: str) -> None:
    outcomes = [cheap(agent=agent, steps=3).task().run(0, 2) for _ in range(2)]
    assert outcomes[0].trials == outcomes[1].trials
    counts = {len(subgoals) for subgoals in outcomes[0].subgoals}
    assert counts == {2 if agent in ("hvf", "ground-truth") else 0}


def test_planning_beats_chance_and_warm_starts_work() -> None:
    def successes(**settings: object) -> int:
        outcome = (
            cheap(difficulty="easy", steps=15, over_horizon="sum", **settings).task().run(0, 8)
        )
        return sum(trial.success for trial in outcome.trials)

    chance = successes(agent="random")
    assert successes(agent="none") > chance
    assert successes(agent="none", warm_start=True) > chance


class Road:
    """A world of places on a line: a plan costs its distance to the goal, plus `toll` a call."""

    action_low = np.array([-2.0], np.float32)
    action_high = np.array([2.0], np.float32)

    def __init__(self, toll: float = 0.0) -> None:
        self.toll = toll
        self.asked = 0

    def rollout_costs(
        self, starts: np.ndarray, goals: np.ndarray, actions: np.ndarray
    ) -> np.ndarray:
        self.asked += 1
        here, there = (frames[:, 0, 0, 0].astype(np.float32) for frames in (starts, goals))
        ends = here[:, None] + actions[..., 0].sum(axis=2)
        return (ends - there[:, None]) ** 2 + self.toll * self.asked


MPC = hvf_core.VisualMPC(horizon=4, samples=20, elites=5, iterations=1)


def decide(
    agent: PlanningAgent, targets: Sequence[int], which: Sequence[int] = (0,)
) -> list[np.ndarray]:
    """Actions of trials that stand still, towards a target at each step, with the step as seed."""
    agent.subgoals(Line([0] * len(which)), [0])
    count = len(which)
    return [
        agent.act(
            np.array(which), images([20] * count), images([target] * count), [step] * count
        ).actions[0]
        for step, target in enumerate(targets)
    ]


def test_a_plan_is_acted_for_as_many_steps_as_asked() -> None:
    world = Road()
    actions = decide(PlanningAgent(world, MPC, NoSubgoals(), Replanning(every=3)), [25] * 5)
    assert world.asked == 2
    plans = [MPC.plan(Road(), images([20]), images([25]), seed=seed).actions for seed in (0, 3)]
    np.testing.assert_array_equal(actions, [*plans[0][:3], *plans[1][:2]])


def test_a_new_target_gets_a_new_plan_at_once() -> None:
    world = Road()
    actions = decide(PlanningAgent(world, MPC, NoSubgoals(), Replanning(every=4)), [25, 25, 15])
    assert world.asked == 2
    expected = MPC.plan(Road(), images([20]), images([15]), seed=2).actions[0]
    np.testing.assert_array_equal(actions[2], expected)


def test_a_plan_may_be_kept_to_its_end_while_none_is_better() -> None:
    # Every later plan costs more by the toll.
    world = Road(toll=100.0)
    replanning = Replanning(every=1, keep_better=True)
    actions = decide(PlanningAgent(world, MPC, NoSubgoals(), replanning), [25] * 6)
    assert world.asked == 6
    first = MPC.plan(Road(), images([20]), images([25]), seed=0).actions
    np.testing.assert_array_equal(actions[:4], first)
    second = MPC.plan(Road(), images([20]), images([25]), seed=4).actions
    np.testing.assert_array_equal(actions[4:], second[:2])


def test_a_warm_start_after_some_steps_begins_with_the_rest_of_the_plan() -> None:
    agent = PlanningAgent(Road(), MPC, NoSubgoals(), Replanning(every=3, warm_start=True))
    actions = decide(agent, [25] * 4)
    first = MPC.plan(Road(), images([20]), images([25]), seed=0).actions
    # As it was before its third action; what it lacks at the end is its last action.
    before = first[[2, 3, 3, 3]]
    second = MPC.plan(Road(), images([20]), images([25]), seed=3, warm_start=before).actions
    np.testing.assert_array_equal(actions[3], second[0])


def test_more_steps_than_a_plan_has_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^replan_every: must be from 1 to the horizon 4, got 5"):
        PlanningAgent(Road(), MPC, NoSubgoals(), Replanning(every=5))


def test_true_subgoals_of_hard_episodes_are_the_gaps() -> None:
    trials = MazeTrials(0, 0, 3, "hard")
    subgoals = trials.true_subgoals(2)
    assert subgoals.shape == (3, 2, 64, 64, 3)
    from hvf_core import maze_locate

    for trial in range(3):
        located = maze_locate(subgoals[trial])
        np.testing.assert_allclose(located[:, 0], [-0.15, 0.15], atol=1e-3)
        np.testing.assert_allclose(located[:, 1], trials.states[trial, 2:], atol=1e-3)


@given(st.integers(0, 200), st.integers(0, 200))
@settings(max_examples=50, deadline=None)
def test_interval_is_wilsons(successes: int, failures: int) -> None:
    n, z = successes + failures, 1.959963984540054
    if n == 0:
        with pytest.raises(ValueError, match="successes"):
            wilson_interval(0, 0)
        return
    p = successes / n
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    # Without a success the reference's lower end is 0 but for rounding.
    expected = (centre - half, centre + half)
    np.testing.assert_allclose(wilson_interval(successes, n), expected, rtol=1e-9, atol=1e-12)


def test_seeds_of_trials_and_steps_differ() -> None:
    seeds = {derived_seed(seed, step) for seed in range(30) for step in range(30)}
    assert len(seeds) == 900


class Coin:
    """A task whose trial succeeds if its number is even, and that can be stopped."""

    name = "coin"

    def __init__(self, stop_after: int = 10**9, side: str = "even") -> None:
        self.config = {"side": side, "pair": (1, 2)}
        self.ran: list[int] = []
        self.stop_after = stop_after

    def run(self, first: int, count: int) -> Outcome:
        if len(self.ran) + count > self.stop_after:
            raise KeyboardInterrupt
        self.ran += range(first, first + count)
        trials = [Trial(i % 2 == 0, i, (), ()) for i in range(first, first + count)]
        return Outcome(trials, [], 0.1 * count, 0.2, count)


def test_a_stopped_evaluation_goes_on_where_it_was(tmp_path: Path) -> None:
    out = tmp_path / "folder" / "coin.json"
    with pytest.raises(KeyboardInterrupt):
        evaluate(Coin(stop_after=7), 10, out, chunk=3)
    resumed = Coin()
    report = evaluate(resumed, 10, out, chunk=3)
    assert resumed.ran == [6, 7, 8, 9]
    at_once = evaluate(Coin(), 10, tmp_path / "other.json", chunk=3)
    assert [dataclasses.astuple(t)[:4] for t in report.trials] == [
        dataclasses.astuple(t)[:4] for t in at_once.trials
    ]
    assert load(out).trials == report.trials
    assert (report.successes, report.success_rate) == (5, 0.5)
    content = json.loads(out.read_text())
    assert content["confidence_interval_95"] == list(wilson_interval(5, 10))
    assert {"commit", "python", "packages"} <= content["provenance"].keys()


def test_more_trials_are_added_to_a_finished_evaluation(tmp_path: Path) -> None:
    out = tmp_path / "coin.json"
    evaluate(Coin(), 4, out)
    more = Coin()
    assert evaluate(more, 9, out).successes == 5
    assert more.ran == [4, 5, 6, 7, 8]
    fewer = evaluate(Coin(stop_after=0), 3, out)
    assert len(fewer.trials) == 3


def test_another_evaluation_is_not_overwritten_unasked(tmp_path: Path) -> None:
    out = tmp_path / "coin.json"
    evaluate(Coin(), 2, out)
    before = out.read_bytes()
    with pytest.raises(FileExistsError, match="another evaluation"):
        evaluate(Coin(side="odd"), 2, out)
    assert out.read_bytes() == before
    assert evaluate(Coin(side="odd"), 2, out, overwrite=True).config["side"] == "odd"


@pytest.mark.parametrize("content", [b"", b"{}", b"[1, 2]", b'{"format": 1}', b"\xff\x00"])
def test_a_file_that_is_no_report_is_left_alone(tmp_path: Path, content: bytes) -> None:
    out = tmp_path / "notes.json"
    out.write_bytes(content)
    with pytest.raises(FileExistsError, match="holds something else"):
        evaluate(Coin(), 2, out)
    with pytest.raises(ValueError, match=r"notes\.json: is not an evaluation"):
        load(out)
    assert out.read_bytes() == content


def test_the_size_of_chunks_does_not_change_the_result() -> None:
    task = cheap(agent="none", difficulty="easy", steps=6).task()
    reports = [evaluate(task, 5, chunk=chunk) for chunk in (2, 5)]
    outcomes = [[(t.index, t.success, t.steps) for t in report.trials] for report in reports]
    assert outcomes[0] == outcomes[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"agent": "clever"}, "^agent: "),
        ({"difficulty": "extreme"}, "^difficulty: "),
        ({"model": "dream"}, "^model: "),
        ({"generator": "gan"}, "^generator: "),
        ({"subgoals": -1}, "^subgoals: "),
        ({"seed": -1}, "^seed: "),
        ({"horizon": 0}, "^horizon: "),
        ({"elites": 201}, "^elites: "),
        ({"blur": -1.0}, "^blur: "),
        ({"over_horizon": "first"}, "^over_horizon: "),
        ({"initial": "leftward"}, "^initial: "),
        ({"steps": 0}, "^steps: "),
        ({"threshold": float("nan")}, "^threshold: "),
        ({"reached": "never"}, "^reached: "),
    ],
)
def test_settings_out_of_range_are_named(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MazeEvaluation.of(**settings)


def test_presets_are_where_settings_begin() -> None:
    paper = MazeEvaluation.of("paper", agent="none", horizon=10)
    assert paper.planning == dataclasses.replace(MazePlanning.preset("paper"), horizon=10)
    assert (paper.planning.blur, paper.planning.initial, paper.agent) == (0.0, "normal", "none")
    with pytest.raises(ValueError, match=r"^preset: "):
        MazeEvaluation.of("newspaper")
    with pytest.raises(TypeError):
        MazeEvaluation.of(horizont=3)


def test_pictures_show_the_episode(tmp_path: Path) -> None:
    task = cheap(difficulty="easy", steps=3, over_horizon="sum").task()
    _, (episode,) = record(task, 5, 1)
    steps = episode.trial.steps
    assert len(episode.observations) == len(episode.states) == steps + 1
    np.testing.assert_array_equal(
        episode.observations[0], task.trials(5, 1).observe(np.array([0]))[0]
    )
    save_strip(episode, tmp_path / "strip.png", "a title")
    strip = iio.imread(tmp_path / "strip.png")
    assert strip.shape[1] > 5 * 64
    assert strip[..., :3].std() > 10
    save_film(episode, tmp_path / "film.gif")
    assert len(iio.imread(tmp_path / "film.gif", index=None)) >= steps + 1
    with pytest.raises(ValueError, match=r"^path: must end in \.gif or \.mp4"):
        save_film(episode, tmp_path / "film.avi")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["film.gif", "strip.png"]


def test_an_episode_knows_what_it_aimed_at() -> None:
    _, (episode,) = record(cheap(steps=4, steps_per_subgoal=1, threshold=0.0).task(), 0, 1)
    assert episode.trial.switches == (1, 2)
    assert [episode.aim(step) for step in range(4)] == [0, 1, 2, 2]
    np.testing.assert_array_equal(episode.aim_image(1), episode.subgoals[1])
    np.testing.assert_array_equal(episode.aim_image(3), episode.goal)


WORDS = [f"--{name.replace('_', '-')}={value}" for name, value in CHEAP.items()]
WORDS += ["--model", "simulator", "--steps", "4"]


def test_eval_command_writes_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "report.json"
    words = ["eval", "maze", "--agent", "none", "--trials", "2", "--out", str(out), *WORDS]
    assert main([*words, "--preset", "paper"]) == 0
    report = load(out)
    assert len(report.trials) == 2
    assert report.config["planning"]["initial"] == "normal"
    assert report.config["planning"]["samples"] == 30
    assert "no subgoals" in capsys.readouterr().out
    assert main(words) == 2
    assert "another evaluation" in capsys.readouterr().err


def test_plan_and_demo_commands_draw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = ["plan", "maze", "--episode", "1", "--out", str(tmp_path / "plan"), *WORDS]
    assert main([*plan, "--subgoals", "1"]) == 0
    assert {p.name for p in (tmp_path / "plan").iterdir()} == {"episode-1.png", "episode-1.gif"}
    demo = ["demo", "maze", "--episodes", "2", "--pictures", "1", "--out", str(tmp_path / "demo")]
    assert main([*demo, *WORDS]) == 0
    names = {p.name for p in (tmp_path / "demo").iterdir()}
    assert names == {"episode-0.png", "episode-0.gif", "hvf.json", "none.json"}
    assert "HVF-2" in capsys.readouterr().out


def test_a_watched_episode_takes_its_share_of_the_bar() -> None:
    evaluation = MazeEvaluation.of(agent="none", model="simulator", samples=10, elites=3, steps=7)
    with Progress(disable=True) as progress:
        bar = progress.add_task("", total=21)
        outcomes = [watch(evaluation.task(), index, progress, bar)[0] for index in (0, 1)]
        assert progress.tasks[bar].completed == 14
    assert all(1 <= outcome.trials[0].steps <= 7 for outcome in outcomes)
    said = how_it_went("two", outcomes[0])
    assert f"after {outcomes[0].trials[0].steps} steps" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["eval", "maze", "--model", "simulator", "--trials", "0"], "trials: must be at least 1"),
        (["plan", "maze", "--dynamics", "no/such.safetensors"], "no/such.safetensors"),
    ],
)
def test_a_wrong_value_is_one_line_and_status_2(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.strip().splitlines()) == 1


def test_a_command_without_learned_models_does_not_import_torch() -> None:
    program = (
        "import sys; from hvf.cli import main; import hvf.cli.evaluate, hvf.cli.plan, hvf.cli.demo;"
        "sys.exit('torch' in sys.modules)"
    )
    assert processes.run(processes.python(program)).returncode == 0
