"""Any torch video model as the planner wants it: batched, bounded in memory, on a CPU or a GPU.

Starts and goals are prepared once a plan: the model's state of now
(:meth:`~hvf.models.video.VideoModel.start`), which all candidates of a start share, and the blurred
goal. Candidates are rolled out in batches (:mod:`hvf.worlds.batching`), and only the frames that
the cost needs are drawn.

On a CPU in float32 a plan is the same to the last bit alone and in a batch of problems, with
rollouts shared or not, and on any number of threads. A GPU fills its batches across problems, and
promises the same only up to rounding.

Letters in shapes: ``B`` problems, ``D`` candidates, ``H`` steps, ``A`` action dimensions, ``N``
frames, ``C`` frames of context, ``S x S`` pixels (height and width may differ).
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hvf.models.frames import to_frames, to_unit
from hvf.models.video import State, VideoModel, sequence_noise
from hvf.protocols import Images
from hvf.settings import OverHorizon, Planning, Precision, check_word
from hvf.worlds.batching import Rows
from hvf.worlds.pixels import PixelCost
from hvf.worlds.rollouts import Rollouts, VideoFrames, chosen
from hvf.worlds.world import checked_images

__all__ = ["RememberingVideoWorld", "VideoFrames", "VideoWorld", "world_of"]


class VideoWorld:
    """A video model as a world model (`hvf.protocols.WorldModel`).

    For a stochastic model :attr:`uses_seeds` is true, and a candidate's noise is a function of its
    seed alone. A model with context is best made a world by :func:`world_of`, which remembers;
    here each image that is observed stands for a trial that has just begun.

    Args:
        model: predicts; it is moved to the device.
        blur: standard deviation in pixels of the Gaussian blur through which predicted frames and
            goals are compared; 0 for none.
        over_horizon: whether the last predicted frame counts, their sum, or their minimum. A model
            with ``hold`` predicts, and is compared at, every ``hold``-th step only.
        action_repeat: steps that a planned action is held for: a multiple of the model's ``hold``.
        memory_gb: memory that batches may take, gigabytes; by default 2 on a CPU and most of what
            is free on CUDA.
        device: where the model runs; by default CUDA where there is one.
        precision: of the model's convolutions: ``auto`` is bfloat16 on CUDA and float32 on a CPU.
            Costs are float32 always.
        compile: compile the model's step (`torch.compile`), which pays in long searches on a GPU.

    Raises:
        ValueError: a setting out of range, or an ``action_repeat`` that the model cannot take.
    """

    def __init__(
        self,
        model: VideoModel,
        *,
        blur: float = 0.0,
        over_horizon: OverHorizon = "last",
        action_repeat: int = 1,
        memory_gb: float | None = None,
        device: str | torch.device | None = None,
        precision: Precision = "auto",
        compile: bool = False,
    ) -> None:
        check_word("over_horizon", over_horizon, ("last", "sum", "min"))
        if action_repeat < 1 or action_repeat % model.hold:
            raise ValueError(
                f"action_repeat: must be a multiple of {model.hold}, the steps for which this "
                f"model holds an action; got {action_repeat}"
            )
        self.rollouts = Rollouts(model, memory_gb, device, precision, compile)
        self.model = model
        self.over_horizon: OverHorizon = over_horizon
        self.cost = PixelCost(*model.config.image_size, blur, self.rollouts.device)

    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 ``[A]``."""
        return np.array(self.model.config.action_low, np.float32)

    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 ``[A]``."""
        return np.array(self.model.config.action_high, np.float32)

    @property
    def uses_seeds(self) -> bool:
        """Whether candidates have noise of their own."""
        return self.model.noise > 0

    def observe(self, images: Images) -> VideoFrames:
        """Frames of uint8 ``images [N, S, S, 3]``, before which nothing moved.

        Raises:
            ValueError: images of another size than the model's.
            TypeError: images that are not uint8.
        """
        images = checked_images(images, *self.model.config.image_size)
        earlier = self.model.context - 1
        before = np.broadcast_to(images[:, None], (len(images), earlier, *images.shape[1:]))
        past = np.zeros((len(images), earlier, self.model.config.action_dim), np.float32)
        return VideoFrames(images, before, past)

    def images(self, frames: VideoFrames) -> Images:
        """What frames look like, uint8 ``[N, S, S, 3]``."""
        return frames.images

    def prepare(self, starts: VideoFrames, goals: VideoFrames) -> tuple[VideoFrames, VideoFrames]:
        """Starts with the model's state, unless those would fill the memory; goals blurred."""
        return (
            dataclasses.replace(starts, state=self.rollouts.states(starts)),
            dataclasses.replace(goals, aim=self._aims(goals)),
        )

    def rollout_costs(
        self,
        starts: VideoFrames,
        goals: VideoFrames,
        actions: NDArray[np.float32],
        seeds: NDArray[np.int64] | None = None,
    ) -> NDArray[np.float32]:
        """Planning costs float32 ``[B, D]``.

        Args:
            starts: frames ``[B]``, best prepared.
            goals: frames ``[B]``, best prepared.
            actions: float32 ``[B, D, H, A]``.
            seeds: of the noise of a stochastic model, int64 ``[B, D]``.

        Raises:
            ValueError: steps that are no multiple of the model's ``hold``, or seeds that a
                stochastic model lacks.
        """
        count, candidates = actions.shape[:2]
        everyone = np.arange(count * candidates)
        flat = self._actions(actions.reshape(len(everyone), *actions.shape[2:]))
        noise = self._noise(seeds, len(everyone))
        aims = self._aims(goals)
        # On a CPU a batch is of one problem, so that it is the same whatever else is planned.
        groups = [everyone] if self.rollouts.cuda else np.split(everyone, count)
        parts = [group[rows] for group in groups for rows in self.rollouts.batches(len(group))]

        def score(rows: Rows) -> Tensor:
            problem = rows // candidates
            (aim,) = chosen((aims,), problem[:1] if problem[0] == problem[-1] else problem)
            return self._scored(self.rollouts.state(starts, problem), flat, noise, rows, [aim])

        costs = np.empty(len(everyone), np.float32)
        for rows, found in zip(parts, self.rollouts.run(score, parts), strict=True):
            costs[rows] = found[0].cpu().numpy()
        return costs.reshape(count, candidates)

    def shared_rollout_costs(
        self,
        start: VideoFrames,
        goals: VideoFrames,
        actions: NDArray[np.float32],
        seeds: NDArray[np.int64] | None = None,
    ) -> NDArray[np.float32]:
        """Planning costs float32 ``[B, D]`` of one set of candidates for every goal.

        On a CPU they are those of :meth:`rollout_costs`, to the last bit.

        Args:
            start: one frame.
            goals: frames ``[B]``.
            actions: float32 ``[D, H, A]``.
            seeds: of the noise of a stochastic model, int64 ``[D]``.

        Raises:
            ValueError: as :meth:`rollout_costs`.
        """
        flat, noise = self._actions(actions), self._noise(seeds, len(actions))
        aims = [aim[None] for aim in self._aims(goals)]
        parts = self.rollouts.batches(len(actions))

        def score(rows: Rows) -> Tensor:
            state = self.rollouts.state(start, np.zeros(len(rows), np.int64))
            return self._scored(state, flat, noise, rows, aims)

        costs = np.empty((len(aims), len(actions)), np.float32)
        for rows, found in zip(parts, self.rollouts.run(score, parts), strict=True):
            costs[:, rows] = found.cpu().numpy()
        return costs

    def predict(
        self,
        frames: VideoFrames,
        actions: NDArray[np.float32],
        seeds: NDArray[np.int64] | None = None,
    ) -> Images:
        """Predicted frames uint8 ``[N, H, S, S, 3]``, to look at.

        A model with ``hold`` predicts every ``hold``-th frame; those in between are copies of the
        next one that it predicts.

        Args:
            frames: to start from.
            actions: float32 ``[N, H, A]``.
            seeds: of the noise of a stochastic model, int64 ``[N]``; 0, 1, 2, ... by default.
        """
        (count, horizon), hold = actions.shape[:2], self.model.hold
        drawn = np.empty((count, horizon, *frames.images.shape[1:]), np.uint8)
        if not drawn.size:
            return drawn
        flat = self.rollouts.tensor(actions[:, ::hold])
        noise = self._noise(np.arange(count) if seeds is None else seeds, count)
        # Candidates of one start may come as so many copies of it.
        known: dict[bytes, int] = {}
        first = np.array([known.setdefault(key, i) for i, key in enumerate(frames.keys())])
        parts = self.rollouts.batches(count)

        def draw(rows: Rows) -> Tensor:
            state = self.rollouts.state(frames, first[rows])
            images = self.rollouts.rollout(state, flat, noise, rows, every=True)
            return torch.stack([to_frames(image) for image in images], dim=1)

        for rows, found in zip(parts, self.rollouts.run(draw, parts), strict=True):
            drawn[rows] = found.cpu().numpy().repeat(hold, axis=1)[:, :horizon]
        return drawn

    def _scored(
        self, state: State, actions: Tensor, noise: Tensor | None, rows: Rows, aims: list[Tensor]
    ) -> Tensor:
        """Costs ``[len(aims), N]`` of rolling out ``rows`` from ``state [N]``."""
        over = self.over_horizon
        total: Tensor | None = None
        for images in self.rollouts.rollout(state, actions, noise, rows, every=over != "last"):
            features = self.cost.features(images)
            costs = torch.stack([self.cost.between(features, aim) for aim in aims])
            if total is None:
                total = costs
            else:
                total = torch.minimum(total, costs) if over == "min" else total + costs
        assert total is not None, "there is at least one step"
        return total

    def _aims(self, goals: VideoFrames) -> Tensor:
        """What predicted frames are compared with, ``[B, 3, S, S]``."""
        if goals.aim is not None:
            return goals.aim

        def blurred(rows: Rows) -> Tensor:
            return self.cost.features(to_unit(self.rollouts.tensor(goals.images[rows])))

        return torch.cat(self.rollouts.each(blurred, len(goals)))

    def _actions(self, actions: NDArray[np.float32]) -> Tensor:
        """Actions ``[N, H, A]`` of the model's steps, on its device."""
        hold = self.model.hold
        if actions.shape[1] % hold:
            raise ValueError(
                f"actions: {actions.shape[1]} steps are no multiple of {hold}, the steps for which "
                "this model holds an action"
            )
        return self.rollouts.tensor(actions[:, ::hold])

    def _noise(self, seeds: NDArray[np.int64] | None, count: int) -> Tensor | None:
        """Noise of ``count`` sequences, ``[N, Z]``; None for a deterministic model."""
        if not self.model.noise:
            return None
        if seeds is None:
            raise ValueError("seeds: this model is stochastic, and needs one for each candidate")
        flat = torch.from_numpy(np.array(seeds, np.int64).reshape(count))
        return sequence_noise(flat, self.model.noise).to(self.rollouts.device)


