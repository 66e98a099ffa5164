"""What a video model is: it predicts images from images and actions, and knows nothing of a scene.

A model is a :class:`VideoModel`: it turns frames into a *state*, takes a state one action further,
and draws a state as an image. Everything else is common to all of them: planning
(:mod:`hvf.worlds.video`), measuring of predictions (``hvf probe``) and pictures.

Letters in shapes: ``N`` sequences, ``C`` frames of context, ``H x W`` pixels, ``A`` action
dimensions, ``Z`` numbers of noise.
"""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

import torch
from torch import Tensor, nn

from hvf.action_box import check_action_box

State: TypeAlias = tuple[Tensor, ...]
"""What a model remembers, tensors ``[N, ...]`` of any shape: hidden states, latents, a frame."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoConfig:
    """What every video model has to know of its data.

    Attributes:
        image_size: height and width of the frames, pixels.
        action_low: lowest action, ``A`` numbers.
        action_high: highest action, ``A`` numbers.

    Raises:
        ValueError: sizes below 1, or no box.
    """

    image_size: tuple[int, int] = (64, 64)
    action_low: tuple[float, ...] = (-1.0, -1.0)
    action_high: tuple[float, ...] = (1.0, 1.0)

    def __post_init__(self) -> None:
        # Checkpoints keep tuples as lists.
        for name in ("image_size", "action_low", "action_high"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if len(self.image_size) != 2 or min(self.image_size) < 1:
            raise ValueError(f"image_size must be height and width, got {self.image_size}")
        check_action_box(self.action_low, self.action_high)

    @property
    def action_dim(self) -> int:
        """Action dimensions, ``A``."""
        return len(self.action_low)


class VideoModel(nn.Module):
    """A model that predicts images from images and actions.

    Attributes:
        context: frames that it starts from, ``C``.
        hold: steps of the environment that one of its steps is long, during which the action is
            the same.
        noise: numbers of standard normal noise that one sequence takes, ``Z``; 0 for a
            deterministic model. The noise of a sequence is drawn once, from its seed alone.
    """

    context: int = 1
    hold: int = 1
    noise: int = 0

    def __init__(self, config: VideoConfig) -> None:
        super().__init__()
        self.config: VideoConfig = config

    def start(self, frames: Tensor, past: Tensor) -> State:
        """The state of now.

        All that does not depend on what is done next belongs here: a planner asks once for a
        start, and shares it among all of its candidates.

        Args:
            frames: float ``[N, C, 3, H, W]`` in [0, 1], the last one being now.
            past: actions between them, float ``[N, C - 1, A]``.
        """
        raise NotImplementedError

    def step(
        self, state: State, actions: Tensor, noise: Tensor | None, *, last: bool = False
    ) -> State:
        """The state one step later.

        Args:
            state: from :meth:`start` or :meth:`step`; not to be changed in place.
            actions: as the environment takes them, float ``[N, A]``.
            noise: of the whole sequence, float ``[N, Z]``; None for a deterministic model.
            last: no step follows: what only a next step needs may be left out.
        """
        raise NotImplementedError

    def images(self, state: State) -> Tensor:
        """What a state looks like, float ``[N, 3, H, W]`` in [0, 1].

        Not asked for states of :meth:`start`, whose frames are known.
        """
        raise NotImplementedError

    def unit_actions(self, actions: Tensor) -> Tensor:
        """``actions [..., A]`` scaled so that the action box is from -1 to 1."""
        low = actions.new_tensor(self.config.action_low)
        high = actions.new_tensor(self.config.action_high)
        return (actions - low) / (high - low) * 2 - 1


def sequence_noise(seeds: Tensor, size: int) -> Tensor:
    """Standard normal noise of sequences, float32 ``[N, size]`` on the CPU.

    Each row is a function of its own seed and nothing else, so that a plan is the same alone and
    in a batch.

    Args:
        seeds: int64 ``[N]``, from 0.
        size: numbers of noise each, ``Z``.
    """
    # A generator a row would be a loop over samples: instead one hash a number (SplitMix64's
    # finaliser), two of which make a normal number (Box and Muller).
    counts = torch.arange(2 * size, dtype=torch.int64)
    mixed = _mix(_mix(seeds)[:, None] + counts * _GOLDEN)
    unit = ((mixed >> 40) & 0xFFFFFF).double().add(0.5) / 2**24
    radius = (-2 * unit[:, :size].log()).sqrt()
    return (radius * (2 * torch.pi * unit[:, size:]).cos()).float()


_GOLDEN = 0x9E3779B97F4A7C15 - 2**64


def _mix(value: Tensor) -> Tensor:
    """SplitMix64's finaliser, on int64 that wraps around; shifts are made logical by masks."""
    value = (value ^ ((value >> 30) & (2**34 - 1))) * (0xBF58476D1CE4E5B9 - 2**64)
    value = (value ^ ((value >> 27) & (2**37 - 1))) * (0x94D049BB133111EB - 2**64)
    return value ^ ((value >> 31) & (2**33 - 1))
