"""The latent model with a decoder, which draws what it predicts for people to look at.

Planning needs no decoder. A read-out is a blurred frame; the decoder sharpens it with the help of
the frame that the rollout began with, which shows what everything looks like. It sees that frame,
that frame as its own state reads out, and the predicted read-out, and adds what has changed.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.frames import to_unit
from hvf.models.latent.config import LatentConfig
from hvf.models.latent.dynamics import LatentDynamics
from hvf.models.video import State

# Each layer sees twice as far around a pixel as the one before, so that together they see further
# than the blur reaches, at any size of image.
_DILATIONS = (1, 2, 4)


class LatentModel(LatentDynamics):
    """Latent dynamics whose states can be drawn.

    A state is ``(s [N, S], first state [N, S], first frame [N, 3, H, W])``.
    """

    def __init__(self, config: LatentConfig) -> None:
        super().__init__(config)
        channels = config.decoder_channels
        layers: list[nn.Module] = [nn.Conv2d(9, channels, 1)]
        for dilation in _DILATIONS:
            layers += [
                nn.ReLU(),
                nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation),
            ]
        last = nn.Conv2d(channels, 3, 1)
        # At first the frame stays as it is.
        last.load_state_dict({name: 0 * weights for name, weights in last.state_dict().items()})
        self.decoder = nn.Sequential(*layers, nn.ReLU(), last)

    def with_dynamics(self, dynamics: LatentDynamics) -> LatentModel:
        """Take over trained dynamics and keep them as they are."""
        self.load_state_dict(dynamics.state_dict(), strict=False)
        self.requires_grad_(False)
        self.decoder.requires_grad_(True)
        return self

    def start(self, frames: Tensor, past: Tensor) -> State:
        """The state of the last of ``frames [N, C, 3, H, W]``."""
        (state,) = super().start(frames, past)
        return state, state, frames[:, -1]

    def images(self, state: State) -> Tensor:
        """What a state looks like, float ``[N, 3, H, W]`` in [0, 1]."""
        return self.drawn(*state).clamp(0, 1)

    def drawn(self, states: Tensor, first_states: Tensor, first: Tensor) -> Tensor:
        """Frames ``[N, 3, H, W]`` of ``states [N, S]``, not clipped.

        Args:
            states: what to draw.
            first_states: ``[N, S]``, of the frames that the rollouts began with.
            first: those frames, ``[N, 3, H, W]``.
        """
        after, before = (
            F.interpolate(
                self.basis.frames(self.read(part)),
                self.config.image_size,
                mode="bilinear",
                align_corners=False,
            )
            for part in (states, first_states)
        )
        drawn: Tensor = first + self.decoder(torch.cat([first, before, after - before], dim=1))
        return drawn

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Squared error of frames drawn from their own states, mean over numbers.

        The batch holds ``scene`` and ``image``, uint8 ``[N, H, W, 3]``, two frames of an episode;
        the second is drawn from its state and from the first.
        """
        scene, image = to_unit(batch["scene"]), to_unit(batch["image"])
        with torch.no_grad():
            first, state = (self.encoder(self.basis(part)) for part in (scene, image))
        error = (self.drawn(state, first, scene) - image).square().mean()
        return error, {"still": (scene - image).square().mean()}
