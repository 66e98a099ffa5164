"""The planners with the maze's true simulator: native, wrapped, and as a Python world."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import hvf_core
from hvf import protocols
from hvf_core import (
    HVF,
    MazeFrames,
    MazeSubgoals,
    MazeWorld,
    VisualMPC,
    maze_episodes,
    maze_render,
)

SMALL = HVF(
    mpc=VisualMPC(horizon=3, samples=40, elites=8, iterations=3),
    samples=24,
    elites=5,
    iterations=2,
)


def episode(index: int = 0) -> tuple[Any, Any]:
    """States [1, 4] of start and goal."""
    starts, targets = maze_episodes(0, index, 1, "hard")
    goals = starts.copy()
    goals[:, :2] = targets
    return starts, goals


class InPython:
    """The same world through the protocol, to be planned with as any Python object."""

    def __init__(self) -> None:
        self.world = MazeWorld()
        self.action_low = self.world.action_low
        self.action_high = self.world.action_high

    def rollout_costs(self, starts: Any, goals: Any, actions: Any) -> Any:
        return self.world.rollout_costs(starts, goals, actions)

    def shared_rollout_costs(self, start: Any, goals: Any, actions: Any) -> Any:
        return self.world.shared_rollout_costs(start, goals, actions)


class Wrapped:
    """A wrapper as the learned worlds have: `native` and `observe`."""

    def __init__(self) -> None:
        self.native = MazeWorld()
        self.observed: list[int] = []

    def observe(self, images: Any) -> MazeFrames:
        self.observed.append(len(images))
        return self.native.observe(images)


def same(a: Any, b: Any) -> None:
    np.testing.assert_array_equal(a.latents, b.latents)
    np.testing.assert_array_equal(a.segment_costs, b.segment_costs)
    np.testing.assert_array_equal(a.plans.actions, b.plans.actions)
    np.testing.assert_array_equal(a.subgoals.states, b.subgoals.states)


def test_native_and_python_worlds_give_the_same_search() -> None:
    start, goal = (MazeFrames(states) for states in episode())
    assert isinstance(MazeWorld(), protocols.WorldModel)
    assert isinstance(MazeSubgoals(), protocols.SubgoalModel)
    found = SMALL.search(MazeWorld(), MazeSubgoals(), start, goal, seed=4)
    same(found, SMALL.search(InPython(), MazeSubgoals(), start, goal, seed=4))
    same(found, SMALL.search(Wrapped(), MazeSubgoals(), start, goal, seed=4))
    plain = HVF(
        mpc=SMALL.mpc, samples=24, elites=5, iterations=2, prune=False, share_rollouts=False
    )
    same(found, plain.search(MazeWorld(), MazeSubgoals(), start, goal, seed=4))


def test_images_are_observed_and_generators_may_draw_them() -> None:
    start, goal = (maze_render(states)[0] for states in episode(1))

    class Drawing(MazeSubgoalsInPython):
        def decode(self, scene: Any, latents: Any) -> Any:
            return super().decode(scene, latents).images

    world = Wrapped()
    found = SMALL.search(world, Drawing(), start, goal)
    assert isinstance(found.subgoals, MazeFrames)
    assert world.observed == [1, 1, 48, 48]
    assert found.subgoals.images.shape == (2, 64, 64, 3)
    plan = SMALL.mpc.plan(MazeWorld(), start, goal)
    assert plan.actions.shape == (3, 2)


class MazeSubgoalsInPython:
    """The oracle generator with a Python face."""

    latent_dim = 8

    def decode(self, scene: Any, latents: Any) -> Any:
        return MazeSubgoals().decode(scene, latents)


def test_what_is_no_frame_of_the_world_is_named() -> None:
    start = MazeFrames(episode()[0])
    with pytest.raises(TypeError, match="goal: expected MazeFrames or uint8 images"):
        SMALL.mpc.plan(MazeWorld(), start, np.zeros((1, 4)))
    with pytest.raises(ValueError, match="images"):
        SMALL.mpc.plan(MazeWorld(), start, np.zeros((32, 32, 3), np.uint8))

    class Strange(MazeSubgoalsInPython):
        def decode(self, scene: Any, latents: Any) -> Any:
            return "images"

    with pytest.raises(TypeError, match=r"generator\.decode: expected MazeFrames"):
        SMALL.search(MazeWorld(), Strange(), start, start)


def test_the_gil_is_free_in_a_native_plan() -> None:
    """Another thread goes on while the plan is made."""
    ticks = 0
    stop = threading.Event()

    def tick() -> None:
        nonlocal ticks
        while not stop.is_set():
            ticks += 1
            time.sleep(0)  # gives the GIL back each time: nobody has to force it

    start, goal = (MazeFrames(states) for states in episode())
    thread = threading.Thread(target=tick, daemon=True)
    interval = sys.getswitchinterval()
    # Nobody is forced to give the GIL up: the other thread runs only where the planner lets it.
    sys.setswitchinterval(1000.0)
    thread.start()
    try:
        progress = 0
        for _ in range(200):
            before = ticks
            VisualMPC().plan(MazeWorld(), start, goal)
            progress = ticks - before
            if progress > 0:
                break
    finally:
        stop.set()
        sys.setswitchinterval(interval)
        thread.join()
    assert progress > 0


INTERRUPTED = """
import sys
sys.path.insert(0, {path!r})
from test_planner_maze import *

start, goal = (MazeFrames(states) for states in episode())
try:
    print("planning", flush=True)
    # Weeks of native work: only the planner's own look at the signals can end it.
    VisualMPC(horizon=50, samples=1000, iterations=30000, min_variance=0.0).plan_batch(
        MazeWorld(), MazeFrames(np.repeat(start.states, 1000, axis=0)),
        MazeFrames(np.repeat(goal.states, 1000, axis=0)),
    )
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


def test_ctrl_c_stops_a_native_plan(interrupted_output: Callable[[str], str]) -> None:
    program = INTERRUPTED.format(path=os.path.dirname(__file__))
    assert interrupted_output(program).endswith("interrupted\n")


def test_what_a_learned_world_sees_does_not_depend_on_torchs_threads() -> None:
    torch = pytest.importorskip("torch")
    import hvf

    world, generator = hvf.load("maze")
    assert generator is not None
    images = hvf_core.maze_collect(3, 0, 40, 1)[0][:, 0]
    latents = np.random.default_rng(0).normal(size=(50, 2, generator.latent_dim))
    found = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            frames = world.observe(images)  # type: ignore[attr-defined]
            drawn = generator.decode(frames[np.array([0])], latents.astype(np.float32))
            found.append((frames.keypoints, frames.maps, drawn.images))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    for others in found[1:]:
        for ours, theirs in zip(found[0], others, strict=True):
            np.testing.assert_array_equal(ours, theirs)
