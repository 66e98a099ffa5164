"""Which change comes next: a network that proposes subgoals at the desk, given start and goal.

The paper leaves amortised subgoals to future work. Here a network says, of a scene, a goal and how
many subgoals are left, where in the generator's latent the next one lies: a diagonal Gaussian. What
is drawn of it is the scene of the one after, so any number up to :attr:`~ProposalsConfig.most` is
proposed by one network.

It learns in two steps. First in hindsight: of recorded changes the latents are known
(:meth:`LayerProposals.hindsight`). Hindsight has no preference, though: three changes in one order
are as good as in another, and the mean of both is neither. So then the network follows the best of
what it proposes, by the search's own cost (:meth:`LayerProposals.best`): the cross-entropy method,
whose distribution is the network's, for all scenes and goals at once.

Letters in shapes: `N` samples, `K` subgoals, `L` latent dimensions, `X` length of a state
(:mod:`hvf.models.layers.perception`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from hvf.models.layers.generator import LayerGenerator, LayerGeneratorConfig
from hvf.models.layers.states import StateNetwork, perceptron

# Logarithms of the least and largest standard deviation; 1 is that of the prior.
_LOG_STD = (-2.0, 0.5)


@dataclass(frozen=True)
class ProposalsConfig:
    """Sizes.

    Attributes:
        generator: the generator whose latents are proposed.
        most: most subgoals.
        hidden: width of the hidden layers.
        depth: hidden layers.
        draws: draws for a scene and goal, of which it follows the best.
        elites: how many these are.
    """

    generator: LayerGeneratorConfig = field(default_factory=LayerGeneratorConfig)
    most: int = 2
    hidden: int = 256
    depth: int = 3
    draws: int = 64
    elites: int = 4

    def __post_init__(self) -> None:
        for name in ("most", "hidden", "depth", "elites"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.draws < self.elites:
            raise ValueError(f"draws must be at least elites, {self.elites}; got {self.draws}")


class LayerProposals(StateNetwork):
    """The network; see the module's documentation."""

    config_type: ClassVar[type[ProposalsConfig]] = ProposalsConfig

    def __init__(self, config: ProposalsConfig) -> None:
        sizes = config.generator
        super().__init__(sizes)
        self.config = config
        inputs = 2 * sizes.state_size + config.most
        self.network = perceptron(inputs, config.hidden, 2 * sizes.latent_dim, config.depth)
        # In a tuple, since it is no part of the network and not saved with it.
        self._generator: tuple[LayerGenerator, ...] = ()

    def learn_for(self, generator: LayerGenerator) -> LayerProposals:
        """Name the generator that is drawn with while the network learns.

        Raises:
            ValueError: one of other sizes.
        """
        if generator.config != self.config.generator:
            raise ValueError("generator: is not the one that these proposals are for")
        self._generator = (generator.eval().requires_grad_(False),)
        return self

    def forward(self, scenes: Tensor, goals: Tensor, left: int) -> tuple[Tensor, Tensor]:
        """Mean and log deviation `[N, L]` of the next of `left` subgoals.

        Args:
            scenes: states `[N, X]`.
            goals: states `[N, X]`.
            left: subgoals that are left, from 1 to `most`.
        """
        hot = scenes.new_zeros(len(scenes), self.config.most)
        hot[:, left - 1] = 1.0
        seen = torch.cat([self.normal(scenes), self.normal(self.seen_from(scenes, goals)), hot], 1)
        mean, log_std = self.network(seen).chunk(2, dim=1)
        low, high = _LOG_STD
        return mean, low + (high - low) * torch.sigmoid(log_std)

    def chain(
        self, generator: LayerGenerator, scenes: Tensor, goals: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Latents that are proposed one after the other, and their log deviations.

        Args:
            generator: draws each, which is the scene of the next.
            scenes: states `[N, X]`.
            goals: states `[N, X]`.
            noise: `[N, K, L]`, standard normal for draws, zeros for the means.

        Returns:
            `[N, K, L]`, twice.
        """
        latents, spreads = [], []
        for k in range(noise.shape[1]):
            mean, log_std = self(scenes, goals, noise.shape[1] - k)
            latents.append(mean + log_std.exp() * noise[:, k])
            spreads.append(log_std)
            scenes = generator.decode(latents[-1], scenes)
        return torch.stack(latents, dim=1), torch.stack(spreads, dim=1)

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """:meth:`hindsight` of a batch with `latents`, else of the best that is proposed."""
        if "latents" in batch:
            return self.hindsight(batch["path"], batch["latents"])
        path = batch["path"]
        shape = (
            len(path),
            self.config.draws,
            int(batch["count"]),
            self.config.generator.latent_dim,
        )
        noise = torch.randn(shape, generator=generator, device=path.device)
        with torch.no_grad():
            passed, latents, costs = self.best(path[:, 0], path[:, -1], noise)
        loss, pieces = self.hindsight(passed, latents)
        return loss, {**pieces, "best": costs.median()}

    def hindsight(self, path: Tensor, latents: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Negative log-likelihood of recorded subgoals, nats a subgoal.

        Args:
            path: states `[N, K + 2, X]`: start, subgoals, goal.
            latents: of the subgoals, each after the state before it, `[N, K, L]`.
        """
        count, each = latents.shape[1], []
        for k in range(count):
            mean, log_std = self(path[:, k], path[:, -1], count - k)
            apart = (latents[:, k] - mean) / log_std.exp()
            each.append((0.5 * apart.square() + log_std).sum(dim=1).mean())
        loss = torch.stack(each).mean() + 0.5 * latents.shape[2] * math.log(2 * math.pi)
        return loss, {"nats": loss.detach()}

    def best(self, scenes: Tensor, goals: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The best draws, by their hardest segment (`HVF(segment_cost="likelihood")`).

        Args:
            scenes: states `[N, X]`.
            goals: states `[N, X]`.
            noise: of all draws, `[N, D, K, L]`, as for :meth:`chain`.

        Returns:
            Of the `E` best of each: states from start to goal `[N * E, K + 2, X]`, latents
            `[N * E, K, L]`, costs `[N * E]`, nats.
        """
        count, draws = noise.shape[:2]
        starts, ends = (each.repeat_interleave(draws, dim=0) for each in (scenes, goals))
        path, latents = self._drawn(starts, ends, noise.flatten(0, 1))
        costs = self.costs(path)
        order = costs.reshape(count, draws).argsort(dim=1)[:, : self.config.elites]
        chosen = (order + draws * torch.arange(count, device=order.device)[:, None]).flatten()
        return path[chosen], latents[chosen], costs[chosen]

    def costs(self, path: Tensor) -> Tensor:
        """Cost of the hardest segment, nats `[N]`, along states `path [N, K + 2, X]`."""
        (drawn_by,) = self._generator
        last = self.seen_from(path[:, 0], path[:, -1])
        ends = [*path[:, 1:-1].unbind(dim=1), last]
        each = [drawn_by.surprise(end, path[:, k]) for k, end in enumerate(ends)]
        return torch.stack(each).amax(dim=0)

    def _drawn(self, scenes: Tensor, goals: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """States from start to goal `[N, K + 2, X]`, and latents `[N, K, L]`."""
        (drawn_by,) = self._generator
        latents, _ = self.chain(drawn_by, scenes, goals, noise)
        path = [scenes]
        for each in latents.unbind(dim=1):
            path.append(drawn_by.decode(each, path[-1]))
        return torch.stack([*path, goals], dim=1), latents
