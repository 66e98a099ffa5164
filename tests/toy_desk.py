"""A toy of the desk, drawn in images of 32 pixels, of which everything is known.

On a wooden backdrop a door slides sideways and a drawer comes out of the right edge; before it lie
three coloured squares. An arm, a white bar from the lower edge up to a disc, moves with the
action, up to borders. A square that the disc comes upon is pushed, and is gone when it leaves on
the left; door and drawer go along with the disc where it touches them.

States are those of :mod:`hvf.models.layers.perception`: hand (row, column and height, in full
actions), door and drawer (0 to 1), and row, column (pixels) and presence of each square.

Letters in shapes: `N` frames, `E` episodes, `T` steps, `S` = 32 image size, `X` = 14.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hvf.data.episodes import Episodes, Metadata
from hvf.data.formats.hdf5 import write_episodes
from hvf.models.layers.arm import ArmConfig
from hvf.models.layers.backdrop import BackdropConfig
from hvf.models.layers.cell import CellConfig
from hvf.models.layers.colours import ColoursConfig
from hvf.models.layers.dynamics import LayerDynamicsConfig
from hvf.models.layers.gallery import GalleryConfig
from hvf.models.layers.perception import LayerPerception, LayerPerceptionConfig

SIZE = 32
EPISODES, STEPS = 40, 30
"""Of a recording that tests of one module share."""
SQUARE = 5.0
"""Pixels on each side of a square."""
WOOD, DOOR, DRAWER = (146, 136, 126), (50, 80, 190), (150, 50, 170)
SQUARES = ((200, 40, 40), (40, 150, 50), (230, 150, 30))
WAYS = DOOR_WAY, DRAWER_WAY = (10, 7)
"""Pixels that door and drawer slide. A place of the backdrop's table is a pixel from the next."""
PLACES = (DOOR_WAY + 1) * (DRAWER_WAY + 1)
"""Places of the table."""
PIXELS_PER_ACTION = np.array([4.0, 5.0])
MIDDLE = np.array([13.0, 15.0])
"""Row and column of a hand of code zero."""
_REACH = np.array([[-1.75, -2.4, -1.0], [3.0, 2.6, 1.0]])
_WHITE = (235, 235, 230)
_TOUCH = 4.0

TINY = LayerDynamicsConfig(
    perception=LayerPerceptionConfig(
        colours=ColoursConfig(image_size=SIZE, parts=5),
        backdrop=BackdropConfig(bins=(DOOR_WAY + 1, DRAWER_WAY + 1)),
        arm=ArmConfig(channels=(4, 8), hidden=16, features=12, patch_rank=6),
        gallery=GalleryConfig(places=(5, 6, 2), patches=400),
        sprite=9,
    ),
    cell=CellConfig(hand_hidden=8, part_hidden=12, memory=2, reach=6.0),
)
"""A model that fits the toy, in a second."""

Floats = NDArray[np.float64]
Edge: TypeAlias = "Floats | float"


def draw(states: Floats, arm: bool = True, squares: bool = True) -> NDArray[np.uint8]:
    """Frames uint8 `[N, S, S, 3]` of `states [N, X]`; every pixel's colour is the mean over it."""
    states = np.asarray(states, np.float64)
    image = np.empty((len(states), SIZE, SIZE, 3))
    image[:] = np.array(WOOD) * np.linspace(0.95, 1.05, SIZE)[:, None, None]
    left = 4.5 + DOOR_WAY * states[:, 3]
    _paint(image, _box(-0.5, 5.5, left, left + 11), DOOR)
    _paint(image, _box(12.5, 19.5, 27.5 - DRAWER_WAY * states[:, 4], SIZE), DRAWER)
    for i, colour in enumerate(SQUARES if squares else ()):
        row, column, presence = states[:, 5 + 3 * i : 8 + 3 * i].T
        half = SQUARE / 2
        box = _box(row - half, row + half, column - half, column + half)
        _paint(image, box * (presence > 0.5)[:, None, None], colour)
    if arm:
        _paint(image, arm_opacity(states[:, :3]), _WHITE)
    return np.rint(image).astype(np.uint8)


