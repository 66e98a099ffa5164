"""A spatial latent world model: a grid of features, what an action makes of it, and a decoder.

    state        z  = encoder(frame), a grid of cells of 8 x 8 pixels (three halvings)
    dynamics     z' = z + network(z, u), convolutions that know of the action u and of what is far
    frame        mask * colours + (1 - mask) * first frame, both drawn from z'

A vector state (:mod:`hvf.models.latent`) has to keep a number for the place of every thing, and
learns what touching does anew for every place where it happens. Here a thing is features in the
cells where it is, and one set of weights moves it everywhere. What goes far in one step, such as
an arm, is the business of a small network that sees the whole grid
(:class:`~hvf.models.spatial.network.Dynamics`). What the mask leaves alone is as sharp as the
first frame is.

Dynamics never see a predicted frame, and frames are drawn only where they are asked for: a step
costs what a few convolutions on the grid do, 12.3 MFLOP for 48 features in 8 x 8 cells; a
frame of 64 x 64 pixels costs 18.6 MFLOP.

Trained by prediction over several steps. The error of a frame is the sum of two, both squared and
meant over pixels:

* of sharp frames, where pixels that differ from the first frame weigh more (``change_weight``).
  Most of a frame stays as it is, and a thing that is pushed is a few dozen pixels: without this,
  little is lost by leaving it where it was;
* of blurred frames (``blur``), which is what planning compares, ``blur_weight`` times.

Letters in shapes: ``N`` sequences, ``L`` predicted steps, ``H x W`` pixels, ``h x w`` cells of
``F`` features, ``A`` action dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from hvf.blur import blur_matrix
from hvf.models.convolutions import initialise_after_he
from hvf.models.frames import to_unit
from hvf.models.spatial.config import SpatialConfig
from hvf.models.spatial.network import Decoder, Dynamics, Encoder
from hvf.models.video import State, VideoModel

# First weights of what is added to what was there, and first logit of the mask.
_LITTLE = 0.1
_HARDLY = -2.0


class SpatialLatent(VideoModel):
    """Encoder, dynamics and decoder; see the module's documentation.

    A state is ``(z [N, F, h, w], first frame [N, 3, H, W], what the decoder saw of it ...)``.
    """

    config_type: ClassVar[type[SpatialConfig]] = SpatialConfig
    config: SpatialConfig

    def __init__(self, config: SpatialConfig) -> None:
        super().__init__(config)
        self.hold = config.hold
        self.encoder = Encoder(config.widths)
        self.dynamics = Dynamics(
            config.widths[-1], config.grid, config.action_dim, config.blocks, config.known
        )
        self.decoder = Decoder(config.widths)
        initialise_after_he(self)
        with torch.no_grad():
            # At first little moves, and little is drawn over the first frame.
            for layer in self.dynamics.quiet():
                layer.weight.mul_(_LITTLE)
            self.decoder.last.weight.mul_(_LITTLE)
            # Four sub-pixels of each of four channels, of which the mask is the last.
            assert self.decoder.last.bias is not None
            self.decoder.last.bias[12:] = _HARDLY
        for side, size in zip(("down", "across"), config.image_size, strict=True):
            matrix = blur_matrix(size, config.blur) if config.blur > 0 else torch.eye(size)
            self.register_buffer(side, torch.as_tensor(matrix).float(), persistent=False)

    def start(self, frames: Tensor, past: Tensor) -> State:
        """The state of the last of ``frames [N, C, 3, H, W]``."""
        first = frames[:, -1]
        features = self.encoder(first)
        return (features[-1].float(), first, *self.decoder.seen(features))

    def step(
        self, state: State, actions: Tensor, noise: Tensor | None, *, last: bool = False
    ) -> State:
        """The state one action later; what else it holds stays."""
        change = self.dynamics(state[0], self.unit_actions(actions))
        return (state[0] + change.float(), *state[1:])

    def images(self, state: State) -> Tensor:
        """What a state looks like, float ``[N, 3, H, W]`` in [0, 1]."""
        return self.drawn(state).clamp(0, 1)

    def drawn(self, state: State) -> Tensor:
        """Frames float ``[N, 3, H, W]``, not clipped."""
        grid, first, *seen = state
        colours, mask = self.decoder(grid, seen)
        # Colours are about grey.
        drawn: Tensor = first + torch.sigmoid(mask.float()) * (colours.float() + 0.5 - first)
        return drawn

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Error of predicted frames; see the module's documentation.

        The batch holds ``frames``, uint8 ``[N, L + 1, H, W, 3]``, ``hold`` steps apart, and
        ``actions [N, L, A]``, in the environment's units. Of the ``L`` predicted frames the
        generator chooses ``drawn`` that are drawn and compared, and no step goes beyond them.
        """
        frames, actions = batch["frames"], batch["actions"]
        first = to_unit(frames[:, 0])
        state = self.start(first[:, None], actions[:, :0])
        order = torch.randperm(actions.shape[1], generator=generator, device=first.device)
        compared = order[: self.config.drawn].tolist()
        losses, errors, changes = [], [], []
        for time in range(max(compared) + 1):
            state = self.step(state, actions[:, time], None)
            if time in compared:
                truth = to_unit(frames[:, time + 1])
                error, change = self.drawn(state) - truth, truth - first
                losses.append(self._weighed(error, change))
                errors.append(error.detach().square().mean())
                changes.append(change.square().mean())
        parts = {"mse": torch.stack(errors).mean(), "still": torch.stack(changes).mean()}
        return torch.stack(losses).mean(), parts

    def _weighed(self, error: Tensor, change: Tensor) -> Tensor:
        """The loss of frames by their ``error`` and true ``change``, both ``[N, 3, H, W]``."""
        config = self.config
        changed = (change.abs().amax(1, keepdim=True) / config.change).clamp_max(1)
        sharp = (error.square() * (1 + config.change_weight * changed)).mean()
        down: Tensor = self.down  # type: ignore[assignment]
        across: Tensor = self.across  # type: ignore[assignment]
        with torch.autocast(error.device.type, enabled=False):
            blurred = down @ error.float().contiguous() @ across.T
        return sharp + config.blur_weight * blurred.square().mean()
