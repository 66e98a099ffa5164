"""The desk's true dynamics as a world model: MuJoCo rolled out, drawn, and compared in pixels.

It tells errors of a learned model apart from those of the cost and of the search. It is slow,
about 100 rollouts of 15 steps a second and core; nearly all of it is physics, so candidates are
spread over the pool's processes, which draw and compare what they have rolled out.

Letters in shapes: ``B`` problems, ``D`` candidates per problem, ``H`` steps, ``N`` frames, ``S``
width and height of an image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import hvf_core
from hvf.envs.desk.pool import DeskPool, Worker
from hvf.envs.desk.simulator import (
    ACTION_SIZE,
    STATE_SIZE,
    DeskSimulator,
    DivergenceError,
    Floats,
)
from hvf.settings import OverHorizon, check_blur, check_word
from hvf.worlds.world import checked_images

Images = NDArray[np.uint8]


@dataclass(frozen=True)
class DeskFrames:
    """Frames of the desk: what is seen, and the state behind it.

    Attributes:
        images: uint8 ``[N, S, S, 3]``.
        states: float64 ``[N, 63]``, NaN where only the image is known. Rollouts start from frames
            with a state; goals need none.
    """

    images: Images
    states: Floats

    def __post_init__(self) -> None:
        if self.states.shape != (len(self.images), STATE_SIZE):
            raise ValueError(
                f"states: expected shape [{len(self.images)}, {STATE_SIZE}], "
                f"got {list(self.states.shape)}"
            )

    def __len__(self) -> int:
        """Return the number of frames, ``N``."""
        return len(self.images)

    def __getitem__(self, index: NDArray[np.int64]) -> DeskFrames:
        """Return the frames at ``index``."""
        return DeskFrames(self.images[index], self.states[index])

    @staticmethod
    def join(parts: list[DeskFrames]) -> DeskFrames:
        """Return the frames of all parts, in order."""
        return DeskFrames(
            np.concatenate([part.images for part in parts]),
            np.concatenate([part.states for part in parts]),
        )


class MujocoWorld:
    """The true desk as a world model (`hvf.protocols.WorldModel`).

    Args:
        pool: where rollouts run; its image size is that of the frames.
        blur: standard deviation in pixels of the Gaussian blur through which frames and goals are
            compared; 0 for none.
        over_horizon: whether the last frame of a rollout counts, the sum over all, or the minimum.

    Raises:
        ValueError: a setting out of range.
    """

    def __init__(
        self, pool: DeskPool, blur: float = 0.0, over_horizon: OverHorizon = "last"
    ) -> None:
        check_blur("blur", blur)
        check_word("over_horizon", over_horizon, ("last", "sum", "min"))
        self.pool = pool
        self.blur = blur
        self.over_horizon: OverHorizon = over_horizon

    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 ``[3]``."""
        return np.full(ACTION_SIZE, -1.0, np.float32)

    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 ``[3]``."""
        return np.full(ACTION_SIZE, 1.0, np.float32)

    def observe(self, images: Images) -> DeskFrames:
        """Frames of uint8 ``images[N, S, S, 3]``, good as goals: their states are not known.

        Raises:
            ValueError: images of another size than the pool's.
            TypeError: images that are not uint8.
        """
        size = self.pool.image_size
        images = checked_images(images, size, size)
        return DeskFrames(images, np.full((len(images), STATE_SIZE), np.nan))

    def rollout_costs(
        self, starts: DeskFrames, goals: DeskFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs float32 ``[B, D]`` of ``actions[B, D, H, 3]``.

        Squared L2 distance to the goal per pixel, of three colours from 0 to 1 each. A candidate
        whose simulation diverges costs NaN.

        Raises:
            ValueError: starts whose states are not known.
        """
        if not np.isfinite(starts.states).all():
            raise ValueError(
                "starts: their states are not known; the simulator cannot start from an image"
            )
        count, candidates = actions.shape[:2]
        owner = np.repeat(np.arange(count), candidates)
        flat = actions.reshape(count * candidates, *actions.shape[2:])
        parts = [
            self.pool.submit(
                _costs,
                starts.states[owner[part]],
                goals.images[owner[part]],
                flat[part],
                self.blur,
                self.over_horizon,
            )
            for part in self.pool.parts(len(flat))
        ]
        costs = np.concatenate([part.result() for part in parts])
        return costs.astype(np.float32).reshape(count, candidates)


def _costs(
    worker: Worker,
    states: Floats,
    goals: Images,
    actions: NDArray[np.float32],
    blur: float,
    over_horizon: OverHorizon,
) -> NDArray[np.float64]:
    """Costs ``[N]`` of ``actions[N, H, 3]`` from ``states[N, 63]`` to ``goals[N, S, S, 3]``."""
    result = np.full(len(states), np.nan)
    finished, paths = _rollout(worker.simulator, states, actions)
    if not len(finished):
        return result
    seen = paths[:, -1:] if over_horizon == "last" else paths
    shape = seen.shape[:2]
    images = worker.renderer.render(seen.reshape(-1, STATE_SIZE))
    aims = np.repeat(goals[finished], shape[1], axis=0)
    costs = hvf_core.image_cost(images, aims, blur=blur).reshape(shape)
    result[finished] = costs.min(axis=1) if over_horizon == "min" else costs.sum(axis=1)
    return result


def _rollout(
    simulator: DeskSimulator, states: Floats, actions: NDArray[np.float32]
) -> tuple[NDArray[np.int64], Floats]:
    """Numbers of the rollouts that did not diverge, and their states ``[N, H, 63]``."""
    finished = np.arange(len(states))
    while len(finished):
        try:
            return finished, simulator.rollout(states[finished], actions[finished])
        except DivergenceError as error:
            finished = np.delete(finished, error.which)
    return finished, np.empty((0, actions.shape[1], STATE_SIZE))
