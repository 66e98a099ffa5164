"""What is seen at the desk, in layers, and how to draw it: backdrop, parts that roam, arm.

The state of a frame is short: the hand's code, the coordinates of what slides, and for each part
that roams its row and column (pixels) and presence (0 to 1; a cube that fell behind the table is
not there any more). A predicted frame is the start frame without its arm (`Scene`), with the change
of the backdrop, with parts that moved taken away where they were and drawn where they will be, and
with the arm before it all.

Letters in shapes: `N` frames, `S` image size, `A` action dimensions, `G` sliders, `R` parts that
roam, `W` size of a sprite, `X` = A + G + 3R length of a state.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hvf.models.frames import to_unit
from hvf.models.layers.arm import Arm, ArmConfig
from hvf.models.layers.backdrop import Backdrop, BackdropConfig
from hvf.models.layers.colours import Colours, ColoursConfig
from hvf.models.layers.gallery import Gallery, GalleryConfig
from hvf.models.unfamiliar import every, warn_of_unfamiliar

# A mask above this, and what is next to it, is a part and not the backdrop.
_MASKED = 0.3
# Opacity above which, and beside which, a pixel of the start frame is taken to be the arm's.
_COVERED = 0.3
# As much of a part has to be seen for it to be there.
_PRESENT = 0.12
# A part that is seen whole.
_WHOLE = 0.8
# Pixels by which a part has to move for its image to be drawn anew.
MOVED = 0.5
# Opacity from which on a drawn part hides what is behind.
_DRAWN = 0.05
_IMAGES_AT_ONCE = 64
# Frames whose codes tell where the hand can be.
_CODES = 3000
# A colour is wrong if it differs by this much; in this part of all pixels at the bound. At the desk
# in at most 0.10, with the camera turned by two degrees from 0.11 to 0.18, by five from 0.19 on.
_WRONG, _WRONG_PART = 0.12, 0.15
# A colour is nowhere near if it differs by this much from all that is drawn within so many pixels.
# Of a square as wide as a cube is seen, in all but two pixels of 25 at the bound.
_NOWHERE, _NEAR, _SQUARE, _SQUARE_PART = 0.2, 2, 5, 0.9
# Share of the images of a call in which something has to be amiss: the arm hides it in others.
_AMISS_IN = 0.25


@dataclass(frozen=True)
class LayerPerceptionConfig:
    """Sizes.

    Attributes:
        colours: how coloured parts are found.
        backdrop: how finely the backdrop is known.
        arm: encoder of the arm.
        gallery: how finely the arm's images are known.
        roaming: parts that roam, `R`.
        sprite: pixels on each side of a part's image, odd, `W`.
    """

    colours: ColoursConfig = field(default_factory=ColoursConfig)
    backdrop: BackdropConfig = field(default_factory=BackdropConfig)
    arm: ArmConfig = field(default_factory=ArmConfig)
    gallery: GalleryConfig = field(default_factory=GalleryConfig)
    roaming: int = 3
    sprite: int = 15

    def __post_init__(self) -> None:
        if self.arm.action_dim != len(self.gallery.places):
            raise ValueError(
                f"gallery: made for {len(self.gallery.places)} action dimensions, "
                f"the arm's are {self.arm.action_dim}"
            )
        if self.roaming < 1:
            raise ValueError(f"roaming must be at least 1, got {self.roaming}")
        if self.sprite < 3 or self.sprite % 2 == 0:
            raise ValueError(f"sprite must be odd, at least 3; got {self.sprite}")

    @property
    def sliders(self) -> int:
        """Number of sliders, `G`."""
        return len(self.backdrop.bins)

    @property
    def state_size(self) -> int:
        """Length of a state, `X`."""
        return self.arm.action_dim + self.sliders + 3 * self.roaming

    @property
    def image_size(self) -> int:
        """Height and width of the images, `S`, in pixels."""
        return self.colours.image_size


@dataclass(frozen=True)
class Scene:
    """A start frame, ready to be changed.

    Attributes:
        image: the frame without its arm, `[N, 3, S, S]` in [0, 1].
        regions: where each part is in it, bool `[N, R, S, S]`.
        states: the frame's state, `[N, X]`.
    """

    image: Tensor
    regions: Tensor
    states: Tensor


@dataclass(frozen=True)
class Seen:
    """What is in frames.

    Attributes:
        states: `[N, X]`.
        mass: how much is seen of each part that roams, 1 is all of it: `[N, R]`.
        regions: where those parts are, bool `[N, R, S, S]`.
        opacity: how surely each pixel is the arm's, `[N, S, S]`.
    """

    states: Tensor
    mass: Tensor
    regions: Tensor
    opacity: Tensor


class LayerPerception(nn.Module):
    """Perception and drawing; see the module's documentation.

    Attributes:
        sprites: opacity and colour times opacity of each part, `[R, 4, W, W]`.
    """

    config_type: ClassVar[type[LayerPerceptionConfig]] = LayerPerceptionConfig
    sprites: Tensor

    def __init__(self, config: LayerPerceptionConfig) -> None:
        super().__init__()
        self.config = config
        size = config.image_size
        self.colours = Colours(config.colours)
        self.backdrop = Backdrop(config.backdrop, size)
        self.arm = Arm(config.arm, size)
        self.gallery = Gallery(config.gallery, size)
        self.register_buffer(
            "sprites", torch.zeros(config.roaming, 4, config.sprite, config.sprite)
        )

    def split(self, states: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Hand `[N, A]`, sliders `[N, G]` and parts `[N, R, 3]` of `states [N, X]`."""
        hand = self.config.arm.action_dim
        parts = states[:, hand + self.config.sliders :]
        sliders = states[:, hand : hand + self.config.sliders]
        return states[:, :hand], sliders, parts.reshape(len(states), -1, 3)

    def observe(self, frames: Tensor) -> Tensor:
        """States `[N, X]` of uint8 `frames [N, S, S, 3]`."""
        return self.look(frames)[0]

    def look(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """States `[N, X]` of uint8 `frames [N, S, S, 3]`, and the mass of parts `[N, R]`."""
        seen = [self.perceive(some) for some in torch.split(frames, _IMAGES_AT_ONCE)]
        return torch.cat([one.states for one in seen]), torch.cat([one.mass for one in seen])

    def perceive(self, frames: Tensor) -> Seen:
        """What is in uint8 `frames [N, S, S, 3]`."""
        observed, regions = self.find_parts(frames)
        sliders = self.backdrop(observed).clamp(0, 1)
        images = to_unit(frames)
        opacity = self.arm.opacity(images, self.backdrop.draw(sliders), regions.any(dim=1))
        parts = observed[:, self.colours.roaming]
        mass = parts[..., 0]
        parts = torch.cat([parts[..., 1:], (mass > _PRESENT)[..., None].to(parts.dtype)], dim=2)
        states = torch.cat([self.arm(images, opacity), sliders, parts.flatten(1)], dim=1)
        return Seen(states, mass, regions, opacity)

    def find_parts(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """What colours tell of `frames [N, S, S, 3]`: `[N, P, 3]`, and where parts roam.

        The latter is bool `[N, R, S, S]`, a pixel more than the masks on each side.
        """
        masks = self.colours.masks(frames)
        regions = _grown(masks[:, self.colours.roaming] > _MASKED)
        return self.colours(frames, masks), regions

    def scene(self, frames: Tensor) -> Scene:
        """Scenes of uint8 `frames [N, S, S, 3]`."""
        seen = self.perceive(frames)
        covered = _grown(seen.opacity[:, None] > _COVERED)
        covered &= ~seen.regions.any(dim=1, keepdim=True)
        _, sliders, parts = self.split(seen.states)
        behind = self.paste(self.backdrop.draw(sliders), parts)
        image = torch.where(covered, behind, to_unit(frames))
        return Scene(image, _grown(seen.regions), seen.states)

    def change(self, scenes: Scene, states: Tensor) -> Scene:
        """What `scenes` become at `states [N, X]`."""
        _, sliders_before, before = self.split(scenes.states)
        _, sliders, parts = self.split(states)
        backdrop = self.backdrop.draw(sliders)
        image = scenes.image + backdrop - self.backdrop.draw(sliders_before)
        moved = (parts - before)[..., :2].norm(dim=2) > MOVED
        moved |= (parts - before)[..., 2].abs() > 0.5
        moved = moved[..., None, None]
        gone = (scenes.regions & moved).any(dim=1, keepdim=True)
        image = torch.where(gone, backdrop, image)
        shown = torch.cat([parts[..., :2], parts[..., 2:] * moved[..., 0]], dim=2)
        rows, columns = self._stamps(shown)
        drawn = torch.einsum("nryi,rij,nrxj->nryx", rows, self.sprites[:, 0], columns)
        regions = torch.where(moved, drawn * shown[..., 2, None, None] > _DRAWN, scenes.regions)
        return Scene(self.paste(image, shown), regions, states)

    def draw(self, scenes: Scene, states: Tensor) -> Tensor:
        """Frames `[N, 3, S, S]` in [0, 1] of what `scenes` look like at `states [N, X]`."""
        return self.with_arm(self.change(scenes, states))

    def with_arm(self, scenes: Scene) -> Tensor:
        """Frames `[N, 3, S, S]` in [0, 1]: `scenes` with the arm before them."""
        opacity, colour = self.gallery(scenes.states[:, : self.config.arm.action_dim])
        drawn: Tensor = scenes.image * (1 - opacity) + colour
        return drawn.clamp(0, 1)

    def covered(self, states: Tensor, places: Tensor) -> Tensor:
        """How much the arm of `states [N, X]` hides around `places [N, R, 2]`: opacity `[N, R]`.

        Squares are as wide as a part is seen; what is beyond the image counts as not covered.
        """
        opacity, _ = self.gallery(states[:, : self.config.arm.action_dim])
        around = F.avg_pool2d(opacity, _SQUARE, stride=1, padding=_SQUARE // 2)[:, 0]
        rows, columns = places.round().long().clamp(0, self.config.image_size - 1).unbind(dim=2)
        covered: Tensor = around[torch.arange(len(states))[:, None], rows, columns]
        return covered

    def check(self, frames: Tensor, states: Tensor | None = None) -> None:
        """Warn once if uint8 `frames [N, S, S, 3]` look unfamiliar.

        See :mod:`hvf.models.unfamiliar` for which of them count, and why it is a warning.

        Args:
            frames: what was observed.
            states: what was seen in them, `[N, X]`, where that is known.
        """
        some = every(len(frames))
        known = None if states is None else states[some]
        slides, roams = self.config.sliders, self.config.roaming
        warn_of_unfamiliar(
            self,
            self.misfit(frames[some], known).cpu().numpy(),
            f"one still camera and light, {roams} coloured parts that roam, {slides} things that "
            "slide, and one arm, all of them as in the data that it was trained on",
            share=_AMISS_IN,
        )

    def misfit(self, frames: Tensor, states: Tensor | None = None) -> Tensor:
        """How badly uint8 `frames [N, S, S, 3]` can be drawn, `[N]`: 1 and more is unfamiliar.

        Everything is drawn anew from the state alone: backdrop, parts and arm. The larger of two
        errors, over their bounds: the part of all pixels that have another colour (another camera,
        light or table), and the largest part of a square of 5 pixels that looks like nothing that
        is drawn nearby (a thing more, or one of another colour).

        A thing more of which little is seen, or that looks like what is behind it, goes unnoticed;
        so does any that has been in all the training data: it is backdrop.

        Args:
            frames: what was observed.
            states: what was seen in them, `[N, X]`, where that is known.
        """
        found = self.observe(frames) if states is None else states
        _, sliders, parts = self.split(found)
        behind = self.paste(self.backdrop.draw(sliders), parts)
        drawn = self.with_arm(Scene(behind, behind.new_zeros(0), found))
        images = to_unit(frames)
        wrong = ((drawn - images).abs().amax(dim=1) > _WRONG).float().mean(dim=(1, 2))
        width = 2 * _NEAR + 1
        above = images - F.max_pool2d(drawn, width, 1, _NEAR)
        below = -F.max_pool2d(-drawn, width, 1, _NEAR) - images
        nowhere = (torch.maximum(above, below).amax(dim=1) > _NOWHERE).float()
        square = F.avg_pool2d(nowhere[:, None], _SQUARE, 1).amax(dim=(1, 2, 3))
        return torch.maximum(wrong / _WRONG_PART, square / _SQUARE_PART)

    def paste(self, images: Tensor, parts: Tensor) -> Tensor:
        """`images [N, 3, S, S]` with `parts [N, R, 3]` before them."""
        rows, columns = self._stamps(parts)
        for part in range(parts.shape[1]):
            drawn = torch.einsum(
                "nyi,cij,nxj->ncyx", rows[:, part], self.sprites[part], columns[:, part]
            )
            drawn = drawn * parts[:, part, 2, None, None, None]
            images = images * (1 - drawn[:, :1]) + drawn[:, 1:]
        return images

    def _stamps(self, parts: Tensor) -> tuple[Tensor, Tensor]:
        """Linear interpolation of sprites at `parts [N, R, 3]`: rows and columns `[N, R, S, W]`."""
        width = self.config.sprite
        line = torch.arange(self.config.image_size, dtype=parts.dtype, device=parts.device)
        own = torch.arange(width, dtype=parts.dtype, device=parts.device) - width // 2
        rows, columns = (
            F.relu(1 - (line[:, None] - (parts[..., axis, None, None] + own)).abs())
            for axis in (0, 1)
        )
        return rows, columns

    def fit(self, pairs: Tensor, frames: Tensor, seed: int = 0) -> LayerPerception:
        """Find everything that is not trained by gradient, but for the gallery.

        Args:
            pairs: two frames of an episode each, uint8 `[M, 2, S, S, 3]`.
            frames: frames of episodes, uint8 `[E, T, S, S, 3]`.
            seed: of the clustering's start.

        Raises:
            ValueError: other numbers of parts that roam or slide than the config says.
        """
        self.colours.fit(pairs[:, 0], pairs[:, 1], seed)
        found = len(self.colours.roaming)
        if found != self.config.roaming:
            raise ValueError(
                f"frames: {found} parts roam, expected {self.config.roaming}: this model takes a "
                "fixed number of coloured parts for granted, each of a colour of its own"
            )
        flat = frames.flatten(0, 1)
        parts = [self.find_parts(some) for some in torch.split(flat, _IMAGES_AT_ONCE)]
        observed = torch.cat([seen for seen, _ in parts])
        hidden = torch.cat([regions.any(dim=1) for _, regions in parts])
        self.backdrop.fit_sliders(
            observed.reshape(*frames.shape[:2], *observed.shape[1:]), self.colours
        )
        self.backdrop.fit_table(flat, self.backdrop(observed), hidden)
        return self.fit_sprites(flat)

    def fit_sprites(self, frames: Tensor) -> LayerPerception:
        """Take the mean image of each part that is seen whole in uint8 `frames [N, S, S, 3]`."""
        sums = torch.zeros_like(self.sprites)
        counts = sums.new_zeros(len(sums))
        for some in torch.split(frames, _IMAGES_AT_ONCE):
            observed, regions = self.find_parts(some)
            images = to_unit(some)
            backdrop = self.backdrop.draw(self.backdrop(observed).clamp(0, 1))
            for i, part in enumerate(self.colours.roaming):
                whole = observed[:, part, 0] > _WHOLE
                alone = ~(_grown(regions)[:, i] & regions[:, torch.arange(len(sums)) != i].any(1))
                whole &= alone.all(dim=2).all(dim=1)
                opacity = self.arm.opacity(images, backdrop, ~regions[:, i])
                seen = torch.cat([opacity[:, None], images * opacity[:, None]], dim=1)
                places = observed[:, i : i + 1].new_zeros(len(some), 1, 3)
                places[:, 0, :2] = observed[:, part, 1:]
                rows, columns = self._stamps(places)
                cut = torch.einsum("nyi,ncyx,nxj->ncij", rows[:, 0], seen, columns[:, 0])
                sums[i] += cut[whole].sum(dim=0)
                counts[i] += whole.sum()
        self.sprites.copy_(sums / counts.clamp_min(1)[:, None, None, None])
        return self

    def fit_gallery(self, frames: Tensor) -> LayerPerception:
        """Take images of the arm, once its encoder is trained, from uint8 `frames [N, S, S, 3]`.

        Frames are in the CPU's memory, wherever the model is.
        """
        hand = slice(0, self.config.arm.action_dim)
        each = max(1, len(frames) // _CODES)
        device = self.sprites.device

        def seen() -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
            for some in torch.split(frames, _IMAGES_AT_ONCE):
                found = self.perceive(some.to(device))
                hidden = found.regions.any(dim=1)
                yield found.states[:, hand].cpu(), found.opacity.cpu(), to_unit(some), hidden.cpu()

        # Sums of all its images take more memory than a GPU may have.
        gallery = self.gallery.cpu()
        gallery.fit_grid(self.observe(frames[::each].to(device))[:, hand].cpu()).fit(seen())
        gallery.to(device)
        return self

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The arm's loss (:meth:`Arm.loss`); nothing else is trained by gradient.

        The batch holds `frames` uint8 `[N, 2, S, S, 3]`, one step apart, and `actions [N, 1, A]`.
        """
        frames = batch["frames"].flatten(0, 1)
        with torch.no_grad():
            observed, regions = self.find_parts(frames)
            backdrop = self.backdrop.draw(self.backdrop(observed).clamp(0, 1))
        images, hidden = to_unit(frames), regions.any(dim=1)
        return self.arm.loss(images, backdrop, hidden, batch["actions"][:, 0])


def _grown(regions: Tensor) -> Tensor:
    """Bool `regions [..., S, S]`, a pixel more on each side."""
    taller = regions.clone()
    taller[..., 1:, :] |= regions[..., :-1, :]
    taller[..., :-1, :] |= regions[..., 1:, :]
    grown = taller.clone()
    grown[..., 1:] |= taller[..., :-1]
    grown[..., :-1] |= taller[..., 1:]
    return grown
