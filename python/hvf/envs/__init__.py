"""Gymnasium environments: ``hvf/Maze-v0`` and ``hvf/FrankaDesk-v0``.

Importing :mod:`hvf` registers them, so that ``gymnasium.make("hvf/Maze-v0")``,
``gymnasium.make_vec("hvf/Maze-v0", num_envs=8)`` (a native vector environment) and
``gymnasium.make("hvf/FrankaDesk-v0", task="door")`` find them.
"""

import gymnasium

MAZE_ID = "hvf/Maze-v0"
MAZE_MAX_STEPS = 50
"""Steps of an episode, ``T`` of the paper's maze (section 6.1)."""

DESK_ID = "hvf/FrankaDesk-v0"


def register_envs() -> None:
    """Make this package's environments known to Gymnasium. Does nothing the second time."""
    if MAZE_ID in gymnasium.registry:
        return
    gymnasium.register(
        id=MAZE_ID,
        entry_point="hvf.envs.maze.env:MazeEnv",
        vector_entry_point="hvf.envs.maze.vector:MazeVectorEnv",
        max_episode_steps=MAZE_MAX_STEPS,
    )
    # Episodes end after the task's own number of steps, so the environment counts them itself.
    gymnasium.register(id=DESK_ID, entry_point="hvf.envs.desk.env:DeskEnv")


__all__ = ["DESK_ID", "MAZE_ID", "MAZE_MAX_STEPS", "register_envs"]
