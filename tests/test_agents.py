"""Acting towards subgoals and a goal, and the agents that do it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import hvf_core
from hvf.agents.frames import images_of, joined
from hvf.agents.method import Means
from hvf.agents.planning import PlanningAgent
from hvf.agents.random import RandomAgent
from hvf.agents.subgoals import Searched, ground_truth, no_subgoals
from hvf.domains.maze import MazeTrials
from hvf.evaluation import Task, Trial, act
from hvf.evaluation.acting import derived_seed
from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.recording import Recorder
from hvf.protocols import Decision, Measuring, Remembering, SubgoalSourceAnew
from hvf.registry import METHODS
from hvf.settings import Acting, Planning, Replanning
from line import GOAL, Line, Road, images, places

CHEAP = {
    "samples": 30,
    "elites": 6,
    "iterations": 2,
    "subgoal_samples": 12,
    "subgoal_elites": 4,
    "subgoal_iterations": 2,
    "dynamics": "simulator",
}


def task_of(**settings: Any) -> Task:
    """A task of the maze with the true simulator and small budgets."""
    return Task.open(Evaluation.of("maze", **{**CHEAP, **settings}))


class Walker:
    """Goes towards its target by `stride` places a step; keeps what it aimed at and did."""

    def __init__(self, subgoals: Sequence[int], stride: int = 1) -> None:
        self.chosen = images(subgoals)
        self.stride = stride
        self.aims: list[list[int]] = []
        self.done: list[tuple[list[int], list[float]]] = []
        self.begun = 0

    def begin(self, trials: Line) -> None:
        self.begun += 1
        self.targets = np.concatenate([self.chosen, trials.goals[:1]])

    def choose(self, trial: int, seed: int) -> NDArray[np.uint8]:
        return self.chosen

    def act(
        self, which: NDArray[Any], seen: NDArray[Any], aims: NDArray[Any], seeds: Sequence[int]
    ) -> Decision:
        here, there = places(seen), places(self.targets[aims])
        self.aims.append(there.tolist())
        move = np.clip(there - here, -self.stride, self.stride)
        return Decision(move[:, None].astype(np.float32), np.abs(there - here).astype(np.float32))

    def acted(self, which: NDArray[Any], actions: NDArray[np.float32]) -> None:
        self.done.append((which.tolist(), actions[:, 0].tolist()))

    def distances(
        self, which: NDArray[Any], seen: NDArray[Any], aims: NDArray[Any], blur: float
    ) -> NDArray[np.float32]:
        return hvf_core.image_cost(seen, self.targets[aims], blur=blur)

    def images(self, frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return frames


# ---- the rule of acting ------------------------------------------------------------------------


def test_goes_on_to_the_next_subgoal_when_it_sees_that_it_is_there() -> None:
    walker = Walker([3, 5])
    outcome = act(Line([0]), walker, Acting(threshold=1e-9), [0])
    assert outcome.trials == [Trial(True, 9, (3, 5), tuple(float(c) for c in "321214321"))]
    assert walker.aims == [[3]] * 3 + [[5]] * 2 + [[9]] * 4
    assert walker.begun == 1


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


class Fickle(Walker):
    """Chooses other subgoals on the way: those that it is given, one list a time."""

    def __init__(
        self, subgoals: Sequence[int], later: Sequence[Sequence[int]], stride: int
    ) -> None:
        super().__init__(subgoals, stride)
        self.later = [list(places) for places in later]
        self.asked: list[int] = []

    def choose_anew(self, trial: int, seed: int, count: int) -> NDArray[np.uint8]:
        self.asked.append(count)
        found = images(self.later.pop(0)[:count])
        self.targets = np.concatenate([found, self.targets[-1:]])
        return found


def test_subgoals_that_are_left_are_chosen_anew_when_one_is_left_behind() -> None:
    walker = Fickle([3, 5, 8], [[4, 6], [7]], stride=1)
    outcome = act(Line([0]), walker, Acting(threshold=1e-9, choose_anew=True), [0])
    assert walker.asked == [2, 1]
    assert outcome.trials[0].switches == (3, 4, 7)
    assert [aim for [aim] in walker.aims] == [3, 3, 3, 4, 7, 7, 7, 9, 9]
    # What a trial began with is what is kept of it.
    assert places(outcome.subgoals[0]).tolist() == [3, 5, 8]


def test_after_the_goal_was_tried_in_vain_all_subgoals_are_chosen_anew() -> None:
    # Two steps for each aim: two subgoals and the goal are six, and four are left then.
    walker = Fickle([3, 5], [[6], [7, 8]], stride=0)
    config = Acting(steps=10, steps_per_subgoal=2, threshold=0.0, choose_anew=True)
    outcome = act(Line([0]), walker, config, [0])
    assert walker.asked == [1, 1]
    assert [aim for [aim] in walker.aims] == [3, 3, 6, 6, 9, 9, 7, 7, 9, 9]
    assert outcome.trials[0].switches == (2, 4, 6, 8)


def test_subgoals_chosen_anew_and_reached_already_do_not_stop_the_trial() -> None:
    walker = Fickle([0, 0], [[0], [0], [0]], stride=0)
    config = Acting(steps=6, steps_per_subgoal=2, threshold=1e-9, choose_anew=True)
    outcome = act(Line([0]), walker, config, [0])
    assert outcome.trials[0].steps == 6


def test_agents_that_cannot_choose_anew_keep_to_their_subgoals() -> None:
    def finished(**settings: bool) -> list[Trial]:
        agent = PlanningAgent(Road(), MPC, Elsewhere(4))
        return act(Line([0, 2]), agent, Acting(steps=20, **settings), [0, 1]).trials

    assert finished(choose_anew=True) == finished()


class Listener:
    """Keeps what a watcher is told."""

    def __init__(self) -> None:
        self.told: list[tuple[Any, ...]] = []

    def chosen(self, trial: int) -> None:
        self.told.append(("chosen", trial))

    def seen(self, step: int, which: NDArray[Any], observations: NDArray[np.uint8]) -> None:
        self.told.append(("seen", step, which.tolist(), places(observations).tolist()))

    def stepped(self, step: int, which: NDArray[Any]) -> None:
        self.told.append(("stepped", step, which.tolist()))


def test_success_ends_a_trial_and_the_others_go_on() -> None:
    listener, walker = Listener(), Walker([])
    outcome = act(Line([7, 0, 9]), walker, Acting(steps=5), [0, 1, 2], [listener])
    assert [trial.success for trial in outcome.trials] == [True, False, True]
    # Success is asked after a step: even the last one, which begins at its goal, takes one.
    assert [trial.steps for trial in outcome.trials] == [2, 5, 1]
    steps = [(told[1], told[2]) for told in listener.told if told[0] == "stepped"]
    assert steps == [(1, [0, 1, 2]), (2, [0, 1]), (3, [1]), (4, [1]), (5, [1])]
    assert listener.told[:5] == [
        ("chosen", 0),
        ("chosen", 1),
        ("chosen", 2),
        ("seen", 0, [0, 1, 2], [7, 0, 9]),
        ("stepped", 1, [0, 1, 2]),
    ]
    assert outcome.decisions == 8
    assert len(outcome.search_seconds) == 3
    # The agent is told of what was done, as it was done.
    assert walker.done[0] == ([0, 1, 2], [1.0, 1.0, 0.0])
    assert walker.done[-1] == ([1], [1.0])


def test_a_trial_that_breaks_down_fails_and_the_others_go_on() -> None:
    outcome = act(Line([0, 7, 3], {0: 2}), Walker([]), Acting(steps=6), [0, 1, 2])
    assert outcome.trials[0] == Trial(False, 2, (), (9.0, 8.0), "trial 0 broke down")
    assert [trial.error for trial in outcome.trials[1:]] == [None, None]
    assert [trial.steps for trial in outcome.trials[1:]] == [2, 6]
    alone = act(Line([0], {0: 0}), Walker([]), Acting(steps=6), [0])
    assert alone.trials == [Trial(False, 0, (), (), "trial 0 broke down")]


def test_every_trial_needs_a_seed() -> None:
    with pytest.raises(ValueError, match="seeds: must be one for each of 2 trials, got 1"):
        act(Line([0, 1]), Walker([]), Acting(), [0])


def test_seeds_of_trials_and_steps_differ() -> None:
    seeds = {derived_seed(seed, step) for seed in range(30) for step in range(30)}
    assert len(seeds) == 900


def test_what_is_recorded_is_what_was_seen() -> None:
    trials = Line([5, 0], {1: 1})
    recorder = Recorder(trials)
    outcome = act(trials, Walker([6]), Acting(threshold=1e-9), [0, 0], [recorder])
    recorder.finish(outcome)
    first, second = (recorder.episode(7 + b, b, outcome, images([6])) for b in range(2))
    assert (first.index, second.index) == (7, 8)
    assert places(first.observations).tolist() == [5, 6, 7, 8, 9]
    assert [first.aim(step) for step in range(4)] == [0, 1, 1, 1]
    assert places(np.stack([first.aim_image(step) for step in range(2)])).tolist() == [6, 9]
    # It broke down after one step.
    assert places(second.observations).tolist() == [0, 1]
    assert second.trial.error == "trial 1 broke down"
    # The line does not tell where things are in its images.
    assert (first.path, first.target) == (None, None)


# ---- methods -----------------------------------------------------------------------------------


def test_a_trial_does_not_depend_on_the_others() -> None:
    task = task_of(task="medium", subgoals=1, steps=4)
    together = task.run(0, 3)
    for index in range(3):
        alone = task.run(index, 1)
        assert alone.trials[0] == together.trials[index]
        np.testing.assert_array_equal(
            task.agent.images(alone.subgoals[0]), task.agent.images(together.subgoals[index])
        )


@pytest.mark.parametrize("method", ["hvf", "none", "ground-truth", "random"])
def test_every_method_repeats_itself_from_its_seed(method: str) -> None:
    outcomes = [task_of(method=method, steps=3).run(0, 2) for _ in range(2)]
    assert outcomes[0].trials == outcomes[1].trials
    counts = {len(subgoals) for subgoals in outcomes[0].subgoals}
    assert counts == {2 if method in ("hvf", "ground-truth") else 0}


def test_planning_beats_chance_and_warm_starts_work() -> None:
    def successes(**settings: Any) -> int:
        outcome = task_of(task="easy", steps=15, over_horizon="sum", **settings).run(0, 8)
        return sum(trial.success for trial in outcome.trials)

    chance = successes(method="random")
    assert successes(method="none") > chance
    assert successes(method="none", warm_start=True) > chance


def test_random_actions_are_in_the_box_and_of_their_own_seeds() -> None:
    low, high = np.array([-1.0, 2.0], np.float32), np.array([0.0, 3.0], np.float32)
    agent = RandomAgent(low, high)
    agent.begin(Line([0, 0]))
    assert len(agent.choose(0, 0)) == 0
    which, seen = np.arange(2), images([0, 0])
    both = agent.act(which, seen, which, [5, 6])
    assert both.actions.dtype == np.float32
    assert ((both.actions >= low) & (both.actions <= high)).all()
    alone = agent.act(which[1:], seen[1:], which[1:], [6])
    np.testing.assert_array_equal(alone.actions[0], both.actions[1])
    assert both.costs is None
    assert np.isinf(agent.distances(which, seen, which, 0.0)).all()


def test_true_subgoals_of_hard_episodes_are_the_gaps() -> None:
    trials = MazeTrials(0, 0, 3, "hard")
    subgoals = trials.true_subgoals(2)
    assert subgoals.shape == (3, 2, 64, 64, 3)
    source = ground_truth(2)
    for trial in range(3):
        np.testing.assert_array_equal(source(trials, trial, 0), subgoals[trial])
        located = hvf_core.maze_locate(subgoals[trial])
        np.testing.assert_allclose(located[:, 0], [-0.15, 0.15], atol=1e-3)
        np.testing.assert_allclose(located[:, 1], trials.states[trial, 2:], atol=1e-3)


def test_ground_truth_where_nobody_knows_it_is_one_clear_error() -> None:
    agent = PlanningAgent(Road(), MPC, ground_truth(1))
    agent.begin(Line([0]))
    with pytest.raises(ValueError, match=r"'ground-truth' needs true_subgoals, which Line lacks"):
        agent.choose(0, 0)


def test_methods_say_what_they_lack() -> None:
    box = np.array([-1.0], np.float32), np.array([1.0], np.float32)
    with pytest.raises(ValueError, match=r"^world: "):
        METHODS["none"].agent(Means(Planning(), 0, *box))
    with pytest.raises(ValueError, match=r"^generator: "):
        METHODS["hvf"].agent(Means(Planning(), 2, *box, world=Road()))
    # Without subgoals nothing has to draw them.
    METHODS["hvf"].agent(Means(Planning(), 0, *box, world=Road()))
    with pytest.raises(ValueError, match="true states, which Line does not tell"):
        PlanningAgent(Road(), MPC, no_subgoals, privileged=True).begin(Line([0]))


# ---- agents that plan --------------------------------------------------------------------------

MPC = hvf_core.VisualMPC(horizon=4, samples=20, elites=5, iterations=1)
ONE = np.array([0])


class Elsewhere:
    """One subgoal at a place, for every trial."""

    def __init__(self, place: int) -> None:
        self.place = place

    def __call__(self, trials: Line, trial: int, seed: int) -> NDArray[np.uint8]:
        return images([self.place])


def decide(agent: PlanningAgent, aims: Sequence[int]) -> list[NDArray[np.float32]]:
    """Actions of a trial at 20, towards its subgoal or the goal at each step; seeds are steps."""
    trials = Line([0])
    trials.goals = images([15])
    agent.begin(trials)
    agent.choose(0, 0)
    return [
        agent.act(ONE, images([20]), np.array([aim]), [step]).actions[0]
        for step, aim in enumerate(aims)
    ]


def test_a_plan_is_acted_for_as_many_steps_as_asked() -> None:
    world = Road()
    actions = decide(PlanningAgent(world, MPC, Elsewhere(25), Replanning(every=3)), [0] * 5)
    assert world.asked == 2
    plans = [MPC.plan(Road(), images([20]), images([25]), seed=seed).actions for seed in (0, 3)]
    np.testing.assert_array_equal(actions, [*plans[0][:3], *plans[1][:2]])


def test_a_new_target_gets_a_new_plan_at_once() -> None:
    world = Road()
    actions = decide(PlanningAgent(world, MPC, Elsewhere(25), Replanning(every=4)), [0, 0, 1])
    assert world.asked == 2
    expected = MPC.plan(Road(), images([20]), images([15]), seed=2).actions[0]
    np.testing.assert_array_equal(actions[2], expected)


def test_a_plan_may_be_kept_to_its_end_while_none_is_better() -> None:
    # Every later plan costs more by the toll.
    world = Road(toll=100.0)
    replanning = Replanning(every=1, keep_better=True)
    actions = decide(PlanningAgent(world, MPC, Elsewhere(25), replanning), [0] * 6)
    assert world.asked == 6
    first = MPC.plan(Road(), images([20]), images([25]), seed=0).actions
    np.testing.assert_array_equal(actions[:4], first)
    second = MPC.plan(Road(), images([20]), images([25]), seed=4).actions
    np.testing.assert_array_equal(actions[4:], second[:2])


def test_a_warm_start_after_some_steps_begins_with_the_rest_of_the_plan() -> None:
    agent = PlanningAgent(Road(), MPC, Elsewhere(25), Replanning(every=3, warm_start=True))
    actions = decide(agent, [0] * 4)
    first = MPC.plan(Road(), images([20]), images([25]), seed=0).actions
    # As it was before its third action; what it lacks at the end is its last action.
    before = first[[2, 3, 3, 3]]
    second = MPC.plan(Road(), images([20]), images([25]), seed=3, warm_start=before).actions
    np.testing.assert_array_equal(actions[3], second[0])


def test_fresh_trials_get_fresh_plans() -> None:
    world = Road()
    agent = PlanningAgent(world, MPC, Elsewhere(25), Replanning(every=4))
    first, again = decide(agent, [0]), decide(agent, [0])
    assert world.asked == 2
    np.testing.assert_array_equal(first, again)


def test_more_steps_than_a_plan_has_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^replan_every: must be from 1 to the horizon 4, got 5"):
        PlanningAgent(Road(), MPC, no_subgoals, Replanning(every=5))


# ---- worlds with context -----------------------------------------------------------------------


class Retrospect(Road):
    """A world that wants three frames and the two actions between them; keeps what it is given."""

    context = 3

    def __init__(self) -> None:
        super().__init__()
        self.given: list[tuple[list[list[int]], list[list[float]]]] = []

    def observe_history(
        self, images: NDArray[np.uint8], actions: NDArray[np.float32]
    ) -> NDArray[np.uint8]:
        assert images.shape[1:] == (3, 1, 1, 3)
        assert actions.shape == (len(images), 2, 1)
        assert (images.dtype, actions.dtype) == (np.uint8, np.float32)
        self.given.append((places(images).tolist(), actions[..., 0].tolist()))
        return images[:, -1]


class Scripted(Line):
    """Moves by 1 in every step, whatever the action."""

    def step(self, which: NDArray[np.int64], actions: NDArray[np.float32]) -> dict[int, str]:
        return super().step(which, np.ones((len(which), 1), np.float32))


def test_a_world_with_context_gets_what_was_seen_and_done_padded_at_the_start() -> None:
    world = Retrospect()
    assert isinstance(world, Remembering)
    agent = PlanningAgent(world, MPC, no_subgoals)
    outcome = act(Scripted([2, 7]), agent, Acting(steps=4), [0, 1], [])
    assert [trial.steps for trial in outcome.trials] == [4, 2]
    seen = [given[0] for given in world.given]
    assert seen == [
        [[2, 2, 2], [7, 7, 7]],
        [[2, 2, 3], [7, 7, 8]],
        [[2, 3, 4]],  # the other one has reached the goal
        [[3, 4, 5]],
    ]
    # Between the frames is what the agent decided, and nothing before the start.
    done = [given[1] for given in world.given]
    assert done[0] == [[0.0, 0.0], [0.0, 0.0]]
    assert [past[0] for past in done[1][0:2]] == [0.0, 0.0]
    first, second = done[1][0][1], done[2][0][1]
    assert first != 0
    assert done[2][0] == [first, second]
    assert done[3][0][0] == second
    assert max(map(abs, (first, second))) <= 2


def test_a_long_context_is_filled_step_by_step_and_then_slides() -> None:
    class Elephant(Retrospect):
        context = 5

        def observe_history(
            self, images: NDArray[np.uint8], actions: NDArray[np.float32]
        ) -> NDArray[np.uint8]:
            assert actions.shape == (len(images), 4, 1)
            self.given.append((places(images).tolist(), actions[..., 0].tolist()))
            return images[:, -1]

    world = Elephant()
    act(Scripted([0]), PlanningAgent(world, MPC, no_subgoals), Acting(steps=7), [0])
    seen = [given[0][0] for given in world.given]
    assert seen == [[max(now - back, 0) for back in (4, 3, 2, 1, 0)] for now in range(7)]


def test_a_world_with_context_remembers_in_steps_without_a_new_plan() -> None:
    world = Retrospect()
    agent = PlanningAgent(world, MPC, no_subgoals, Replanning(every=3))
    act(Scripted([0]), agent, Acting(steps=4), [0])
    assert [given[0] for given in world.given] == [[[0, 0, 0]], [[1, 2, 3]]]
    # Trials of another chunk have another past.
    act(Scripted([5]), agent, Acting(steps=1), [0])
    assert world.given[-1] == ([[5, 5, 5]], [[0.0, 0.0]])


class Coasting:
    """Goes on as fast as it was: frames are place and speed, float32 ``[N, 2]``."""

    action_low, action_high = Road.action_low, Road.action_high
    context = 2

    def observe(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        here = places(images).astype(np.float32)
        return np.stack([here, np.zeros_like(here)], axis=1)

    def observe_history(
        self, images: NDArray[np.uint8], actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        assert actions.shape == (len(images), 1, 1)
        seen = places(images).astype(np.float32)
        return np.stack([seen[:, 1], seen[:, 1] - seen[:, 0]], axis=1)

    def rollout_costs(
        self, starts: NDArray[Any], goals: NDArray[Any], actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        own = (starts[:, 0] + starts[:, 1] * actions.shape[2])[:, None]
        return np.asarray((own + actions[..., 0].sum(axis=2) - goals[:, :1]) ** 2)

    def images(self, frames: NDArray[np.float32]) -> NDArray[np.uint8]:
        return images(frames[:, 0].round())


class Ahead:
    """Draws subgoals ahead of its scene; keeps the scenes that it was asked for."""

    latent_dim = 1

    def __init__(self) -> None:
        self.scenes: list[Any] = []

    def decode(self, scene: Any, latents: NDArray[np.float32]) -> Any:
        if not self.scenes or not np.array_equal(self.scenes[-1], scene):
            self.scenes.append(scene)
        far = np.abs(latents).reshape(-1, 1).round()
        return np.concatenate([scene[:, :1] + far, np.zeros_like(far)], axis=1).astype(np.float32)


def small_search(count: int) -> hvf_core.HVF:
    return hvf_core.HVF(mpc=MPC, subgoals=count, samples=8, elites=3, iterations=2)


def test_a_search_in_a_world_with_context_starts_from_what_was_seen_and_done() -> None:
    world, generator, later = Coasting(), Ahead(), []

    class Keeping(Searched):
        def anew(self, *arguments: Any) -> Any:
            later.append(super().anew(*arguments))
            return later[-1]

    agent = PlanningAgent(world, MPC, Keeping(small_search, 2, world, generator))
    rule = Acting(steps=4, steps_per_subgoal=2, threshold=0.0, choose_anew=True)
    outcome = act(Scripted([0, 3]), agent, rule, [5, 6])
    # At the start nothing moved; on the way, everything goes 1 a step.
    scenes = np.concatenate(generator.scenes)
    np.testing.assert_array_equal(scenes, [[0, 0], [3, 0], [2, 1], [5, 1]])
    for trial, (place, seed) in enumerate([(0, 5), (3, 6)]):
        now, goal = np.array([[place, 0.0]], np.float32), world.observe(images([GOAL]))
        found = small_search(2).search(world, Ahead(), now, goal, derived_seed(seed, 0))
        np.testing.assert_array_equal(outcome.subgoals[trial], found.subgoals)
        # What it aims at after its first subgoal is what a search from there finds.
        now = np.array([[place + 2, 1.0]], np.float32)
        found = small_search(1).search(world, Ahead(), now, goal, derived_seed(seed, 0, 2))
        np.testing.assert_array_equal(later[trial], found.subgoals)


def test_a_search_asks_a_world_with_context_alone_what_its_frames_are() -> None:
    # It has no `observe`: what it makes of a history is all that it can start from.
    class Near:
        latent_dim = 1

        def decode(self, scene: Any, latents: NDArray[np.float32]) -> NDArray[np.uint8]:
            return images(places(scene)[0] + np.abs(latents).reshape(-1).round().astype(int))

    world = Retrospect()
    agent = PlanningAgent(world, MPC, Searched(small_search, 1, world, Near()))
    agent.begin(Scripted([2, 7]))
    agent.choose(0, 0)
    assert world.given == [([[2, 2, 2], [7, 7, 7]], [[0.0, 0.0], [0.0, 0.0]])]
    which, aims = np.arange(2), np.zeros(2, np.int64)
    agent.choose(1, 0)
    agent.act(which, images([2, 7]), aims, [0, 1])
    agent.acted(which, np.array([[0.5], [1.5]], np.float32))
    world.given.clear()
    agent.choose_anew(1, 0, 1)
    assert world.given == [([[7, 7, 7]], [[0.0, 1.5]])]


# ---- worlds whose frames are no images ---------------------------------------------------------


def latent_world() -> Any:
    """A world whose frames are torch tensors ``[N, 1]``: places, halved."""
    torch = pytest.importorskip("torch")

    class Latent:
        action_low, action_high = Road.action_low, Road.action_high

        def observe(self, images: NDArray[np.uint8]) -> Any:
            return torch.from_numpy(places(images)).float()[:, None] / 2

        def rollout_costs(self, starts: Any, goals: Any, actions: NDArray[np.float32]) -> Any:
            assert isinstance(starts, torch.Tensor)
            assert isinstance(goals, torch.Tensor)
            ends = starts + torch.from_numpy(actions)[..., 0].sum(dim=2) / 2
            return (ends - goals) ** 2

        def distances(self, frames: Any, goals: Any) -> Any:
            assert isinstance(frames, torch.Tensor)
            assert isinstance(goals, torch.Tensor)
            return (frames - goals)[:, 0].abs()

        def images(self, frames: Any) -> NDArray[np.uint8]:
            return images((2 * frames[:, 0]).round().int().numpy())

    return Latent()


class Halves:
    """Draws subgoals as frames of the latent world, around its scene."""

    latent_dim = 1

    def decode(self, scene: Any, latents: NDArray[np.float32]) -> Any:
        import torch

        return scene + torch.from_numpy(latents).reshape(-1, 1).abs().round()


def test_frames_that_are_tensors_go_all_the_way_through_acting() -> None:
    world = latent_world()
    assert isinstance(world, Measuring)
    search = hvf_core.HVF(mpc=MPC, subgoals=1, samples=8, elites=3, iterations=2)
    agent = PlanningAgent(world, MPC, Searched(lambda _: search, 1, world, Halves()))
    trials = Line([3, 5, 9])
    recorder = Recorder(trials)
    # The threshold is compared with the world's own distance: half a place.
    outcome = act(trials, agent, Acting(steps=6, threshold=0.6), [0, 1, 2], [recorder])
    recorder.finish(outcome)
    assert all(len(found) == 1 for found in outcome.subgoals)
    assert all(type(found).__module__.startswith("torch") for found in outcome.subgoals)
    drawn = [agent.images(found) for found in outcome.subgoals]
    assert {image.shape for image in drawn} == {(1, 1, 1, 3)}
    episode = recorder.episode(0, 0, outcome, drawn[0])
    assert places(episode.observations)[0] == 3
    # The same alone: frames of several trials are joined, and taken apart again.
    for index, start in enumerate((3, 5, 9)):
        agent = PlanningAgent(world, MPC, Searched(lambda _: search, 1, world, Halves()))
        alone = act(Line([start]), agent, Acting(steps=6, threshold=0.6), [index])
        assert alone.trials[0] == outcome.trials[index]


def test_a_search_on_the_way_starts_where_the_trial_is_now() -> None:
    world, starts = latent_world(), []

    class Noting(Halves):
        def decode(self, scene: Any, latents: NDArray[np.float32]) -> Any:
            starts.append(float(2 * scene[0, 0]))
            return super().decode(scene, latents)

    def search(count: int) -> hvf_core.HVF:
        return hvf_core.HVF(mpc=MPC, subgoals=count, samples=8, elites=3, iterations=1)

    source = Searched(search, 2, world, Noting())
    assert isinstance(source, SubgoalSourceAnew)
    trials = Line([3, 5])
    assert len(source(trials, 1, 0)) == 2
    trials.at[1] = 7
    assert [len(source.anew(trials, 1, 0, count)) for count in (1, 9)] == [1, 2]
    assert starts == [5.0, 7.0, 7.0]


def test_whether_a_subgoal_is_reached_is_asked_of_the_worlds_own_distance() -> None:
    world = latent_world()
    agent = PlanningAgent(world, MPC, Elsewhere(4))
    agent.begin(Line([0, 0]))
    for trial in range(2):
        agent.choose(trial, 0)
    which = np.arange(2)
    left = agent.distances(which, images([4, 10]), np.zeros(2, np.int64), blur=5.0)
    np.testing.assert_allclose(left, [0.0, 3.0])
    plain = PlanningAgent(Road(), MPC, Elsewhere(4))
    plain.begin(Line([0, 0]))
    for trial in range(2):
        plain.choose(trial, 0)
    left = plain.distances(which, images([4, 10]), np.zeros(2, np.int64), blur=0.0)
    np.testing.assert_allclose(left, [0.0, 3 * (6 / 255) ** 2], rtol=1e-6)


def test_frames_are_joined_or_refused_by_name() -> None:
    torch = pytest.importorskip("torch")
    np.testing.assert_array_equal(joined([np.zeros(2), np.ones(1)]), [0, 0, 1])
    assert torch.equal(joined([torch.zeros(1), torch.ones(2)]), torch.tensor([0.0, 1.0, 1.0]))

    class World:
        join: Callable[[Any], Any] = staticmethod(lambda parts: sum(parts, ()))

    assert joined([(1,), (2, 3)], World()) == (1, 2, 3)
    only = (1,)
    assert joined([only]) is only
    with pytest.raises(TypeError, match=r"tuple of several trials cannot be joined; .* join"):
        joined([(1,), (2,)])


def test_what_is_no_image_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match=r"a world that draws them with images\(frames\); got nd"):
        images_of(np.zeros((2, 3)))

    class Grey:
        def images(self, frames: Any) -> NDArray[np.uint8]:
            return np.zeros((len(frames), 4, 4), np.uint8)

    with pytest.raises(TypeError, match=r"images: must give uint8 \[N, H, W, 3\], got uint8"):
        images_of(np.zeros((2, 3)), Grey())

    class Keeping(list[Any]):
        images = np.zeros((2, 4, 4, 3), np.uint8)

    assert images_of(Keeping()) is Keeping.images  # type: ignore[arg-type]
