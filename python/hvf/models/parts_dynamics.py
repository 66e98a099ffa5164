"""Compact dynamics of a scene of parts and a hand, and images that are linear in features of both.

The state of a frame is short: how much is seen of each coloured part, and where (`parts`), and the
position of the hand (`hand`). One step of the dynamics (`PartsCell`) looks, for each part, at this
part and the hand alone: what is pushed is near the hand, and parts far away cannot matter. A small
memory, carried along, keeps what is hidden for the moment.

A predicted frame is the start frame and what changed:

    frame_h = frame_0 + B (features(state_h) - features(state_0))

with features of one part or the hand each (`Drawing`) and a matrix `B` of images. The squared pixel
distance to a goal is therefore a quadratic form of features, by the Gram matrix of `B`: planning
never draws a frame. (Frames are not clamped to [0, 1] in this, nor in `draw`.)

Letters in shapes: `N` frames, `S` image size, `P` parts, `A` action dimensions, `H` steps, `C`
length of the memory, `F` features, `X` = 3P + A length of a state: mass, row and column (pixels) of
each part, then the hand in units of a full action.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.hand import Hand, HandConfig
from hvf.models.parts import Parts, PartsConfig


@dataclass(frozen=True)
class PartsDynamicsConfig:
    """Sizes and loss weights.

    Attributes:
        parts: how parts are found.
        hand: the hand's perception.
        hidden: width of the cell's two hidden layers, for each part.
        memory: numbers carried along for each part, `C`.
        part_features: features of each part in the drawing.
        hand_features: features of the hand in the drawing.
        waves: each position is also seen as sines and cosines of this many wavelengths.
        patch: pixels on each side of the patches that images are built of.
        patch_rank: images of one patch; an image is a sum of these.
        outlier_weight: weight of the squared error, in pixels, beside the linear one.
        hand_weight: pixels that an error of one full action counts as.
    """

    parts: PartsConfig = field(default_factory=PartsConfig)
    hand: HandConfig = field(default_factory=HandConfig)
    hidden: int = 64
    memory: int = 6
    part_features: int = 96
    hand_features: int = 192
    waves: int = 4
    patch: int = 8
    patch_rank: int = 32
    outlier_weight: float = 0.1
    hand_weight: float = 10.0

    def __post_init__(self) -> None:
        if self.parts.image_size != self.hand.image_size:
            raise ValueError(
                f"hand: images of {self.hand.image_size} pixels, parts of {self.parts.image_size}"
            )
        for name in ("hidden", "part_features", "hand_features", "patch", "patch_rank"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.parts.image_size % self.patch:
            raise ValueError(f"patch must divide {self.parts.image_size}, got {self.patch}")
        for name in ("memory", "waves", "outlier_weight", "hand_weight"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")

    @property
    def state_size(self) -> int:
        """Length of a state, `X`."""
        return 3 * self.parts.parts + self.hand.action_dim

    @property
    def features(self) -> int:
        """Features of a frame, `F`."""
        return self.parts.parts * self.part_features + self.hand_features


class Each(nn.Module):
    """A linear layer for each part, `[P, N, in]` to `[P, N, out]`."""

    def __init__(self, parts: int, inputs: int, outputs: int, gain: float = 2.0**0.5) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(parts, inputs, outputs) * gain / inputs**0.5)
        self.bias = nn.Parameter(torch.zeros(parts, 1, outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layer of each part to its inputs."""
        return torch.baddbmm(self.bias, x, self.weight)


