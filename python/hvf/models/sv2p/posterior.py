"""The posterior of SV2P: what a whole clip says about the latent that all of its frames share."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hvf.models.sv2p.config import SV2PConfig
from hvf.models.sv2p.layers import Down, layer_norm


class Posterior(nn.Module):
    """All frames of a clip, one over the other, to mean and log variance of the latent."""

    def __init__(self, config: SV2PConfig) -> None:
        super().__init__()
        first, second, third = config.posterior
        self.body = nn.Sequential(
            Down(3 * config.frames, first, 3),
            nn.ReLU(),
            layer_norm(first),
            Down(first, second, 3),
            nn.ReLU(),
            layer_norm(second),
            nn.Conv2d(second, third, 3, padding=1),
            nn.ReLU(),
            layer_norm(third),
        )
        self.mean = Down(third, 1, 3)
        self.spread = Down(third, 1, 3)
        self._least = config.least_log_variance

    def forward(self, clip: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance, ``[N, Z]`` each, of ``clip [N, T, 3, H, W]``.

        The log variance is rectified before the least one is added, as in the original: it is
        never below.
        """
        features = self.body(clip.flatten(1, 2))
        mean, spread = self.mean(features).flatten(1), self.spread(features).flatten(1)
        return mean.float(), F.relu(spread.float()) + self._least


def divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL divergence to the standard normal prior, nats, ``[N]``."""
    return 0.5 * (mean.square() + torch.expm1(log_variance) - log_variance).sum(dim=1)
