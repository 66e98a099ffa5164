from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

__version__: str

# --- maze ---------------------------------------------------------------------------------

MAZE_ACTION_LIMIT: float
MAZE_AGENT_HALF: float
MAZE_ARENA: float
MAZE_GAP_HALF: float
MAZE_GAP_LIMIT: float
MAZE_GAP_RANGE: float
MAZE_IMAGE_SIZE: int
MAZE_REACH: float
MAZE_SUCCESS_DISTANCE: float
MAZE_VIEW: float
MAZE_WALL_X: tuple[float, float]

def maze_step(states: ArrayLike, actions: ArrayLike) -> NDArray[np.float64]: ...
def maze_render(states: ArrayLike, size: int = 64) -> NDArray[np.uint8]: ...
def maze_locate(images: NDArray[np.uint8]) -> NDArray[np.float64]: ...
def maze_episodes(
    seed: int, first: int, count: int, difficulty: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...
def maze_subgoals(
    starts: ArrayLike, targets: ArrayLike, subgoals: int
) -> NDArray[np.float64]: ...
def maze_collect(
    seed: int, first: int, count: int, steps: int, size: int = 64
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float64]]: ...
def maze_success(states: ArrayLike, targets: ArrayLike) -> NDArray[np.bool_]: ...

# --- image costs --------------------------------------------------------------------------

def image_cost(
    a: NDArray[np.uint8] | NDArray[np.float32],
    b: NDArray[np.uint8] | NDArray[np.float32],
    mode: Literal["pairs", "all_pairs"] = "pairs",
    blur: float = 0.0,
) -> NDArray[np.float64]: ...