class PartsCell(nn.Module):
    """One step: the hand first, then each part beside the hand before and after."""

    def __init__(self, config: PartsDynamicsConfig) -> None:
        super().__init__()
        self.config = config
        actions, parts, hidden = config.hand.action_dim, config.parts.parts, config.hidden
        self.hand = nn.Sequential(
            nn.Linear(2 * actions, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU()
        )
        self.hand_out = nn.Linear(hidden, actions)
        self.first = Each(parts, 3 + config.memory + 3 * actions, hidden)
        self.second = Each(parts, hidden, hidden)
        self.last = Each(parts, hidden, 3 + config.memory, 0.1)

    def forward(
        self, parts: Tensor, memory: Tensor, hand: Tensor, actions: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Normalised parts `[P, N, 3]`, memory `[P, N, C]` and hand `[N, A]` one action later."""
        moved = hand + self.hand_out(self.hand(torch.cat([hand, actions], dim=1)))
        near = torch.cat([hand, moved - hand, actions], dim=1)
        seen = torch.cat([parts, memory, near.expand(len(parts), -1, -1)], dim=2)
        change = self.last(F.relu(self.second(F.relu(self.first(seen)))))
        return parts + change[..., :3], memory + change[..., 3:], moved


class Drawing(nn.Module):
    """Features of a state, and the images that they stand for."""

    def __init__(self, config: PartsDynamicsConfig) -> None:
        super().__init__()
        self.config = config
        parts, actions = config.parts.parts, config.hand.action_dim
        waves = 2 * config.waves
        self.part_first = Each(parts, 3 + 2 * waves + actions, config.part_features)
        self.part_last = Each(parts, config.part_features, config.part_features)
        self.hand_first = nn.Linear(actions * (1 + waves), config.hand_features)
        self.hand_last = nn.Linear(config.hand_features, config.hand_features)
        cells = (config.parts.image_size // config.patch) ** 2
        self.patches = nn.Linear(config.features, cells * config.patch_rank, bias=False)
        nn.init.normal_(self.patches.weight, std=0.02 / config.features**0.5)
        self.patch = nn.Parameter(torch.randn(config.patch_rank, 3 * config.patch**2) * 0.1)

    def features(self, parts: Tensor, hand: Tensor) -> Tensor:
        """Features `[N, F]` of normalised parts `[P, N, 3]` and hand `[N, A]`."""
        places = self._waves(parts[..., 1:])
        seen = torch.cat([parts, places, hand.expand(len(parts), -1, -1)], dim=2)
        of_parts = F.relu(self.part_last(F.relu(self.part_first(seen))))
        seen = torch.cat([hand, self._waves(hand)], dim=1)
        of_hand = F.relu(self.hand_last(F.relu(self.hand_first(seen))))
        return torch.cat([of_parts.transpose(0, 1).flatten(1), of_hand], dim=1)

    def images(self, features: Tensor) -> Tensor:
        """Images `[N, 3, S, S]` that `features [N, F]` stand for: a linear map, `B`."""
        size, patch = self.config.parts.image_size, self.config.patch
        side = size // patch
        codes: Tensor = self.patches(features).reshape(-1, side * side, self.config.patch_rank)
        cells = (codes @ self.patch).reshape(-1, side, side, 3, patch, patch)
        images: Tensor = cells.permute(0, 3, 1, 4, 2, 5).reshape(-1, 3, size, size)
        return images

    def _waves(self, places: Tensor) -> Tensor:
        """Sines and cosines of normalised places `[..., 2]`, side by side."""
        scales = 2.0 ** torch.arange(self.config.waves, device=places.device)
        phases = (places[..., None] * scales).flatten(-2)
        return torch.cat([phases.sin(), phases.cos()], dim=-1)


class PartsDynamics(nn.Module):
    """Perception, cell and drawing; see the module's documentation."""

    config_type: ClassVar[type[PartsDynamicsConfig]] = PartsDynamicsConfig
    state_mean: Tensor
    state_scale: Tensor

    def __init__(self, config: PartsDynamicsConfig) -> None:
        super().__init__()
        self.config = config
        self.parts = Parts(config.parts)
        self.hand = Hand(config.hand)
        self.register_buffer("state_mean", torch.zeros(config.state_size))
        self.register_buffer("state_scale", torch.ones(config.state_size))
        self.cell = PartsCell(config)
        self.drawing = Drawing(config)

    def freeze_perception(self, parts: Parts, hand: Hand) -> PartsDynamics:
        """Take over a trained perception and keep it as it is."""
        self.parts.load_state_dict(parts.state_dict())
        self.hand.load_state_dict(hand.state_dict())
        self.hand.requires_grad_(False)
        return self

    def fit_states(self, states: Tensor) -> PartsDynamics:
        """Note mean and spread of `states [N, X]`; the networks see normalised states."""
        self.state_mean.copy_(states.double().mean(dim=0))
        self.state_scale.copy_(states.double().std(dim=0).clamp_min(1e-3))
        return self

    def observe(self, frames: Tensor) -> Tensor:
        """States `[N, X]` of uint8 `frames [N, S, S, 3]`."""
        return torch.cat([self.parts(frames).flatten(1), self.hand(frames)], dim=1)

    def features(self, states: Tensor) -> Tensor:
        """Features `[N, F]` of `states [N, X]`."""
        return self.drawing.features(*self._split((states - self.state_mean) / self.state_scale))

    def draw(self, images: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """Frames `[N, 3, S, S]` after states went from `before` to `after` `[N, X]`.

        Not clamped.

        Args:
            images: the frames before, `[N, 3, S, S]` in [0, 1].
            before: their states.
            after: states of the frames to draw.
        """
        return images + self.drawing.images(self.features(after) - self.features(before))

    def gram(self) -> Tensor:
        """Inner products `[F, F]` of the images of the features, summed over pixels and colours."""
        config = self.config
        side = config.parts.image_size // config.patch
        codes = self.drawing.patches.weight.reshape(side * side, config.patch_rank, -1)
        seen = torch.einsum("crf,rs->cfs", codes, _root(self.drawing.patch))
        flat = seen.permute(1, 0, 2).flatten(1)
        gram: Tensor = flat @ flat.T
        return gram

    def correlations(self, images: Tensor) -> Tensor:
        """Inner products `[N, F]` of `images [N, 3, S, S]` with the images of the features."""
        config = self.config
        side, patch = config.parts.image_size // config.patch, config.patch
        cells = images.reshape(-1, 3, side, patch, side, patch).permute(0, 2, 4, 1, 3, 5)
        codes = cells.reshape(len(images), side * side, -1) @ self.drawing.patch.T
        found: Tensor = codes.flatten(1) @ self.drawing.patches.weight
        return found

    def rollout(self, states: Tensor, actions: Tensor, last: bool = False) -> Tensor:
        """States after each of `actions [N, H, A]`, from `states [N, X]`: `[N, H, X]`.

        Args:
            states: where to start.
            actions: in [-1, 1].
            last: only the last state, `[N, 1, X]`.
        """
        parts, hand = self._split((states - self.state_mean) / self.state_scale)
        memory = parts.new_zeros(len(parts), parts.shape[1], self.config.memory)
        path = []
        for h in range(actions.shape[1]):
            parts, memory, hand = self.cell(parts, memory, hand, actions[:, h])
            if not last or h == actions.shape[1] - 1:
                path.append(torch.cat([parts.transpose(0, 1).flatten(1), hand], dim=1))
        return torch.stack(path, dim=1) * self.state_scale + self.state_mean

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Errors of predicted states, in pixels, and of drawn frames.

        The batch holds `states [N, H+1, X]` with `actions [N, H, A]`, and pairs of frames of one
        episode: `images` uint8 `[M, 2, S, S, 3]` with `pairs [M, 2, X]`, their states.
        """
        states = batch["states"]
        path = self.rollout(states[:, 0], batch["actions"])
        cell, parts = self._missed(path, states[:, 1:])
        images = batch["images"].permute(0, 1, 4, 2, 3).float() / 255
        drawn = self.draw(images[:, 0], batch["pairs"][:, 0], batch["pairs"][:, 1])
        missed = (drawn - images[:, 1]).square().sum(dim=(1, 2, 3)).mean()
        parts |= {"drawing": missed.detach()}
        # Cell and drawing share no weights: Adam gives each its own pace, whatever the scale.
        return cell + 0.1 * missed, parts

    def _missed(self, path: Tensor, truth: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        count = 3 * self.config.parts.parts
        # `[N, H, P, 3]`: mass counts as a length of five pixels; places only where there is mass.
        parts = (path - truth)[..., :count].reshape(*path.shape[:2], -1, 3)
        seen = truth[..., 0:count:3].clamp(0, 1)
        place = parts[..., 1:].square().sum(dim=3)
        linear = seen * ((place + 1e-2).sqrt() - 0.1) + 5.0 * parts[..., 0].abs()
        hand = self.config.hand_weight * (path[..., count:] - truth[..., count:])
        hand_error = (hand.square().sum(dim=2) + 1e-2).sqrt().mean()
        squared = (seen * place.clamp_max(400.0)).mean()
        loss = linear.mean() + self.config.outlier_weight * squared + hand_error
        found = {"parts": linear.mean(), "squared": squared, "hand": hand_error}
        return loss, {name: value.detach() for name, value in found.items()}

    def _split(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Parts `[P, N, 3]` and hand `[N, A]` of `states [N, X]`."""
        count = 3 * self.config.parts.parts
        return states[:, :count].reshape(len(states), -1, 3).transpose(0, 1), states[:, count:]


def _root(patch: Tensor) -> Tensor:
    """`[R, R]` whose rows have the inner products of the rows of `patch [R, ...]`."""
    values, vectors = torch.linalg.eigh(patch @ patch.T)
    root: Tensor = vectors * values.clamp_min(0).sqrt()
    return root