def frames_of(states: Floats, arm: bool = True, squares: bool = True) -> Tensor:
    """The same as a tensor."""
    return torch.from_numpy(draw(states, arm, squares))


@functools.cache
def seen() -> tuple[LayerPerception, Floats]:
    """A perception of the toy with everything but the arm, and the states that it is taken from.

    Made once for all tests: leave it as it is.
    """
    states = jumbled(0, 2 * PLACES, 12)
    frames = frames_of(states.reshape(-1, 14)).reshape(*states.shape[:2], SIZE, SIZE, 3)
    torch.manual_seed(0)
    perception = LayerPerception(TINY.perception)
    with torch.inference_mode():
        perception.fit(frames[:, :2], frames)
    return perception.eval().requires_grad_(False), states


def squares_in(perception: LayerPerception) -> list[int]:
    """For each part that roams, in the perception's order, the number of the square that it is."""
    chroma = perception.colours.colours[perception.colours.roams]
    true = torch.tensor(SQUARES) / 255 @ perception.colours.chroma_of
    return [int(i) for i in torch.cdist(chroma, true).argmin(dim=1)]


def as_seen(states: Floats, perception: LayerPerception) -> Tensor:
    """States float32 `[N, X]` with the squares in the perception's order."""
    squares = states[:, 5:].reshape(-1, 3, 3)[:, squares_in(perception)].reshape(len(states), -1)
    return torch.from_numpy(np.concatenate([states[:, :5], squares], axis=1)).float()


def place(hand: Floats) -> Floats:
    """Row and column of the disc at `hand [N, 3]`, pixels: `[N, 2]`."""
    return MIDDLE + PIXELS_PER_ACTION * hand[:, :2]


def arm_opacity(hand: Floats) -> Floats:
    """Where the arm at `hand [N, 3]` is, 0 or 1: `[N, S, S]`; there is more of it, the higher."""
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(float)
    end = place(hand)[:, None, None]
    from_end = np.stack([rows, columns], axis=2) - end
    bar = np.where(from_end[..., 0] > 0, np.abs(from_end[..., 1]), np.inf)
    disc = np.linalg.norm(from_end, axis=3)
    height = hand[:, 2, None, None]
    return np.where((bar < 0.75 + 0.2 * height) | (disc < 2.5 + 0.5 * height), 1.0, 0.0)


