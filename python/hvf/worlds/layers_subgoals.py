"""Subgoals drawn as states by a generator, and as images by the layers model."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

import hvf_core
from hvf.models.layers.generator import LayerGenerator
from hvf.threads import one_thread
from hvf.worlds.layers import LayerWorld


class StateSubgoals:
    """Subgoals drawn by the generator of states (`hvf.protocols.SubgoalModel`).

    Args:
        generator: the trained generator.
        world: the world whose frames it draws.

    Raises:
        ValueError: a generator of states of another length than the world's.
    """

    def __init__(self, generator: LayerGenerator, world: LayerWorld) -> None:
        expected = world.dynamics.config.perception.state_size
        found = generator.config.state_size
        if expected != found:
            raise ValueError(f"generator: draws states of length {found}, the world's: {expected}")
        self.generator = generator.eval()
        self.world = world

    @property
    def latent_dim(self) -> int:
        """Latent dimensions of one image."""
        return self.generator.config.latent_dim

    def decode(
        self, scene: hvf_core.LayerFrames, latents: NDArray[np.float32]
    ) -> hvf_core.LayerFrames:
        """Frames `[M * K]` for `latents [M, K, L]` in the scene of `scene [1]`, sample-major.

        Each of the `K` subgoals of a sample is drawn given the one before it, the first given the
        scene: the generator knows what a few seconds of play change, and `K` times that is more.
        """
        with one_thread():
            now = torch.from_numpy(scene.states).expand(len(latents), -1)
            path = []
            for drawn in torch.from_numpy(np.ascontiguousarray(latents)).unbind(dim=1):
                now = self.generator.decode(drawn, now)
                path.append(now)
            states = torch.stack(path, dim=1).flatten(0, 1)
        return self.world.changed(scene, states.numpy())


def subgoals_of(generator: LayerGenerator, world: object) -> StateSubgoals:
    """Subgoals drawn by a trained generator in a world of layers.

    Raises:
        ValueError: another kind of world, or states of another length.
    """
    if not isinstance(world, LayerWorld):
        kind = type(world).__name__
        raise ValueError(f"generator: layers-generator needs layers dynamics, got {kind}")
    return StateSubgoals(generator, world)
