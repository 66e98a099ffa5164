"""Models of images as agents want them: subgoals for any world that observes images."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.models.frames import to_frames, to_unit
from hvf.models.tap import TAP
from hvf.models.vae import CVAE
from hvf.threads import one_thread


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


class ImageProposer:
    """Subgoals proposed by time-agnostic prediction (`hvf.protocols.Proposer`).

    One is the image between start and goal; of several, each one is the image between the start
    and the one after it: ``m = TAP(s, g)``, and for two ``[TAP(s, m), m]`` as in the paper, and so
    on, which the paper does not do.
    """

    def __init__(self, tap: TAP) -> None:
        self.tap = tap.eval()
        self._device = next(tap.parameters()).device

    def propose(
        self, start: NDArray[np.uint8], goal: NDArray[np.uint8], count: int
    ) -> NDArray[np.uint8]:
        """Images uint8 `[count, H, W, 3]` between `start` and `goal [H, W, 3]`, in order.

        Raises:
            ValueError: images of another size than the model's.
        """
        with one_thread():
            first, later = (
                to_unit(torch.from_numpy(np.ascontiguousarray(image))[None].to(self._device))
                for image in (start, goal)
            )
            found = []
            for _ in range(count):
                image = to_frames(self.tap(first, later))
                found.append(image[0].cpu().numpy())
                later = to_unit(image)
        return np.stack(found[::-1]) if found else start[None][:0]


def proposer_of(tap: TAP) -> ImageProposer:
    """What a trained TAP is good for."""
    return ImageProposer(tap)


def subgoals_of(cvae: CVAE, world: object) -> ImageSubgoals:
    """Subgoals drawn by a trained CVAE or VAE, in any world."""
    return ImageSubgoals(cvae)
