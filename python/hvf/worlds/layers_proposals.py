"""The layers generator with a network that proposes where to search (`hvf.protocols.Proposing`)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

import hvf_core
from hvf.models.layers.proposals import LayerProposals
from hvf.threads import one_thread
from hvf.worlds.layers_meanings import meanings
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
        super().__init__(subgoals.generator, subgoals.world, subgoals.judge)
        if network.config.generator != self.generator.config:
            raise ValueError("method_model: these proposals are for another generator")
        self.network = network.eval().requires_grad_(False)

    def proposals(
        self, start: hvf_core.LayerFrames, goal: hvf_core.LayerFrames, subgoals: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Means and standard deviations float32 `[K, L]`: each given the means before it.

        What is seen of the goal may mean several states; the likeliest is aimed at.

        Raises:
            ValueError: more subgoals than the network proposes.
        """
        most = self.network.config.most
        if not 1 <= subgoals <= most:
            raise ValueError(f"subgoals: must be from 1 to {most}, got {subgoals}")
        with one_thread():
            scene, end = torch.from_numpy(start.states), torch.from_numpy(goal.states)
            ends = meanings(self.world.dynamics.perception, scene[0], end[0])
            surprise = self.generator.surprise(ends, scene.expand(len(ends), -1))
            aim = ends[surprise.argmin()][None]
            means = torch.zeros(1, subgoals, self.latent_dim)
            latents, log_std = self.network.chain(self.generator, scene, aim, means)
        return latents[0].numpy(), log_std[0].exp().numpy()


class UnboundProposals:
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


def proposals_of(network: LayerProposals) -> UnboundProposals:
    """What trained proposals are good for."""
    return UnboundProposals(network)
