"""Layouts of the maze: by name, of one's own and from files; environments, data, evaluation."""

from __future__ import annotations

import copy
import json
import pickle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hvf
import hvf_core
from hvf.cli import main
from hvf.data.formats import open_episodes
from hvf.domains.maze import MazeTrials
from hvf.envs.maze.layouts import fingerprint, layout_of, read_layout, state_names
from hvf_core import MazeLayout

NAMES = ["easy", "medium", "hard", "corridor-1", "corridor-4", "corridor-7", "u-maze", "spiral"]
TWO_ROOMS = """
start = [-0.27, -0.2, -0.27, 0.27]
goal = [0.2, 0.27, -0.27, 0.27]

[[walls]]
centre = [0.0, 0.0]
half = [0.005, 0.4]
angle = 20
gap = { half = 0.05, range = [-0.2, 0.2] }

[[walls]]
centre = [0.1, 0.2]
half = [0.03, 0.02]
"""


@pytest.fixture
def two_rooms(tmp_path: Path) -> Path:
    path = tmp_path / "two rooms.toml"
    path.write_text(TWO_ROOMS)
    return path


def supersampled(layout: MazeLayout, state: NDArray[np.float64], size: int, n: int) -> Any:
    """Which part of each pixel is wall, by points, without the gaps' and the agent's."""
    at = (np.arange(size * n) + 0.5) / (size * n) * 2 * hvf_core.MAZE_VIEW - hvf_core.MAZE_VIEW
    x, y = np.meshgrid(at, -at)
    wall = np.zeros_like(x, bool)
    gaps = {int(row[0]): (row[1], gap) for row, gap in zip(layout.gaps, state[2:], strict=True)}
    for index, (cx, cy, half_x, half_y, angle) in enumerate(layout.walls):
        turn = np.deg2rad(angle)
        own_x = np.cos(turn) * (x - cx) + np.sin(turn) * (y - cy)
        own_y = np.cos(turn) * (y - cy) - np.sin(turn) * (x - cx)
        inside = (abs(own_x) < half_x) & (abs(own_y) < half_y)
        if index in gaps:
            half, gap = gaps[index]
            inside &= abs(own_y - gap) > half
        wall |= inside
    across, up = layout.arena
    beyond = (abs(x) > across) | (abs(y) > up)
    border = (abs(x) < across + 0.01) & (abs(y) < up + 0.01)
    wall = np.where(beyond, border, wall)
    return wall.reshape(size, n, size, n).mean(axis=(1, 3))


@pytest.mark.parametrize("name", NAMES)
def test_episodes_of_a_layout_start_and_aim_in_its_regions(name: str) -> None:
    layout = layout_of(name)
    starts, targets = hvf_core.maze_episodes(3, 0, 40, layout=layout)
    assert starts.shape == (40, layout.columns)
    assert layout.columns == 2 + len(layout.gaps)
    for places, region in ((starts, layout.start), (targets, layout.goal)):
        low_x, high_x, low_y, high_y = region
        # The paper's targets are put where the agent can stand, at most its half-width away.
        slack = 0.03 if name in ("easy", "medium", "hard") else 0.0
        assert (low_x - slack <= places[:, 0]).all()
        assert (places[:, 0] <= high_x + slack).all()
        assert (low_y - slack <= places[:, 1]).all()
        assert (places[:, 1] <= high_y + slack).all()
    part, aims = hvf_core.maze_episodes(3, 10, 5, layout=layout)
    np.testing.assert_array_equal(part, starts[10:15])
    np.testing.assert_array_equal(aims, targets[10:15])
    # Nothing is inside a wall: standing still moves nothing.
    still = hvf_core.maze_step(starts, np.zeros((40, 2)), layout)
    np.testing.assert_allclose(still, starts, atol=1e-8)


@pytest.mark.parametrize("name", ["easy", "medium", "hard"])
def test_the_papers_difficulties_are_layouts_to_the_last_bit(name: Any) -> None:
    layout = MazeLayout.preset(name)
    starts, targets = hvf_core.maze_episodes(5, 0, 50, name)
    again, aims = hvf_core.maze_episodes(5, 0, 50, layout=layout)
    np.testing.assert_array_equal(starts, again)
    np.testing.assert_array_equal(targets, aims)
    actions = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    moved = hvf_core.maze_step(starts, actions)
    np.testing.assert_array_equal(moved, hvf_core.maze_step(starts, actions, layout))
    images = hvf_core.maze_render(moved, 64)
    np.testing.assert_array_equal(images, hvf_core.maze_render(moved, 64, layout))
    np.testing.assert_array_equal(
        hvf_core.maze_subgoals(starts, targets, 2),
        hvf_core.maze_subgoals(starts, targets, 2, layout),
    )
    # The same walls without the name are another simulator: the general one.
    other = MazeLayout("mine", layout.walls, layout.start, layout.goal, gaps=layout.gaps)
    np.testing.assert_allclose(hvf_core.maze_step(starts, actions, other), moved, atol=1e-7)
    difference = np.abs(images.astype(int) - hvf_core.maze_render(moved, 64, other))
    assert difference.max() <= 1


