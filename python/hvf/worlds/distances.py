"""Other planning costs than pixels: distances between images that a learned model measures.

The distance is a torch model that is asked once for all candidates of a problem. It goes with any
world that draws what it predicts, and is slower by three orders of magnitude than the pixel cost,
which the keypoint world has a closed form of. Distances in steps (:mod:`hvf.worlds.steps`) need
nothing drawn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hvf.models.frames import to_unit
from hvf.models.tdm import TDM
from hvf.models.vae import CVAE
from hvf.protocols import Remembering, WorldModel
from hvf.settings import OverHorizon, Planning
from hvf.threads import one_thread
from hvf.worlds.world import Measured

# Images that are drawn and measured together: what the networks make of them stays in the caches.
_AT_ONCE = 64


class ImageDistance(Protocol):
    """How far predicted images are from a goal."""

    @property
    def device(self) -> torch.device:
        """Where it wants its images."""
        ...

    def __call__(self, images: Tensor, goal: Tensor, start: Tensor) -> Tensor:
        """Distances ``[N]`` of ``images [N, 3, H, W]`` to ``goal``, one or one for each.

        ``start [1, 3, H, W]`` is what they were predicted from. All are in [0, 1].
        """
        ...


class LatentDistance:
    """Squared distance between latents of a VAE or CVAE (means of the posterior).

    A conditional one encodes in the scene of the start.
    """

    def __init__(self, cvae: CVAE) -> None:
        self.cvae = cvae.eval()
        self.device = next(cvae.parameters()).device

    def __call__(self, images: Tensor, goal: Tensor, start: Tensor) -> Tensor:
        """Distances; see :class:`ImageDistance`."""
        return (self._encode(images, start) - self._encode(goal, start)).square().sum(dim=1)

    def _encode(self, images: Tensor, scene: Tensor) -> Tensor:
        """Means of the posterior, `[N, L]`."""
        return self.cvae.encode(images, scene if self.cvae.config.conditional else None)[0]


class FarDistance:
    """How likely the paper's temporal distance takes an image and the goal to be far apart."""

    def __init__(self, tdm: TDM) -> None:
        self.tdm = tdm.eval()
        self.device = next(tdm.parameters()).device

    def __call__(self, images: Tensor, goal: Tensor, start: Tensor) -> Tensor:
        """Distances; see :class:`ImageDistance`."""
        far: Tensor = self.tdm(images, goal.expand(len(images), -1, -1, -1))
        return far


