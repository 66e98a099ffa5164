"""Acting in a domain while a policy learns: the batches of RIG.

Trials of a domain run side by side, in rounds. At the beginning of a round each imagines a goal, a
latent from the VAE's prior, and acts towards it by the policy of now with noise; what is seen
becomes latents in the replay (:mod:`hvf.training.replay`). Of the trials nothing is read but what
they see, and whether they have ended.

Everything drawn is a function of (seed, round or step). A run that goes on acts the actions of its
unfinished round again, so it is the same as one that was never stopped, where the environment is.

Letters in shapes: ``N`` trials, ``L`` latent dimensions, ``A`` action dimensions.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.domains.domain import Place
from hvf.models.rig import RIG
from hvf.protocols import Indices, Trials
from hvf.training.replay import Relabelling, Replay

# What random numbers are for.
_BATCH, _GOALS, _NOISE = 1, 2, 3


@dataclasses.dataclass(frozen=True)
class Exploration:
    """How a policy is tried out; the defaults are those of RIG (rlkit).

    Attributes:
        trials: trials side by side.
        steps_before: steps that they take, together, before the first update.
        updates_per_step: gradient steps for each step that a trial takes.
        path_steps: steps of a path; none for those of an episode of the domain.
        noise: standard deviation of what is added at each step to the noise of the last, for
            actions from -1 to 1 (an Ornstein-Uhlenbeck process).
        noise_decay: part of the noise of the last step that is lost.
        uniform_before: act at random before the first update, uniformly, and not by a policy that
            has learned nothing.
        capacity: transitions that are kept.

    Raises:
        ValueError: a number out of range.
    """

    trials: int = 1
    steps_before: int = 4_000
    updates_per_step: int = 4
    path_steps: int | None = 100
    noise: float = 0.2
    noise_decay: float = 0.15
    uniform_before: bool = False
    capacity: int = 1_000_000

    def __post_init__(self) -> None:
        for name in ("trials", "steps_before", "updates_per_step", "capacity"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.path_steps is not None and self.path_steps < 1:
            raise ValueError(f"path_steps must be at least 1, got {self.path_steps}")
        if not (math.isfinite(self.noise) and self.noise >= 0):
            raise ValueError(f"noise must not be negative, got {self.noise}")
        if not 0 <= self.noise_decay <= 1:
            raise ValueError(f"noise_decay must be from 0 to 1, got {self.noise_decay}")


class Explorer:
    """Batches of transitions, and trials that act for them.

    A sampler that is :class:`hvf.training.loop.Interactive`.

    A trial that breaks down, or that reaches the goal of its own which it does not know of, takes
    no more steps in its round: an environment may end there.

    Args:
        model: the policy in training, and the VAE that it sees with.
        place: an open domain.
        tasks: its tasks, and the steps of their paths; rounds take turns.
        exploration: how to act.
        relabelling: whose goals the transitions of a batch are given.
        batch_size: transitions of a batch.
        seed: of everything drawn.
        episode_seed: of the episodes that trials begin in.
    """

    def __init__(
        self,
        model: RIG,
        place: Place,
        tasks: Sequence[tuple[str, int]],
        exploration: Exploration,
        relabelling: Relabelling,
        batch_size: int,
        seed: int,
        episode_seed: int,
    ) -> None:
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        self._model, self._place, self._tasks = model, place, list(tasks)
        self._exploration, self._relabelling = exploration, relabelling
        self._batch_size, self._seed, self._episode_seed = batch_size, seed, episode_seed
        config = model.config
        most = max(steps for _, steps in tasks)
        actions = len(config.action_low)
        self._replay = Replay(exploration.capacity, most, config.vae.latent_dim, actions)
        self._round, self._step, self._taken = 0, 0, 0
        self._trials: Trials | None = None
        self._alive: Indices = np.empty(0, np.int64)
        self._slots: NDArray[np.int64] = np.empty(0, np.int64)
        self._noise = np.zeros((exploration.trials, actions))

    @property
    def taken(self) -> int:
        """Steps that trials have taken, all together."""
        return self._taken

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """Act as far as is due at training step ``step``, and draw its batch.

        Raises:
            RuntimeError: all trials of a round break down in their first step.
        """
        due = self._exploration.steps_before + step // self._exploration.updates_per_step
        while self._taken < due:
            self._advance()
        rng = np.random.default_rng([self._seed, _BATCH, step])
        return self._replay.sample(self._batch_size, self._relabelling, rng)

    def memory(self) -> dict[str, torch.Tensor]:
        """What the next batches depend on beside the model."""
        counts = {"round": self._round, "step": self._step, "taken": self._taken}
        kept = {name: torch.tensor(count) for name, count in counts.items()}
        return {
            **{f"replay.{name}": tensor for name, tensor in self._replay.memory().items()},
            **kept,
            "slots": torch.from_numpy(self._slots.copy()),
            "alive": torch.from_numpy(self._alive.copy()),
        }

    def recall(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Go on from what :meth:`memory` gave: the unfinished round is acted again."""
        self._replay.recall(
            {
                name.removeprefix("replay."): tensor
                for name, tensor in tensors.items()
                if name.startswith("replay.")
            }
        )
        self._round, self._step, self._taken = (
            int(tensors[name]) for name in ("round", "step", "taken")
        )
        self._slots, self._alive = tensors["slots"].numpy(), tensors["alive"].numpy()
        if not len(self._alive):
            return
        self._trials = self._fresh(self._round - 1)
        self._noise = np.zeros_like(self._noise)
        _, actions, _, lengths = self._replay.path(self._slots)
        for step in range(self._step):
            which = np.flatnonzero(lengths > step)
            self._trials.step(which, self._boxed(actions[which, step]))
            self._drift(self._round - 1, step)

    def _advance(self) -> None:
        """One step of all trials of the round, or of a new one."""
        if self._trials is None or not len(self._alive):
            self._begin()
        assert self._trials is not None
        latents, _, goals, lengths = self._replay.path(self._slots[self._alive])
        now = latents[np.arange(len(latents)), lengths]
        self._drift(self._round - 1, self._step)
        actions = self._choose(now, goals)
        broken = self._trials.step(self._alive, self._boxed(actions))
        sound = np.array([int(trial) not in broken for trial in self._alive])
        if not self._step and not sound.any():
            raise RuntimeError(f"trials: none can take a step: {next(iter(broken.values()))}")
        self._alive, actions = self._alive[sound], actions[sound]
        self._step += 1
        self._taken += int(sound.sum())
        if len(self._alive):
            after = self._seen(self._trials, self._alive)
            self._replay.add(self._slots[self._alive], actions, after)
            self._alive = self._alive[~self._trials.success(self._alive)]
        if self._step >= self._steps(self._round - 1):
            self._alive = self._alive[:0]

    def _begin(self) -> None:
        self._trials = self._fresh(self._round)
        self._alive = np.arange(self._exploration.trials)
        self._step, self._noise = 0, np.zeros_like(self._noise)
        rng = np.random.default_rng([self._seed, _GOALS, self._round])
        size = (len(self._alive), self._model.config.vae.latent_dim)
        goals = rng.standard_normal(size, np.float32)
        self._slots = self._replay.begin(self._seen(self._trials, self._alive), goals)
        self._round += 1

    def _fresh(self, number: int) -> Trials:
        """The trials of a round."""
        count = self._exploration.trials
        task, _ = self._tasks[number % len(self._tasks)]
        return self._place.trials(task, self._episode_seed, number * count, count)

    def _steps(self, number: int) -> int:
        return self._tasks[number % len(self._tasks)][1]

    def _drift(self, number: int, step: int) -> None:
        """The noise of a step from that of the last."""
        rng = np.random.default_rng([self._seed, _NOISE, number, step])
        settings = self._exploration
        self._noise = self._noise * (1 - settings.noise_decay)
        self._noise = self._noise + settings.noise * rng.standard_normal(self._noise.shape)

    def _choose(
        self, latents: NDArray[np.float32], goals: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Actions ``[N, A]`` from -1 to 1."""
        settings = self._exploration
        if settings.uniform_before and self._taken < settings.steps_before:
            rng = np.random.default_rng([self._seed, _NOISE, self._round - 1, self._step, 1])
            uniform = rng.uniform(-1, 1, self._noise.shape).astype(np.float32)
            return uniform[self._alive]
        device = next(self._model.policy.parameters()).device
        with torch.no_grad():
            here, there = (torch.from_numpy(x).to(device) for x in (latents, goals))
            wanted = self._model.act(here, there).cpu().numpy()
        actions: NDArray[np.float32] = (wanted + self._noise[self._alive]).clip(-1, 1)
        return actions.astype(np.float32)

    def _boxed(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        boxed: NDArray[np.float32] = self._model.in_the_box(torch.from_numpy(actions)).numpy()
        return boxed

    def _seen(self, trials: Trials, which: Indices) -> NDArray[np.float32]:
        """Latents ``[N, L]`` of what trials see now."""
        device = next(self._model.policy.parameters()).device
        images = torch.from_numpy(np.ascontiguousarray(trials.observe(which)))
        with torch.no_grad():
            latents: NDArray[np.float32] = self._model.latents(images.to(device)).cpu().numpy()
        return latents