@settings(max_examples=20, deadline=None)
@given(
    walls=st.lists(
        st.tuples(
            st.floats(-0.25, 0.25),
            st.floats(-0.25, 0.25),
            st.floats(0.005, 0.05),
            st.floats(0.01, 0.2),
            st.floats(0, 180),
        ),
        max_size=4,
    ),
    gap=st.floats(-0.1, 0.1),
    size=st.integers(16, 40),
)
def test_turned_walls_cover_the_part_of_a_pixel_that_supersampling_finds(
    walls: list[tuple[float, ...]], gap: float, size: int
) -> None:
    gapped = (0.0, 0.0, 0.01, 0.2, 37.0)
    anywhere = (-0.27, 0.27, -0.27, 0.27)
    try:
        layout = MazeLayout(
            "any", [gapped, *walls], anywhere, anywhere, gaps=[(0, 0.04, -0.1, 0.1)]
        )
    except ValueError:
        return
    # The agent out of the way, in a corner that may be wall: compare where it is not.
    state = np.array([0.27, -0.27, gap])
    frame = hvf_core.maze_render(state[None], size, layout)[0].astype(float)
    wall, floor = np.array([130, 180, 235]), np.array([24, 36, 92])
    expected = floor + supersampled(layout, state, size, 24)[..., None] * (wall - floor)
    pixel = 2 * hvf_core.MAZE_VIEW / size
    agent = int(np.ceil(0.12 / pixel))
    differs = np.abs(frame - expected)
    differs[-agent:, -agent:] = 0
    assert differs.max() <= 0.12 * 156 + 1


def test_layouts_of_ones_own_are_copied_and_pickled_and_say_what_they_are(two_rooms: Path) -> None:
    layout = read_layout(two_rooms)
    assert layout.name == "two rooms"
    assert layout.arena == (0.3, 0.3)
    np.testing.assert_array_equal(
        layout.walls, [[0.0, 0.0, 0.005, 0.4, 20], [0.1, 0.2, 0.03, 0.02, 0]]
    )
    np.testing.assert_array_equal(layout.gaps, [[0, 0.05, -0.2, 0.2]])
    assert layout.start == (-0.27, -0.2, -0.27, 0.27)
    assert layout.columns == 3
    for name in ("spiral", "hard", "corridor-3"):
        one = MazeLayout.preset(name)
        for other in (copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
            assert other == one
            assert hash(other) == hash(one)
            assert other != layout
        assert fingerprint(one) == name
        assert layout_of(one) is one
    assert copy.deepcopy(layout) == layout == layout_of(str(two_rooms)) == layout_of(two_rooms)
    assert fingerprint(layout).startswith("two rooms (")
    moved = MazeLayout(
        "two rooms", layout.walls + 1e-3, layout.start, layout.goal, gaps=layout.gaps
    )
    assert fingerprint(moved) != fingerprint(layout)
    assert state_names(layout) == ["agent_x", "agent_y", "gap 0"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("start = [", "is not TOML"),
        ("colour = 1\n" + TWO_ROOMS, "no key 'colour'"),
        (TWO_ROOMS + "\nturn = 3", r"walls\[1\]: no key 'turn'"),
        (TWO_ROOMS.replace("range", "reach"), r"walls\[0\].gap: no key 'reach'"),
        (TWO_ROOMS.replace("goal", "name"), "needs 'goal'"),
        (TWO_ROOMS.replace("half = [0.005, 0.4]", "half = [0.005]"), r"walls\[0\].half: must be 2"),
        (TWO_ROOMS.replace("[0.03, 0.02]", "[0.03, nan]"), "walls: wall 1 must have finite"),
        (TWO_ROOMS.replace("[0.1, 0.2]", "[0.9, 0.2]"), "walls: wall 1 lies outside the arena"),
        (
            TWO_ROOMS.replace("[0.1, 0.2]", "[-0.23, 0.0]").replace("[0.03, 0.02]", "[0.1, 0.3]"),
            "start: there is no free space",
        ),
        (TWO_ROOMS.replace("gap =", "# gap ="), "goal: cannot be reached"),
        (TWO_ROOMS.replace("half = 0.05,", "half = 0.02,"), "wall 0 gap: half its width"),
        ("walls = 3\n" + TWO_ROOMS.split("[[")[0], "walls: must be tables"),
    ],
)
def test_files_that_are_no_layout_are_refused_by_name(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"^layout: .*bad.toml.*{says}"):
        read_layout(path)


