"""A trained policy as agents want it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.models.rig import RIG
from hvf.threads import one_thread


class LatentPolicy:
    """Acts by RIG: the policy at the latents of what is seen and of the goal image.

    A `hvf.protocols.Policy`.
    """

    def __init__(self, rig: RIG) -> None:
        self.rig = rig.eval()
        self._device = next(rig.parameters()).device

    def act(self, observation: NDArray[np.uint8], goal: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The action float32 `[A]` for images uint8 `[H, W, 3]`.

        Raises:
            ValueError: images of another size than the model's.
        """
        height, width = self.rig.config.vae.image_size
        for name, image in (("observation", observation), ("goal", goal)):
            if image.shape != (height, width, 3):
                raise ValueError(
                    f"{name}: expected shape [{height}, {width}, 3], got {list(image.shape)}"
                )
        with one_thread():
            both = torch.from_numpy(np.stack([observation, goal])).to(self._device)
            latents = self.rig.latents(both)
            chosen = self.rig.in_the_box(self.rig.act(latents[:1], latents[1:]))
        action: NDArray[np.float32] = chosen[0].cpu().numpy()
        return action


def policy_of(rig: RIG) -> LatentPolicy:
    """What a trained RIG is good for."""
    return LatentPolicy(rig)
