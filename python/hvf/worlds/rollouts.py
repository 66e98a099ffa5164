"""Rollouts of a video model: on a device, in batches, within a memory.

Letters in shapes: ``N`` frames or rows of a batch, ``C`` frames of context, ``H`` steps, ``A``
action dimensions, ``Z`` numbers of noise, ``S x S`` pixels (height and width may differ).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hvf.cores import cores
from hvf.models.frames import to_unit
from hvf.models.video import State, VideoModel
from hvf.protocols import Images
from hvf.settings import Precision, check_word
from hvf.threads import one_thread
from hvf.worlds.batching import Rows, allocated, batches, on_threads

T = TypeVar("T")

# Candidates of a batch on a CPU, at most: as many as keep its vector units busy while what is
# computed on stays in the caches. It must not depend on the machine, and it divides 200.
_CPU_BATCH = 25
_CPU_MEMORY = 2e9
# On CUDA: part of the free memory that batches may take, and candidates at most.
_CUDA_PART = 0.7
_CUDA_BATCH = 1 << 14
# Part of the memory that states of starts may take.
_STATES_PART = 0.25


@dataclasses.dataclass(frozen=True)
class VideoFrames:
    """Frames of a video model's world.

    Attributes:
        images: what is seen now, uint8 ``[N, S, S, 3]``.
        before: what was seen before, uint8 ``[N, C - 1, S, S, 3]``.
        past: what was done in between, float32 ``[N, C - 1, A]``.
        state: the model's state of now, of prepared starts.
        aim: what is compared with predicted frames, of prepared goals.
    """

    images: Images
    before: Images
    past: NDArray[np.float32]
    state: State | None = None
    aim: Tensor | None = None

    def __len__(self) -> int:
        """Return the number of frames, ``N``."""
        return len(self.images)

    def __getitem__(self, index: Rows) -> VideoFrames:
        """Return the frames at ``index``."""
        state = None if self.state is None else chosen(self.state, index)
        aim = None if self.aim is None else chosen((self.aim,), index)[0]
        return VideoFrames(self.images[index], self.before[index], self.past[index], state, aim)

    @staticmethod
    def join(parts: list[VideoFrames]) -> VideoFrames:
        """Return the frames of all parts, in order, as they were before they were prepared."""
        return VideoFrames(
            np.concatenate([part.images for part in parts]),
            np.concatenate([part.before for part in parts]),
            np.concatenate([part.past for part in parts]),
        )

    def keys(self) -> Iterator[bytes]:
        """What tells each frame from others."""
        for image, before, past in zip(self.images, self.before, self.past, strict=True):
            yield image.tobytes() + before.tobytes() + past.tobytes()


def chosen(state: State, rows: Rows) -> State:
    """The rows of a state, repeats allowed."""
    index = torch.from_numpy(np.asarray(rows, np.int64))
    return tuple(part.index_select(0, index.to(part.device)) for part in state)


class Rollouts:
    """A video model on a device, and the batches that fit there.

    Args:
        model: predicts; it is moved to the device.
        memory_gb: memory that batches may take, gigabytes; by default 2 on a CPU and most of what
            is free on CUDA.
        device: where the model runs; by default CUDA where there is one.
        precision: of convolutions: ``auto`` is bfloat16 on CUDA and float32 on a CPU.
        compile: compile the model's step (`torch.compile`), for batches of few sizes.

    Raises:
        ValueError: a setting out of range.
    """

    def __init__(
        self,
        model: VideoModel,
        memory_gb: float | None = None,
        device: str | torch.device | None = None,
        precision: Precision = "auto",
        compile: bool = False,
    ) -> None:
        check_word("precision", precision, ("auto", "float32", "bfloat16"))
        if memory_gb is not None and not 0 < memory_gb < np.inf:
            raise ValueError(f"memory_gb: must be positive and finite, got {memory_gb}")
        if device is None:
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            self.device = torch.device(device)
        except RuntimeError as error:
            raise ValueError(f"device: {device!r} is none that torch knows") from error
        if self.device.type == "cuda" and not torch.cuda.is_available():
            raise ValueError(f"device: there is no CUDA here, got {str(device)!r}")
        self.cuda = self.device.type == "cuda"
        self.model = model.eval().requires_grad_(False).to(self.device)
        self.model.to(memory_format=torch.channels_last)
        self._memory_gb = memory_gb
        self._half = precision == "bfloat16" or (precision == "auto" and self.cuda)
        self._compiled = compile
        self._step = torch.compile(model.step, dynamic=False) if compile else model.step

    def rollout(
        self, state: State, actions: Tensor, noise: Tensor | None, rows: Rows, *, every: bool
    ) -> Iterator[Tensor]:
        """Predicted images float32 ``[N, 3, S, S]``, of every step or of the last one only.

        Args:
            state: of the rows, ``[N, ...]``.
            actions: of all candidates, float ``[.., H, A]``.
            noise: of all candidates, float ``[.., Z]``, for a stochastic model.
            rows: which of the candidates, ``[N]``.
            every: whether images of all steps are wanted.
        """
        (actions,) = chosen((actions,), rows)
        noise = None if noise is None else chosen((noise,), rows)[0]
        steps = actions.shape[1]
        for step in range(steps):
            last = step + 1 == steps
            with self._autocast():
                state = self._step(state, actions[:, step], noise, last=last)
                drawn = self.model.images(state) if every or last else None
            if drawn is not None:
                yield drawn.float()

    def state(self, frames: VideoFrames, rows: Rows) -> State:
        """The model's state at ``rows`` of frames, made now where they do not have it."""
        if frames.state is not None:
            return chosen(frames.state, rows)
        different, place = np.unique(rows, return_inverse=True)
        states = [self._start(frames, different[part]) for part in self._apart(len(different))]
        return chosen(tuple(torch.cat(parts) for parts in zip(*states, strict=True)), place)

    def states(self, frames: VideoFrames) -> State | None:
        """The model's states at all frames; None where they would take too much memory."""
        with one_thread():
            one = self._start(frames, np.zeros(1, np.int64))
        if len(frames) * sum(part.nbytes for part in one) > _STATES_PART * self._memory:
            return None
        states = self.each(partial(self._start, frames), len(frames))
        return tuple(torch.cat(parts) for parts in zip(*states, strict=True))

    def each(self, work: Callable[[Rows], T], count: int) -> list[T]:
        """What ``work`` makes of rows of what is no candidate: on a CPU of each by itself."""
        return self.run(work, self._apart(count))

    def run(self, work: Callable[[Rows], T], parts: list[Rows]) -> list[T]:
        """What ``work`` makes of each batch of rows, without gradients."""
        if self.cuda:
            with torch.inference_mode():
                return [work(rows) for rows in parts]
        # A batch for each thread must fit.
        fitting = self._memory / (self._bytes * max(len(rows) for rows in parts))
        threads = max(1, min(torch.get_num_threads(), cores(), int(fitting)))
        return on_threads([partial(work, rows) for rows in parts], threads)

    def batches(self, count: int) -> list[Rows]:
        """Rows of ``count`` candidates in batches of one size that fit."""
        return batches(count, self.most, few_sizes=self._compiled)

    def tensor(self, array: NDArray[Any]) -> Tensor:
        """A copy on the device."""
        return torch.from_numpy(np.array(array)).to(self.device)

    @cached_property
    def most(self) -> int:
        """Rows of a batch, at most: the same on every CPU for one ``memory_gb``."""
        limit = _CUDA_BATCH if self.cuda else _CPU_BATCH
        return max(1, min(limit, int((1 - _STATES_PART) * self._memory / self._bytes)))

    def _start(self, frames: VideoFrames, rows: Rows) -> State:
        seen = np.concatenate([frames.before[rows], frames.images[rows, None]], axis=1)
        images = to_unit(self.tensor(seen).flatten(0, 1))
        images = images.reshape(*seen.shape[:2], *images.shape[1:])
        with self._autocast():
            return self.model.start(images, self.tensor(frames.past[rows]))

    def _apart(self, count: int) -> list[Rows]:
        size = self.most if self.cuda else 1
        return np.split(np.arange(count), range(size, count, size))

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self._half)

    @cached_property
    def _memory(self) -> float:
        """Bytes that batches and states may take."""
        if self._memory_gb is not None:
            return self._memory_gb * 1e9
        if self.cuda:
            return _CUDA_PART * torch.cuda.mem_get_info(self.device)[0]
        return _CPU_MEMORY

    @cached_property
    def _bytes(self) -> float:
        """Bytes of a batch for each of its rows."""
        config, context = self.model.config, self.model.context
        shape = (1, context, *config.image_size, 3)

        def rehearse(rows: int) -> None:
            """One step from a shared start, and the difference of what it predicts to a goal."""
            past = np.zeros((1, context - 1, config.action_dim), np.float32)
            seen = np.zeros(shape, np.uint8)
            with one_thread(), self._autocast():
                one = self._start(VideoFrames(seen[:, -1], seen[:, :-1], past), np.arange(1))
                state = chosen(one, np.zeros(rows, np.int64))
                actions = torch.zeros(rows, config.action_dim, device=self.device)
                noise = torch.zeros(rows, self.model.noise, device=self.device)
                state = self.model.step(state, actions, noise if self.model.noise else None)
                images = self.model.images(state).float()
                (images.clone() - images[:1]).square()

        return allocated(rehearse, self.device)