def test_layouts_that_there_are_not_are_refused_by_name() -> None:
    for name in ("labyrinth", "corridor-0", "corridor-8", "corridor-", ""):
        with pytest.raises(ValueError, match=r"^layout: must be one of easy.*corridor-N.*\.toml"):
            layout_of(name)
    with pytest.raises(FileNotFoundError, match=r"^layout: there is no file"):
        layout_of("nowhere.toml")
    with pytest.raises(TypeError, match=r"^layout: expected a MazeLayout"):
        layout_of(3)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"^layout: expected MazeLayout"):
        hvf_core.maze_step([[0, 0]], [[0, 0]], "spiral")  # type: ignore[arg-type]
    anywhere = (-0.2, 0.2, -0.2, 0.2)
    for arguments, says in [
        (((), anywhere, (0.1, 0.2)), "goal: expected 4 numbers"),
        (([(0, 0, 1)], anywhere, anywhere), "walls: expected"),
        (((), anywhere, anywhere, (0.5, 0.3)), "arena: half-widths"),
        (((), anywhere, anywhere, (0.3, 0.3), [(0, 0.05, 0, 0)]), "gaps: must name walls"),
        (((), (np.nan, 0.1, 0.1, 0.2), anywhere), "start: must be"),
    ]:
        with pytest.raises(ValueError, match=rf"^{says}"):
            MazeLayout("bad", *arguments)  # type: ignore[arg-type]
    layout = MazeLayout.preset("corridor-2")
    with pytest.raises(ValueError, match=r"^states: expected a float array \[N, 4\]"):
        hvf_core.maze_step(np.zeros((1, 2)), np.zeros((1, 2)), layout)
    with pytest.raises(ValueError, match=r"^states\[0\]: gaps: gap 1"):
        hvf_core.maze_step([[0, 0, 0, 0.4]], np.zeros((1, 2)), layout)
    with pytest.raises(ValueError, match=r"^states\[0\]: position: must be within"):
        hvf_core.maze_render([[0.31, 0, 0, 0]], 64, layout)
    with pytest.raises(ValueError, match=r"^difficulty: give either"):
        hvf_core.maze_episodes(0, 0, 1, "hard", layout)
    with pytest.raises(ValueError, match=r"^difficulty: give either"):
        hvf_core.maze_episodes(0, 0, 1)


@pytest.mark.parametrize("layout", ["corridor-4", "u-maze", "spiral"])
def test_environments_are_those_of_the_layout(layout: str) -> None:
    env = gymnasium.make("hvf/Maze-v0", layout=layout)
    vector = gymnasium.make_vec("hvf/Maze-v0", num_envs=2, layout=layout)
    image, info = env.reset(seed=4)
    images, infos = vector.reset(seed=4)
    walls = layout_of(layout)
    starts, targets = hvf_core.maze_episodes(4, 0, 1, layout=walls)
    np.testing.assert_array_equal(info["state"], starts[0])
    np.testing.assert_array_equal(info["target"], targets[0])
    goal = hvf_core.maze_render([[*targets[0], *starts[0, 2:]]], 64, walls)[0]
    np.testing.assert_array_equal(info["goal"], goal)
    np.testing.assert_array_equal(image, hvf_core.maze_render(starts, 64, walls)[0])
    rng = np.random.default_rng(1)
    for _ in range(5):
        actions = rng.uniform(-3, 3, (2, 2)).astype(np.float32)
        image, _, ended, _, info = env.step(actions[0])
        images, _, _, _, infos = vector.step(actions)
        np.testing.assert_array_equal(image, images[0])
        np.testing.assert_array_equal(info["state"], infos["state"][0])
        assert not ended
    there = [*info["target"], *starts[0, 2:]]
    _, info = env.reset(options={"state": there, "target": info["target"]})
    assert info["success"]
    env.close()
    vector.close()