class RememberingVideoWorld(VideoWorld):
    """A world of a model with context, whose plans start from what was seen and done.

    It is a `hvf.protocols.Remembering`; arguments are those of :class:`VideoWorld`.
    """

    @property
    def context(self) -> int:
        """Frames that it wants: the model's are ``hold`` steps apart."""
        return (self.model.context - 1) * self.model.hold + 1

    def observe_history(self, images: Images, actions: NDArray[np.float32]) -> VideoFrames:
        """Frames to start from, ``[N]``.

        Args:
            images: uint8 ``[N, context, S, S, 3]``, the last one being now.
            actions: float32 ``[N, context - 1, A]``, done in between.

        Raises:
            ValueError: another shape.
            TypeError: images that are not uint8.
        """
        count, context = len(images), self.context
        if images.ndim != 5 or images.shape[1] != context:
            raise ValueError(
                f"images: expected shape [N, {context}, height, width, 3], got {images.shape}"
            )
        expected = (count, context - 1, self.model.config.action_dim)
        if actions.shape != expected:
            raise ValueError(f"actions: expected shape {expected}, got {actions.shape}")
        flat = checked_images(images.reshape(-1, *images.shape[2:]), *self.model.config.image_size)
        kept = flat.reshape(images.shape)[:, :: self.model.hold]
        past = np.ascontiguousarray(actions[:, :: self.model.hold], np.float32)
        return VideoFrames(np.ascontiguousarray(kept[:, -1]), kept[:, :-1], past)


def world_of(
    model: VideoModel,
    planning: Planning,
    *,
    device: str | None = None,
    precision: Precision = "auto",
    memory_gb: float | None = None,
    compile: bool = False,
) -> VideoWorld:
    """The world that a trained video model is, with the cost of plan settings.

    Other arguments are those of :class:`VideoWorld`.

    Raises:
        ValueError: an ``action_repeat`` that the model cannot take, or a device that there is not.
    """
    kind = RememberingVideoWorld if model.context > 1 else VideoWorld
    return kind(
        model,
        blur=planning.blur,
        over_horizon=planning.over_horizon,
        action_repeat=planning.action_repeat,
        device=device,
        precision=precision,
        memory_gb=memory_gb,
        compile=compile,
    )
