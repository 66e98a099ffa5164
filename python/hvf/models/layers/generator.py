"""What the desk may look like later: a small CVAE on states.

The second generator of the desk's subgoals, beside the paper's VAE on images: it draws a state,
given the state of the scene, and the compact dynamics draws the image. Images are sharp, a subgoal
belongs to the scene that it is searched for, and planning starts from the state without looking at
the image again. What hardly moves does not move at all.

Letters in shapes: `N` samples, `A` action dimensions, `G` sliders, `R` parts that roam, `L` latent
dimensions, `X` = A + G + 3R length of a state (:mod:`hvf.models.layers.perception`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from hvf.models.layers.states import StateNetwork, StateSizes, perceptron
from hvf.models.vae import gaussian_kl

# Of the draws of a likelihood: always the same ones, so that costs of one search compare.
_SEED = 0


@dataclass(frozen=True)
class LayerGeneratorConfig(StateSizes):
    """Sizes.

    Attributes:
        latent_dim: latent dimensions, `L`.
        hidden: width of the hidden layers.
        depth: hidden layers of each network.
        activation: their nonlinearity. A smooth one gives a likelihood that a search goes down
            more easily.
        hand_precision: standard deviation to which the hand should be rebuilt, full actions.
        slider_precision: that of a slider, as a part of its way.
        part_precision: that of a part, pixels.
        presence_precision: that of a part's presence, which is 0 or 1.
        least_slide: change of a slider that is none.
        least_move: motion of a part that is none, pixels.
    """

    latent_dim: int = 8
    hidden: int = 192
    depth: int = 2
    activation: Literal["relu", "silu"] = "relu"
    hand_precision: float = 0.25
    slider_precision: float = 0.03
    part_precision: float = 1.0
    presence_precision: float = 0.2
    least_slide: float = 0.03
    least_move: float = 1.5

    def __post_init__(self) -> None:
        super().__post_init__()
        self.at_least_one("latent_dim", "hidden", "depth")
        if self.activation not in ("relu", "silu"):
            raise ValueError(f"activation must be 'relu' or 'silu', got {self.activation!r}")
        for name in (f"{thing}_precision" for thing in ("hand", "slider", "part", "presence")):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("least_slide", "least_move"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")


class LayerGenerator(StateNetwork):
    """CVAE of states; see the module's documentation."""

    config_type: ClassVar[type[LayerGeneratorConfig]] = LayerGeneratorConfig

    def __init__(self, config: LayerGeneratorConfig) -> None:
        super().__init__(config)
        self.config = config
        size = config.state_size
        latent = config.latent_dim
        self.posterior = _network(config, 2 * size, 2 * latent)
        self.decoder = _network(config, size + latent, size)

    def decode(self, latents: Tensor, scenes: Tensor) -> Tensor:
        """States `[N, X]` for `latents [N, L]` in scenes of states `scenes [N, X]`."""
        return self.decided(self.rebuild(latents, scenes), scenes)

    def decided(self, states: Tensor, scenes: Tensor) -> Tensor:
        """What :meth:`rebuild` says, `[N, X]`, once it is decided what moves and what is there."""
        fixed, parts = states[:, : -3 * self.config.roaming], self.parts(states)
        hand = fixed[:, : self.config.action_dim]
        was = scenes[:, self.config.action_dim : fixed.shape[1]]
        sliders = fixed[:, self.config.action_dim :].clamp(0, 1)
        sliders = torch.where((sliders - was).abs() < self.config.least_slide, was, sliders)
        before = self.parts(scenes)
        there = (parts[..., 2:] > 0.5).to(parts.dtype) * before[..., 2:]
        stays = (parts - before)[..., :2].norm(dim=2, keepdim=True) < self.config.least_move
        places = torch.where(stays, before[..., :2], parts[..., :2])
        return torch.cat([hand, sliders, torch.cat([places, there], dim=2).flatten(1)], dim=1)

    def rebuild(self, latents: Tensor, scenes: Tensor) -> Tensor:
        """What the decoder says, before it is decided what moves and what is there: `[N, X]`."""
        change: Tensor = self.decoder(torch.cat([latents, self.normal(scenes)], dim=1))
        return scenes + change * self.scale

    def encode(self, states: Tensor, scenes: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance `[N, L]` of the latents of `states [N, X]`."""
        seen = torch.cat([self.normal(states), self.normal(scenes)], dim=1)
        mean, log_variance = self.posterior(seen).chunk(2, dim=1)
        return mean, log_variance.clamp(-12.0, 4.0)

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Negative evidence lower bound, in nats, of `states [N, X]` given `scenes [N, X]`."""
        states, scenes = batch["states"], batch["scenes"]
        mean, log_variance = self.encode(states, scenes)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        rebuilt = self.rebuild(mean + noise * (0.5 * log_variance).exp(), scenes)
        distortion = self._distortion(rebuilt, states).mean()
        kl = gaussian_kl(mean, log_variance).mean()
        pieces = {"kl": kl, "distortion": distortion}
        return distortion + kl, {name: value.detach() for name, value in pieces.items()}

    def surprise(self, states: Tensor, scenes: Tensor, draws: int = 1) -> Tensor:
        """How unlikely ``states [N, X]`` are after ``scenes [N, X]``, nats, ``[N]``.

        The negative log-likelihood up to a constant, by importance sampling from the posterior
        (Burda et al., 2016). Grows with what has to change, and more than in proportion where
        several things have to that seldom do within one stretch of play.
        """
        mean, log_variance = self.encode(states, scenes)
        generator = torch.Generator().manual_seed(_SEED)
        noise = torch.randn((draws, 1, mean.shape[1]), generator=generator).to(mean.device)
        log_weights = [
            0.5 * (each.square() + log_variance - latents.square()).sum(dim=1)
            - self._distortion(self.rebuild(latents, scenes), states)
            for each, latents in zip(noise, mean + noise * (0.5 * log_variance).exp(), strict=True)
        ]
        return math.log(draws) - torch.logsumexp(torch.stack(log_weights), dim=0)

    def _distortion(self, rebuilt: Tensor, states: Tensor) -> Tensor:
        """How far states were missed, nats, ``[N]``."""
        config = self.config
        hand = slice(0, config.action_dim)
        sliders = slice(config.action_dim, config.action_dim + config.sliders)
        parts, truth = self.parts(rebuilt), self.parts(states)
        # Where something is that is not there does not matter.
        apart = (parts - truth)[..., :2] / config.part_precision * truth[..., 2:]
        wrong = [
            ((rebuilt - states)[:, hand] / config.hand_precision).square().sum(dim=1),
            ((rebuilt - states)[:, sliders] / config.slider_precision).square().sum(dim=1),
            apart.square().sum(dim=(1, 2)),
            ((parts - truth)[..., 2] / config.presence_precision).square().sum(dim=1),
        ]
        return 0.5 * torch.stack(wrong).sum(dim=0)


def _network(config: LayerGeneratorConfig, inputs: int, outputs: int) -> nn.Sequential:
    between = {"relu": nn.ReLU, "silu": nn.SiLU}[config.activation]
    return perceptron(inputs, config.hidden, outputs, config.depth, between)