def test_environments_of_own_layouts_and_what_does_not_go_together(two_rooms: Path) -> None:
    layout = read_layout(two_rooms)
    for given_layout in (layout, two_rooms, str(two_rooms)):
        env = gymnasium.make("hvf/Maze-v0", layout=given_layout, render_mode="rgb_array")
        _, info = env.reset(seed=0)
        assert info["state"].shape == (3,)
        picture = env.render()
        assert isinstance(picture, np.ndarray)
        assert picture.shape == (256, 520, 3)
        env.close()
    with pytest.raises(ValueError, match=r"^difficulty: is of the paper's maze"):
        gymnasium.make("hvf/Maze-v0", layout="spiral", difficulty="easy")
    with pytest.raises(ValueError, match=r"^layout: must be one of"):
        gymnasium.make("hvf/Maze-v0", layout="snail")
    env = gymnasium.make("hvf/Maze-v0", layout="hard")
    state = env.reset(seed=3)[1]["state"]
    other = gymnasium.make("hvf/Maze-v0", difficulty="hard").reset(seed=3)[1]["state"]
    np.testing.assert_array_equal(state, other)


@pytest.mark.parametrize("layout", ["corridor-4", "u-maze", "spiral"])
def test_true_subgoals_lead_to_the_goal_with_the_true_simulator(layout: str) -> None:
    trials = MazeTrials(11, 0, 6, layout)
    walls = trials.layout
    count = 11
    subgoals = hvf_core.maze_subgoals(trials.states, trials.targets, count, walls)
    assert subgoals.shape == (6, count, walls.columns)
    ways = np.concatenate([subgoals[..., :2], trials.targets[:, None]], axis=1)
    states = trials.states.copy()
    # Straight to one place after another: each is so near that no wall is in between for long.
    for place in range(count + 1):
        for _ in range(6):
            actions = (ways[:, place] - states[:, :2]) / 0.0495
            states = hvf_core.maze_step(states, actions, walls)
    assert hvf_core.maze_success(states, trials.targets, walls).mean() >= 0.8


def test_states_and_worlds_of_a_layout_go_through_the_planner() -> None:
    layout = MazeLayout.preset("corridor-2")
    world = hvf_core.MazeWorld(layout=layout)
    starts, targets = hvf_core.maze_episodes(0, 0, 2, layout=layout)
    images = hvf_core.maze_render(starts, 64, layout)
    seen = world.observe(images)
    np.testing.assert_allclose(seen.states, starts, atol=1e-3)
    np.testing.assert_allclose(hvf_core.maze_locate(images, layout), starts, atol=1e-3)
    frames = hvf_core.MazeFrames(starts, layout=layout)
    np.testing.assert_array_equal(frames.states, starts)
    np.testing.assert_array_equal(frames[1].images, images[1:])
    goals = np.concatenate([targets, starts[:, 2:]], axis=1)
    actions = np.random.default_rng(0).uniform(-3, 3, (2, 4, 3, 2)).astype(np.float32)
    goal_frames = hvf_core.MazeFrames(goals, layout=layout)
    costs = world.rollout_costs(frames, goal_frames, actions)
    ends = world.rollout(frames[0], actions[0])
    state = np.repeat(starts[:1], 4, axis=0)
    for step in range(3):
        state = hvf_core.maze_step(state, actions[0, :, step], layout)
        np.testing.assert_array_equal(ends[:, step], state)
    drawn = hvf_core.maze_render(state, 64, layout)
    goal = np.repeat(goal_frames.images[:1], 4, axis=0)
    np.testing.assert_allclose(costs[0], hvf_core.image_cost(drawn, goal), rtol=1e-6)
    subgoals = hvf_core.MazeSubgoals(layout=layout)
    latents = np.random.default_rng(0).standard_normal((5, 2, 8)).astype(np.float32)
    for scene in (frames[0], images[:1]):
        found = subgoals.decode(scene, latents)
        assert found.states.shape == (10, 4)
        np.testing.assert_allclose(found.states[:, 2:], np.tile(starts[0, 2:], (10, 1)), atol=1e-3)
    search = hvf_core.HVF(
        mpc=hvf_core.VisualMPC(horizon=3, samples=20, elites=5, iterations=2),
        subgoals=1,
        samples=8,
        elites=3,
        iterations=2,
    )
    found = search.search(world, subgoals, images[0], goal_frames.images[0])
    assert np.isfinite(found.cost)