def make(seed: int, episodes: int, steps: int) -> tuple[NDArray[np.float32], Floats]:
    """Actions float32 `[E, T, 3]` at random, and the states `[E, T + 1, X]` that they lead to."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-1, 1, (episodes, steps, 3)).astype(np.float32)
    states = np.empty((episodes, steps + 1, 14))
    for i in range(episodes):
        state = scattered(rng, 1)[0]
        state[:3] = rng.uniform(_REACH[0], _REACH[1])
        # What the hand is upon makes room for it.
        states[i, 0] = state = after(state, np.zeros(3))
        for t in range(steps):
            states[i, t + 1] = state = after(state, actions[i, t].astype(np.float64))
    return actions, states


def jumbled(seed: int, episodes: int, frames: int) -> Floats:
    """States `[E, T, X]` in which only drawer and door stay, everything else jumps.

    Every place of the backdrop's table is that of equally many episodes, if `episodes` is a
    multiple of their number. In a fifth of the frames the arm may hide a part of drawer or door.
    """
    rng = np.random.default_rng(seed)
    states = scattered(rng, episodes * frames)
    anywhere = rng.uniform(_REACH[0], _REACH[1], (len(states), 3))
    aside = rng.uniform([-0.9, -2.4, -1.0], [3.0, 0.5, 1.0], (len(states), 3))
    states[:, :3] = np.where(rng.random((len(states), 1)) < 0.2, anywhere, aside)
    states = states.reshape(episodes, frames, -1)
    number = np.arange(episodes) % PLACES
    states[..., 3] = (number // (DRAWER_WAY + 1) / DOOR_WAY)[:, None]
    states[..., 4] = (number % (DRAWER_WAY + 1) / DRAWER_WAY)[:, None]
    return states


def scattered(rng: np.random.Generator, count: int) -> Floats:
    """States `[N, X]` in which nothing touches: hands anywhere above the squares, whole pixels."""
    low, high = np.array([-1.5, -2.4, -1.0]), np.array([-0.75, 1.6, 1.0])
    hand = rng.uniform(low, high, (count, 3))
    sliders = np.stack([rng.integers(0, way + 1, count) / way for way in WAYS], axis=1)
    rows = rng.integers(15, 27, (count, 3))
    # Side by side, in any order.
    columns = np.array([3, 9, 15]) + np.sort(rng.integers(0, 4, (count, 3)), axis=1)
    columns = rng.permuted(columns, axis=1)
    squares = np.stack([rows, columns, np.ones_like(rows)], axis=2).reshape(count, -1)
    return np.concatenate([hand, sliders, squares], axis=1)


def after(state: Floats, action: Floats) -> Floats:
    """The state `[X]` after `action [3]`."""
    new: Floats = state.copy()
    new[:3] = np.clip(state[:3] + action, *_REACH)
    before, now = place(state[None, :3])[0], place(new[None, :3])[0]
    moved = now - before
    if now[0] < 7 and new[2] < -0.5 and 6 <= now[1] <= 23:
        new[3] = np.clip(round(DOOR_WAY * state[3] + moved[1]), 0, DOOR_WAY) / DOOR_WAY
    if 12 < now[0] < 20 and now[1] > 23:
        new[4] = np.clip(round(DRAWER_WAY * state[4] - moved[1]), 0, DRAWER_WAY) / DRAWER_WAY
    squares = new[5:].reshape(3, 3)
    for square in squares:
        apart = square[:2] - now
        distance = float(np.linalg.norm(apart))
        if square[2] and distance < _TOUCH:
            row, column = np.rint(now + _TOUCH * apart / max(distance, 1e-6))
            square[:] = np.clip(row, 11, 27), min(column, 18), column > 2
    return new


def write(path: Path, seed: int, episodes: int, steps: int) -> tuple[NDArray[np.float32], Floats]:
    """Write a file of episodes of the desk; actions and states as of :func:`make`."""
    actions, states = make(seed, episodes, steps)
    frames = draw(states.reshape(-1, 14)).reshape(episodes, steps + 1, SIZE, SIZE, 3)
    metadata = Metadata("desk", {}, seed, steps, episodes, {})
    write_episodes(path, metadata, Episodes(frames, actions, states))
    return actions, states


def recorded(folder: Path) -> Path:
    """A file of :data:`EPISODES` of :data:`STEPS` steps, seed 0, in a folder."""
    path = folder / "desk.h5"
    write(path, 0, EPISODES, STEPS)
    return path


def _box(top: Edge, bottom: Edge, left: Edge, right: Edge) -> Floats:
    """How much of each pixel a box covers, `[N, S, S]`; pixel `i` reaches from i - .5 to i + .5."""
    box: Floats = _cover(top, bottom)[:, :, None] * _cover(left, right)[:, None]
    return box


def _cover(low: Edge, high: Edge) -> Floats:
    line = np.arange(SIZE)
    low, high = np.reshape(low, (-1, 1)), np.reshape(high, (-1, 1))
    covered: Floats = np.minimum(line + 0.5, high) - np.maximum(line - 0.5, low)
    return np.clip(covered, 0.0, 1.0)


def _paint(image: Floats, opacity: Floats, colour: tuple[int, int, int]) -> None:
    image += opacity[..., None] * (np.array(colour) - image)
