"""Latent dynamics: a small state, what an action makes of it, and what it looks like.

    state        s  = encoder(coefficients of the frame)
    dynamics     s' = s + network([s, u]),  u the action, scaled to the box
    read-out     coefficients of the predicted frame = waves(s)

Coefficients are those of :class:`~hvf.models.latent.basis.BlurredBasis`, so that the squared
distance of a read-out to a goal's coefficients is the squared pixel distance of the blurred and
reduced frames: planning rolls out states of a few dozen numbers, and draws nothing.

Trained by prediction over several steps: the read-outs of the first frame's state, and of each
state after it, against the coefficients of the true frames. States themselves have no target: they
become whatever predicts best. (With the coefficients
themselves as state, every step of a network has to take the picture apart and put it together.)

Letters in shapes: ``N`` frames, ``Z`` coefficients, ``S`` numbers of a state, ``A`` action
dimensions, ``L`` predicted steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

from hvf.models.latent.basis import BlurredBasis
from hvf.models.latent.config import LatentConfig
from hvf.models.latent.network import Residual, Waves
from hvf.models.video import State, VideoModel


class LatentDynamics(VideoModel):
    """Encoder, dynamics and read-out; see the module's documentation.

    It cannot draw: :class:`~hvf.models.latent.model.LatentModel` can.
    """

    config_type: ClassVar[type[LatentConfig]] = LatentConfig
    config: LatentConfig

    def __init__(self, config: LatentConfig) -> None:
        super().__init__(config)
        self.hold = config.hold
        size = config.state
        self.basis = BlurredBasis(config)
        self.encoder = Residual(
            config.components, config.encoder_width, config.encoder_blocks, size
        )
        self.network = Residual(
            size + config.action_dim, config.dynamics_width, config.dynamics_blocks, size
        )
        self.readout = Waves(size, config.readout_width, config.components)
        # At first nothing moves.
        nn.init.zeros_(self.network.output.weight)
        nn.init.zeros_(self.network.output.bias)

    def start(self, frames: Tensor, past: Tensor) -> State:
        """The state of the last of ``frames [N, C, 3, H, W]``."""
        state: Tensor = self.encoder(self.basis(frames[:, -1]))
        return (state,)

    def step(
        self, state: State, actions: Tensor, noise: Tensor | None, *, last: bool = False
    ) -> State:
        """The state one action later; what else it holds stays."""
        return (self.moved(state[0], self.unit_actions(actions)), *state[1:])

    def moved(self, states: Tensor, units: Tensor) -> Tensor:
        """States ``[N, S]`` after actions that are scaled to the box, ``units [N, A]``."""
        moved: Tensor = states + self.network(torch.cat([states, units], dim=-1))
        return moved

    def read(self, states: Tensor) -> Tensor:
        """Coefficients ``[..., Z]`` of what ``states [..., S]`` look like."""
        found: Tensor = self.readout(states)
        return found

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Squared error of all read-outs, as a part of the variance of reduced frames.

        The batch holds ``coefficients [N, L + 1, Z]`` and ``actions [N, L, A]``, in the
        environment's units.
        """
        truth = batch["coefficients"].float()
        units = self.unit_actions(batch["actions"])
        states = [self.encoder(truth[:, 0])]
        for h in range(units.shape[1]):
            states.append(self.moved(states[-1], units[:, h]))
        found = self.read(torch.stack(states, dim=1)).float()
        errors = self.basis.error(found, truth).mean(0)
        return errors.mean(), {"seen": errors[0].detach(), "last": errors[-1].detach()}
