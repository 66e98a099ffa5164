"""A small model of a desk that nobody trained, and states of it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.models.layers.arm import ArmConfig
from hvf.models.layers.backdrop import BackdropConfig
from hvf.models.layers.cell import CellConfig
from hvf.models.layers.colours import ColoursConfig
from hvf.models.layers.dynamics import LayerDynamics, LayerDynamicsConfig
from hvf.models.layers.gallery import GalleryConfig
from hvf.models.layers.perception import LayerPerceptionConfig

SIZE, PARTS, ACTION = 32, 3, 3


def random_dynamics(seed: int = 0) -> LayerDynamics:
    """A model of images of 32 pixels in which everything moves and is seen."""
    generator = torch.manual_seed(seed)
    perception = LayerPerceptionConfig(
        colours=ColoursConfig(image_size=SIZE),
        backdrop=BackdropConfig(bins=(7, 3)),
        arm=ArmConfig(channels=(4, 8), hidden=20),
        gallery=GalleryConfig(places=(4, 5, 3), patches=300),
        roaming=PARTS,
        sprite=7,
    )
    cell = CellConfig(hand_hidden=10, part_hidden=13, memory=3, reach=7.0)
    model = LayerDynamics(LayerDynamicsConfig(perception=perception, cell=cell))
    with torch.no_grad():
        for network in (model.cell.hand, model.cell.parts, *model.cell.sliders):
            network[-1].weight.normal_(std=0.3)
        model.cell.hand[-1].weight.normal_(std=2.0)
        # Where the hand is seen: in the middle, further on with its code.
        model.cell.contact.normal_(std=0.3)
        model.cell.contact[0] = SIZE / 2
        model.cell.contact[1:3] += 6.0 * torch.eye(2)
        backdrop = model.perception.backdrop
        coarse = torch.rand(7, 3, 3, 8, 8, generator=generator)
        images = torch.nn.functional.interpolate(coarse.flatten(0, 1), size=SIZE)
        backdrop.table.copy_((images * 255).reshape(backdrop.table.shape))
        opacity = torch.rand(PARTS, 1, 7, 7, generator=generator)
        colour = torch.rand(PARTS, 3, 7, 7, generator=generator)
        model.perception.sprites.copy_(torch.cat([opacity, opacity * colour], dim=1))
        gallery = model.perception.gallery
        gallery.low.copy_(torch.tensor([-1.5, -2.0, -1.0]))
        gallery.step.copy_(torch.tensor([1.0, 0.9, 1.1]))
        arm = torch.rand(299, 4, 8, 8, generator=generator)
        arm[:, 1:] *= arm[:, :1]
        gallery.patches[1:] = (arm * 255).to(torch.uint8)
        numbers = torch.randint(-600, 300, gallery.index.shape, generator=generator)
        gallery.index.copy_(numbers.clamp_min(0))
        colours = model.perception.colours
        colours.colours.normal_(std=0.3)
        colours.roams[:PARTS] = True
        colours.full.fill_(20.0)
    return model.eval()


def random_states(count: int, seed: int) -> NDArray[np.float32]:
    """States `[N, X]` of that model, uniformly random."""
    rng = np.random.default_rng(seed)
    hand = rng.normal(0, 1, (count, ACTION))
    sliders = rng.uniform(0, 1, (count, 2))
    places = rng.uniform(2, SIZE - 3, (count, PARTS, 2))
    presence = rng.integers(0, 2, (count, PARTS, 1)) | (rng.random((count, PARTS, 1)) < 0.7)
    parts = np.concatenate([places, presence], axis=2).reshape(count, -1)
    return np.concatenate([hand, sliders, parts], axis=1).astype(np.float32)