class ImageDistanceWorld(Measured):
    """Any world that draws what it predicts, with a distance between images as its cost.

    Args:
        world: has ``observe(images)``, frames with ``images``, and ``predict(frames[N],
            actions[N, H, A])`` that gives uint8 ``[N, H, S, S, 3]``, and takes ``seeds [N]``, too,
            if it ``uses_seeds``; or, in its place, ``rollout(frames[B], actions[B, D, H, A])`` and
            ``drawn(frames[B], path[B, D, H, ...])``, which gives float ``[B, D, H, 3, S, S]`` of
            what the first gives.
        distance: of predicted images to the goal.
        over_horizon: whether the last predicted frame counts, their sum, or their minimum.
    """

    def __init__(self, world: Any, distance: ImageDistance, over_horizon: OverHorizon) -> None:
        super().__init__(world, over_horizon)
        self.distance = distance

    @property
    def uses_seeds(self) -> bool:
        """Whether candidates have noise of their own: whether they do in the world inside."""
        return bool(getattr(self.world, "uses_seeds", False))

    def rollout_costs(
        self,
        starts: Any,
        goals: Any,
        actions: NDArray[np.float32],
        seeds: NDArray[np.int64] | None = None,
    ) -> NDArray[np.float32]:
        """Planning costs float32 `[B, D]` of `actions [B, D, H, A]`, with `seeds [B, D]`."""
        count, candidates = actions.shape[:2]
        costs = np.empty((count, candidates), np.float32)
        for b in range(count):
            one = np.array([b])
            start, goal = (self._unit(frames[one].images) for frames in (starts, goals))
            noise = {} if seeds is None else {"seeds": seeds[b]}
            with one_thread():
                parts = [
                    self.distance(part, goal, start)
                    for part in self._predicted(starts[one], actions[b], noise)
                ]
                apart = torch.cat(parts).reshape(candidates, -1)
                total = apart.amin(dim=1) if self.over_horizon == "min" else apart.sum(dim=1)
            costs[b] = total.cpu().numpy()
        return costs

    def _predicted(
        self, start: Any, actions: NDArray[np.float32], noise: Mapping[str, NDArray[np.int64]]
    ) -> Iterator[Tensor]:
        """Images that count, float ``[n, 3, H, W]``, some at a time.

        Of ``actions [D, H, A]`` from ``start [1]``, candidate by candidate.
        """
        last = self.over_horizon == "last"
        if hasattr(self.world, "drawn"):
            path = self.world.rollout(start, actions[None])
            path = path[:, :, -1:] if last else path
            some = max(1, _AT_ONCE // path.shape[2])
            for first in range(0, len(actions), some):
                drawn: Tensor = self.world.drawn(start, path[:, first : first + some])
                yield drawn.flatten(0, 2).clamp(0, 1).to(self.distance.device)
            return
        seen = self.world.predict(start[np.zeros(len(actions), np.int64)], actions, **noise)
        seen = torch.from_numpy(np.ascontiguousarray(seen[:, -1:] if last else seen))
        for few in torch.split(seen.flatten(0, 1), _AT_ONCE):
            yield to_unit(few.to(self.distance.device))

    def _unit(self, images: NDArray[np.uint8]) -> Tensor:
        return to_unit(torch.from_numpy(np.ascontiguousarray(images)).to(self.distance.device))


class RememberingDistanceWorld(ImageDistanceWorld):
    """The same around a world with context (:class:`~hvf.protocols.Remembering`)."""

    @property
    def context(self) -> int:
        """Frames that the world inside wants."""
        context: int = self.world.context
        return context

    def observe_history(self, images: NDArray[np.uint8], actions: NDArray[np.float32]) -> Any:
        """Frames to start from, `[N]`, as the world inside makes them."""
        return self.world.observe_history(images, actions)


class JudgedImages:
    """Subgoals of any generator, whose segments cost a distance between images.

    A generator that judges (`hvf.protocols.Judging`).

    Args:
        subgoals: draws images, or frames that have them.
        distance: from the first image of a segment to its last.
    """

    def __init__(self, subgoals: Any, distance: ImageDistance) -> None:
        self.subgoals = subgoals
        self.distance = distance

    @property
    def latent_dim(self) -> int:
        """Latent dimensions of one image."""
        latent_dim: int = self.subgoals.latent_dim
        return latent_dim

    def decode(self, scene: Any, latents: NDArray[np.float32]) -> Any:
        """What the generator draws for `latents [M, K, L]` in the scene of `scene [1]`."""
        return self.subgoals.decode(scene, latents)

    def segment_costs(
        self, start: Any, goal: Any, latents: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """What each segment costs, float32 `[M, K + 1]`, for `latents [M, K, L]`.

        `M (K + 1)` pairs of images are measured, so this grows with their size as the model does.
        """
        count, subgoals, _ = latents.shape
        with one_thread():
            first, last = (self._images(frames) for frames in (start, goal))
            drawn = self._images(self.decode(start, latents))
            each = drawn.reshape(count, subgoals, *drawn.shape[1:]).unbind(dim=1)
            path = [first.expand(count, -1, -1, -1), *each]
            ends = [*path[1:], last.expand(count, -1, -1, -1)]
            costs = [self._apart(*pair, first) for pair in zip(path, ends, strict=True)]
        segments: NDArray[np.float32] = torch.stack(costs, dim=1).cpu().numpy()
        return segments

    def _apart(self, before: Tensor, after: Tensor, start: Tensor) -> Tensor:
        """Distances `[M]` between images `[M, 3, H, W]`."""
        pairs = zip(*(torch.split(each, _AT_ONCE) for each in (before, after)), strict=True)
        return torch.cat([self.distance(one, other, start) for one, other in pairs])

    def _images(self, frames: Any) -> Tensor:
        images = np.ascontiguousarray(getattr(frames, "images", frames))
        return to_unit(torch.from_numpy(images).to(self.distance.device))


def tdm_judged(model: TDM, subgoals: Any) -> JudgedImages:
    """Subgoals whose segments cost the paper's temporal distance.

    It was made to tell images a few steps apart from others, so that of long segments it says of
    all that they are long.
    """
    return JudgedImages(subgoals, FarDistance(model))


def latent_world(world: Any, model: Any, planning: Planning) -> WorldModel[Any]:
    """A world whose cost is distance in the latent of a VAE or CVAE.

    Raises:
        ValueError: a world that does not draw what it predicts, or a model that is no VAE.
    """
    if not isinstance(model, CVAE):
        raise ValueError(f"cost: 'latent' needs a cvae or vae, got {type(model).__name__}")
    return _measured("latent", world, LatentDistance(model), planning)


def tdm_world(world: Any, model: Any, planning: Planning) -> WorldModel[Any]:
    """A world whose cost is the paper's temporal distance.

    Raises:
        ValueError: a world that does not draw what it predicts, or another model.
    """
    if not isinstance(model, TDM):
        raise ValueError(f"cost: 'tdm' needs a tdm model, got {type(model).__name__}")
    return _measured("tdm", world, FarDistance(model), planning)


def tdm_of(model: TDM, world: Any, planning: Planning) -> WorldModel[Any]:
    """The same, as the model's entry has it; see :func:`tdm_world`."""
    return tdm_world(world, model, planning)


def _measured(
    cost: str, world: Any, distance: ImageDistance, planning: Planning
) -> WorldModel[Any]:
    """A world with a distance between images as its cost.

    Raises:
        ValueError: a world that draws nothing.
    """
    draws = hasattr(world, "predict") or hasattr(world, "drawn")
    if not draws or not hasattr(world, "observe"):
        kind = type(world).__name__
        raise ValueError(f"cost: {cost!r} needs dynamics that draw frames, got {kind}")
    remembers = isinstance(world, Remembering)
    made = RememberingDistanceWorld if remembers else ImageDistanceWorld
    return made(world, distance, planning.over_horizon)
