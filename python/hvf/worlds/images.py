"""Generators of images as the planner wants them: subgoals for any world that observes images."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.models.frames import to_frames, to_unit
from hvf.models.vae import CVAE
from hvf.worlds.threads import one_thread


class Seen(Protocol):
    """Frames of a world that keeps the images they come from."""

    @property
    def images(self) -> NDArray[np.uint8]:
        """Images uint8 `[N, H, W, 3]`."""
        ...


class ImageSubgoals:
    """Subgoal images drawn by the paper's CVAE or VAE (`hvf.protocols.SubgoalModel`).

    Goes with any world that can `observe` images, or whose frames are images.
    """

    def __init__(self, cvae: CVAE) -> None:
        self.cvae = cvae.eval()
        self._device = next(cvae.parameters()).device

    @property
    def latent_dim(self) -> int:
        """Latent dimensions of one image."""
        return self.cvae.config.latent_dim

    def decode(
        self, scene: Seen | NDArray[np.uint8], latents: NDArray[np.float32]
    ) -> NDArray[np.uint8]:
        """Images uint8 `[M * K, H, W, 3]` for `latents [M, K, L]` in the scene of `scene [1]`."""
        count = latents.shape[0] * latents.shape[1]
        seen = np.asarray(getattr(scene, "images", scene))
        with one_thread():
            flat = torch.from_numpy(np.ascontiguousarray(latents).reshape(count, -1))
            conditional = self.cvae.config.conditional
            start = to_unit(torch.from_numpy(seen).to(self._device)) if conditional else None
            images = self.cvae.decode(flat.to(self._device), start)
        return to_frames(images).cpu().numpy()


def subgoals_of(cvae: CVAE, world: object) -> ImageSubgoals:
    """Subgoals drawn by a trained CVAE or VAE, in any world."""
    return ImageSubgoals(cvae)
