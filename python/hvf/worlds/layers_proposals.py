"""The layers generator with a network that proposes where to search (`hvf.protocols.Proposing`)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import hvf_core
from hvf.models.layers.proposals import LayerProposals
from hvf.threads import one_thread
from hvf.worlds.layers_subgoals import StateSubgoals


class ProposedSubgoals(StateSubgoals):
    """Subgoals drawn by the generator of states, and proposals of them.

    Args:
        subgoals: what draws them.
        network: the trained proposals.

    Raises:
        ValueError: proposals for a generator of other sizes.
    """

    def __init__(self, subgoals: StateSubgoals, network: LayerProposals) -> None:
        super().__init__(subgoals.generator, subgoals.world)
        if network.config.generator != self.generator.config:
            raise ValueError("method_model: these proposals are for another generator")
        self.network = network.eval().requires_grad_(False)

    def proposals(
        self, start: hvf_core.LayerFrames, goal: hvf_core.LayerFrames, subgoals: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Means and standard deviations float32 `[K, L]`: each given the means before it.

        Raises:
            ValueError: more subgoals than the network proposes.
        """
        with one_thread():
            noise = torch.zeros(1, subgoals, self.latent_dim)
            means, log_std = self._chain(start, goal, noise)
        return means[0].numpy(), log_std[0].exp().numpy()

    def draws(
        self,
        start: hvf_core.LayerFrames,
        goal: hvf_core.LayerFrames,
        subgoals: int,
        count: int,
        seed: int,
    ) -> NDArray[np.float32]:
        """Latents float32 `[M, K, L]`: the means, then draws, each given those before it.

        Raises:
            ValueError: more subgoals than the network proposes.
        """
        rng = np.random.default_rng(seed)
        noise = rng.standard_normal((count, subgoals, self.latent_dim), np.float32)
        noise[0] = 0.0
        with one_thread():
            latents: NDArray[np.float32] = self._chain(start, goal, torch.from_numpy(noise))[
                0
            ].numpy()
        return latents

    def _chain(
        self, start: hvf_core.LayerFrames, goal: hvf_core.LayerFrames, noise: Tensor
    ) -> tuple[Tensor, Tensor]:
        most = self.network.config.most
        if not 1 <= noise.shape[1] <= most:
            raise ValueError(f"subgoals: must be from 1 to {most}, got {noise.shape[1]}")
        begin, end = torch.from_numpy(start.states), torch.from_numpy(goal.states)
        # What is seen of the goal may mean several states; the likeliest is aimed at.
        meanings = self._meanings(begin[0], end[0])
        surprise = self.generator.surprise(meanings, begin.expand(len(meanings), -1))
        aim = meanings[surprise.argmin()]
        scenes, goals = (each.reshape(1, -1).expand(len(noise), -1) for each in (begin, aim))
        return self.network.chain(self.generator, scenes, goals, noise)


class LayerProposer:
    """Trained proposals, before it is known which generator draws (`hvf.protocols.Proposals`)."""

    def __init__(self, network: LayerProposals) -> None:
        self.network = network

    def of(self, generator: object) -> ProposedSubgoals:
        """The generator with its proposals.

        Raises:
            ValueError: another kind of generator, or one of other sizes.
        """
        if not isinstance(generator, StateSubgoals):
            kind = type(generator).__name__
            raise ValueError(f"method_model: layers-proposals is for layers-generator, got {kind}")
        return ProposedSubgoals(generator, self.network)


def proposals_of(network: LayerProposals) -> LayerProposer:
    """What trained proposals are good for."""
    return LayerProposer(network)