def test_collections_in_a_layout_hold_its_states_and_draw_gaps_anew(tmp_path: Path) -> None:
    out = tmp_path / "corridor.h5"
    words = f"collect maze --layout corridor-3 --episodes 6 --steps 4 --seed 5 --out {out}"
    assert main([*words.split(), "--part", "4"]) == 0
    layout = layout_of("corridor-3")
    frames, actions, states = hvf_core.maze_collect(5, 0, 6, 4, layout=layout)
    with open_episodes(out) as file:
        assert file.metadata.parameters["layout"] == "corridor-3"
        assert file.metadata.parameters["states"] == state_names(layout)
        for index in range(6):
            episode = file.read(index, 1)
            np.testing.assert_array_equal(episode.frames[0], frames[index])
            np.testing.assert_array_equal(episode.actions[0], actions[index])
            np.testing.assert_array_equal(episode.true_states[0], states[index])
    assert len(np.unique(states[:, 0, 2])) == 6
    assert (np.ptp(states[:, :, 2], axis=1) == 0).all()
    moved = hvf_core.maze_step(states[:, 0], actions[:, 0], layout)
    np.testing.assert_array_equal(moved, states[:, 1])
    words = f"collect maze --layout snail --episodes 1 --steps 1 --out {tmp_path / 'none.h5'}"
    assert main(words.split()) == 2


def test_evaluations_in_a_layout_say_so_in_settings_and_file_names(
    tmp_path: Path, two_rooms: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "found.json"
    words = "eval maze --layout corridor-2 --method random --trials 3 --steps 4 --out"
    assert main([*words.split(), str(out)]) == 0
    report = json.loads(out.read_text())
    assert report["task"] == "corridor-2"
    assert report["world"]["layout"] == "corridor-2"
    evaluation = hvf.Evaluation.of("maze", task="corridor-2", method="random")
    assert evaluation.slug.startswith("maze-corridor-2-")
    assert hvf.Evaluation.of("maze", task="corridor-3", method="random").slug != evaluation.slug
    mine = hvf.Evaluation.of("maze", task=str(two_rooms), method="random")
    assert mine.world_names["layout"] == fingerprint(read_layout(two_rooms))
    assert "two-rooms" in mine.slug
    capsys.readouterr()
    assert main(["results", "maze", str(tmp_path)]) == 0
    assert "corridor-2" in capsys.readouterr().out
    assert main(["eval", "maze", "--layout", "snail", "--method", "random", "--trials", "1"]) == 2
    assert "task: must be one of easy, medium, hard, corridor-N" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["eval", "maze", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "corridor-N" in said
    assert "u-maze" in said
    assert "spiral" in said


def test_the_true_simulator_plans_in_a_layout(tmp_path: Path) -> None:
    out = tmp_path / "u.json"
    words = "eval maze --layout u-maze --method ground-truth --subgoals 5 --dynamics simulator"
    words += " --trials 3 --samples 60 --elites 12 --iterations 3 --out"
    assert main([*words.split(), str(out)]) == 0
    assert json.loads(out.read_text())["successes"] >= 2


def test_a_model_is_probed_in_a_layout_without_data(tmp_path: Path) -> None:
    weights = Path(hvf.__file__).parent / "weights" / "maze_dynamics.safetensors"
    words = f"probe --layout spiral --model {weights} --out {tmp_path} --episodes 6 --windows 2"
    assert main([*words.split(), "--horizon", "3", "--steps-ahead", "1", "3"]) == 0
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["layout"] == "spiral"
    assert figures["windows"] == 12
    agent = figures["things"]["agent"]["3"]
    assert agent["true"] <= 0.3
    assert agent["predicted"] < 0.5 * agent["still"]
    assert main(f"probe --model {weights}".split()) == 2
    assert main(f"probe --layout snail --model {weights}".split()) == 2


def test_the_true_simulator_of_a_layout_is_loaded_by_its_name() -> None:
    world, generator = hvf.load("maze", dynamics="simulator", task="corridor-3")
    starts = hvf_core.maze_episodes(0, 0, 1, layout=layout_of("corridor-3"))[0]
    image = hvf_core.maze_render(starts, 64, layout_of("corridor-3"))
    assert world.observe(image).states.shape == (1, 5)  # type: ignore[attr-defined]
    assert generator is not None
    with pytest.raises(ValueError, match=r"^task: must be one of"):
        hvf.load("maze", dynamics="simulator", task="snail")
