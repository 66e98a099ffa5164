"""Where everything is in recorded episodes: what the layers models are trained on.

A part that the arm hides is looked for before and after: if it is seen again where it was, it was
there all the time, and if it is never seen again it is gone. In between nothing is known, and
nothing is learned.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track as progress
from scipy.ndimage import maximum_filter1d

from hvf.data.formats import EpisodeReader, open_episodes
from hvf.models.layers.perception import LayerPerception
from hvf.training.tracks.kept import kept_beside, refuse_unequal

# The middle of a part can be trusted when so much is seen of it, set against the most that is seen
# of it within so many frames: parts far away are small.
_TRUSTED, _NEIGHBOURS = 0.65, 21
# Less than this is nothing.
_SEEN = 0.25
# Pixels between two places that are the same, and frames after which a part is gone.
_SAME_PLACE, _GONE_AFTER = 1.5, 10
# A part that moved by more pixels was pushed; a slider that moved by more of its way slid.
_PUSHED, _SLID = 1.0, 0.05

# Steps in a short stretch.
_SHORT = 2
# Shares of the stretches in which a part is pushed, and something slides.
PUSHED_SHARE, SLID_SHARE = 1 / 3, 1 / 6

Floats = NDArray[np.float32]


class LayerTracks:
    """States of every frame, and actions, in memory.

    What is seen is kept beside the file (:mod:`hvf.training.tracks.kept`).

    Args:
        path: file of episodes.
        perception: what finds the states.
        episodes: how many episodes to read.
        first: the first of them.
        console: where progress goes.
        camera: whose frames to see; the first one's by default.

    Raises:
        FileNotFoundError, ValueError: as :func:`~hvf.data.formats.open_episodes`; episodes
            that are not there or of different lengths, or frames or actions of another kind than
            the perception's.

    Attributes:
        states: as seen, float32 ``[E, T+1, X]``.
        truth: with what is known in hindsight, float32 ``[E, T+1, X]``.
        known: uint8 ``[E, T+1, R]``: 0 where nothing is known of a part, 1 where it is known to be
            gone, 2 where its place is known.
        actions: float32 ``[E, T, A]``.
        hand, parts: where in a state the hand's code is, and the parts are.
    """

    def __init__(
        self,
        path: str | Path,
        perception: LayerPerception,
        episodes: int,
        first: int = 0,
        console: Console | None = None,
        camera: str | None = None,
    ) -> None:
        with open_episodes(path, camera=camera) as file:
            refuse_unequal(file)
            if not 1 <= episodes <= len(file) - first:
                raise ValueError(
                    f"episodes must be from 1 to {len(file) - first} for {path}, got {episodes}"
                )
            config = perception.config
            size, dimensions = (config.image_size, config.image_size), config.arm.action_dim
            if file.frame_shape[:2] != size:
                raise ValueError(
                    f"{path}: frames are {file.frame_shape[:2]}, the model takes {size}"
                )
            if file.action_dim != dimensions:
                raise ValueError(
                    f"{path}: actions have {file.action_dim} dimensions, the model's {dimensions}"
                )
            found = kept_beside(
                Path(path),
                file.metadata,
                perception,
                first,
                episodes,
                lambda: _see(file, perception, episodes, first, console),
                camera=camera,
                console=console,
            )
        self.states: Floats = found["states"]
        self.actions: Floats = found["actions"]
        mass: Floats = found["mass"]
        self.mass = mass
        self.truth = self.states.copy()
        parts = self.truth[..., -3 * config.roaming :].reshape(*mass.shape, 3)
        parts[...], self.known = track(parts, mass)
        self.hand = slice(0, config.arm.action_dim)
        self.parts = slice(-3 * config.roaming, None)

    def contacts(self) -> tuple[Floats, Floats]:
        """Moments at which a part was pushed.

        Returns:
            The hand's codes ``[N, A]`` and the parts' places ``[N, 2]``, both in the middle of the
            step.
        """
        parts = self.truth[..., self.parts].reshape(*self.known.shape, 3)
        certain = (self.known[:, 1:] == 2) & (self.known[:, :-1] == 2)
        moved = np.linalg.norm(parts[:, 1:, :, :2] - parts[:, :-1, :, :2], axis=3)
        episode, time, part = np.nonzero(certain & (moved > _PUSHED))
        hands = self.truth[..., self.hand]
        places = parts[episode, time, part, :2] + parts[episode, time + 1, part, :2]
        return 0.5 * (hands[episode, time] + hands[episode, time + 1]), 0.5 * places

    def pushed(self, length: int) -> NDArray[np.int64]:
        """Windows of ``length`` steps in which a part moves or falls: ``[N, 2]``.

        Each is an episode and a first frame.
        """
        parts = self.truth[..., self.parts].reshape(*self.known.shape, 3)
        certain = (self.known[:, length:] > 0) & (self.known[:, :-length] == 2)
        gone = self.known[:, length:] == 1
        moved = np.linalg.norm(parts[:, length:, :, :2] - parts[:, :-length, :, :2], axis=3)
        return np.argwhere((certain & (gone | (moved > _PUSHED))).any(axis=2))

    def slid(self, length: int) -> NDArray[np.int64]:
        """Windows of ``length`` steps in which a slider moves, as :meth:`pushed`."""
        sliders = self.truth[..., self.hand.stop : self.parts.start]
        return np.argwhere((np.abs(sliders[:, length:] - sliders[:, :-length]) > _SLID).any(axis=2))


def _see(
    file: EpisodeReader,
    perception: LayerPerception,
    episodes: int,
    first: int,
    console: Console | None,
) -> dict[str, Floats]:
    steps, config = file.metadata.steps, perception.config
    states = np.empty((episodes, steps + 1, config.state_size), np.float32)
    actions = np.empty((episodes, steps, file.action_dim), np.float32)
    mass = np.empty((episodes, steps + 1, config.roaming), np.float32)
    frames = np.empty((steps + 1, *file.frame_shape), np.uint8)
    device = perception.sprites.device
    for i in progress(range(episodes), "states of all frames", console=console, transient=True):
        file.read_into(first + i, frames, actions[i])
        with torch.inference_mode():
            found, seen = perception.look(torch.from_numpy(frames).to(device))
        states[i], mass[i] = found.cpu().numpy(), seen.cpu().numpy()
    return {"states": states, "actions": actions, "mass": mass}


def track(parts: Floats, mass: Floats) -> tuple[Floats, NDArray[np.uint8]]:
    """Fill in what hindsight tells.

    Args:
        parts: row, column and presence as seen, ``[E, T, R, 3]``.
        mass: how much is seen, ``[E, T, R]``.

    Returns:
        The same as known in hindsight, and what is known of it: see :class:`LayerTracks`.
    """
    most = maximum_filter1d(mass, _NEIGHBOURS, axis=1, mode="nearest")
    seen = mass > np.maximum(_TRUSTED * most, _SEEN)
    steps = parts.shape[1]
    before, after = parts[..., :2].copy(), parts[..., :2].copy()
    since, until = np.zeros(seen.shape, np.int64), np.zeros(seen.shape, np.int64)
    # Frames since it was last seen and until it will be; a whole episode, if never.
    last = np.full((len(parts), parts.shape[2]), steps)
    following = last.copy()
    for t in range(steps):
        last = np.where(seen[:, t], 0, last + 1)
        since[:, t] = last
        if t:
            before[:, t] = np.where(seen[:, t, :, None], parts[:, t, :, :2], before[:, t - 1])
        back = steps - 1 - t
        following = np.where(seen[:, back], 0, following + 1)
        until[:, back] = following
        if t:
            after[:, back] = np.where(
                seen[:, back, :, None], parts[:, back, :, :2], after[:, back + 1]
            )
    was, will = since < steps, until < steps
    same = was & will & (np.linalg.norm(after - before, axis=3) < _SAME_PLACE)
    ahead = steps - np.arange(steps)[None, :, None]
    gone = ~will & (since + ahead > _GONE_AFTER)
    filled = parts.copy()
    filled[..., :2] = np.where(seen[..., None], parts[..., :2], 0.5 * (before + after))
    filled[..., :2] = np.where((gone & was)[..., None], before, filled[..., :2])
    filled[..., 2] = np.where(gone, 0.0, np.where(seen | same, 1.0, parts[..., 2]))
    known = np.where(seen | same, 2, np.where(gone, 1, 0)).astype(np.uint8)
    return filled, known


class LayerSampler:
    """Stretches of states with their actions.

    In a third of them, unless it is said otherwise, a part is pushed, and in a sixth something
    slides. Short stretches teach the
    most in the least time, and long ones what errors do to what comes after: the first part of all
    steps sees many stretches of two steps, the rest sees fewer that are long.

    Batches are what :meth:`hvf.models.layers.dynamics.LayerDynamics.loss` takes.

    Args:
        tracks: recorded episodes.
        windows: long stretches per step.
        length: steps in a long stretch, ``H``.
        short_steps: training steps that see short stretches.
        seed: of the draws.
        pushed: share of the stretches in which a part is pushed.
    """

    def __init__(
        self,
        tracks: LayerTracks,
        windows: int,
        length: int,
        short_steps: int,
        seed: int,
        pushed: float = PUSHED_SHARE,
    ) -> None:
        steps = tracks.actions.shape[1]
        if not 1 <= length <= steps:
            raise ValueError(f"length must be from 1 to {steps}, got {length}")
        if windows < 1:
            raise ValueError(f"windows must be at least 1, got {windows}")
        self._tracks = tracks
        self._windows, self._length, self._seed = windows, length, seed
        self._short_steps = short_steps
        self._shares = (pushed, SLID_SHARE)
        self._events = {
            steps: (tracks.pushed(steps), tracks.slid(steps))
            for steps in {min(_SHORT, length), length}
        }

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``, a function of (seed, step)."""
        length, windows = self._length, self._windows
        if step < self._short_steps:
            length = min(_SHORT, length)
            windows = windows * self._length // length
        tracks, rng = self._tracks, np.random.default_rng([self._seed, step])
        episodes, steps = tracks.actions.shape[:2]
        episode = rng.integers(episodes, size=(windows, 1))
        start = rng.integers(steps - length + 1, size=(windows, 1))
        first = 0
        for events, share in zip(self._events[length], self._shares, strict=True):
            if len(events):
                count = int(windows * share + 1e-6)
                places = slice(first, first + count)
                chosen = events[rng.integers(len(events), size=count)]
                episode[places], start[places] = chosen[:, :1], chosen[:, 1:]
                first = places.stop
        times = start + np.arange(length + 1)
        states = tracks.truth[episode, times]
        known = tracks.known[episode, times]
        # A rollout begins with what is seen. Where that is wrong, its end says nothing.
        seen = tracks.states[episode[:, 0], start[:, 0]]
        wrong = np.abs(seen - states[:, 0])[:, tracks.parts].reshape(*known[:, 0].shape, 3)
        known[:, 0] *= (wrong < _SAME_PLACE * np.array([1, 1, 0.3])).all(axis=2)
        states[:, 0] = seen
        return {
            "states": torch.from_numpy(states),
            "known": torch.from_numpy(known.astype(np.float32)),
            "actions": torch.from_numpy(tracks.actions[episode, times[:, :-1]]),
        }
