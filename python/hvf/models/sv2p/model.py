"""SV2P: stochastic variational video prediction (Babaeizadeh et al., ICLR 2018).

As the paper's authors ran it (tensor2tensor 1.13.4, ``next_frame_sv2p``, one frame of context, ten
predicted ones), layer by layer:

====  ===========================================================  ==============
 1    convolution 5x5, stride 2, ReLU; norm                        32 x 32 x 32
 2-3  two ConvLSTMs 5x5, each with norm                            32 x 32 x 32
 4    convolution 3x3, stride 2, ReLU                              16 x 16 x 32
 5-6  two ConvLSTMs, norm                                          16 x 16 x 64
 7    convolution 3x3, stride 2, ReLU                              8 x 8 x 64
 8    times sigmoid(W a + b), plus V a + c, for the action a       8 x 8 x 64
 9    with the latent z, convolution 1x1, ReLU                     8 x 8 x 64
10    ConvLSTM, norm                                               8 x 8 x 128
11    up; ConvLSTM, norm; beside it what 4 gave                    16 x 16 x 96
12    up; ConvLSTM, norm; beside it what 1 gave                    32 x 32 x 64
13    up; norm                                                     64 x 64 x 64
14    an image drawn anew, and eleven masks (softmax)              64 x 64
15    from 10, ten kernels 5x5 that move the last image (CDNA)
====  ===========================================================  ==============

The next image is the last one, the one drawn anew and the moved ones, each times its mask.

What is easily got wrong, and what is done here:

* (a) ``layer_norm`` is over channels *and* pixels, with a scale and bias a channel and an epsilon
  of 1e-12: :func:`~hvf.models.sv2p.layers.layer_norm`.
* (b) The ConvLSTM's gates are in the order i, j, f, o, and the forget gate has a bias of 1:
  :class:`~hvf.models.sv2p.layers.ConvLSTM`. (a) and (b) are as in TensorFlow's own code.
* (c) The tenth moved image has no mask left and is never used; its weights are kept here, so that
  the number of parameters is that of the original, and it is not computed.
* (d) ``SAME`` padding at stride 2 pads below and to the right:
  :class:`~hvf.models.sv2p.layers.Down`.
* (e) The posterior's log variance is at least -5, before which it is rectified.
* (f) Upsampling is a transposed convolution without its first row and column, as in the code, of
  which the authors remark that it "doesn't reflect actual model in paper".
* (g) There is one latent for a whole clip, drawn anew for every clip: in training from a posterior
  that sees all of its frames, in planning from the prior.

Differences: any image size that 8 divides, and any action box, scaled to [-1, 1]; all layers begin
with one initialiser (uniform, gain 1.3), those for upsampling too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

from hvf.models.frames import to_unit
from hvf.models.sv2p.config import SV2PConfig
from hvf.models.sv2p.layers import ConvLSTM, Down, MovedImages, Up, initialise, layer_norm
from hvf.models.sv2p.posterior import Posterior, divergence
from hvf.models.video import State, VideoModel

# Number of a frame, of what is seen in it (skips and bottleneck), and of cell and hidden state of
# each ConvLSTM, in a state.
_SEEN = slice(1, 4)
_MEMORY = 4


class SV2P(VideoModel):
    """The paper's dynamics.

    A state is a frame, what the first half of the network (1 to 7 in the table) saw in it, and the
    memories of all seven ConvLSTMs, those of the first half after it. Only the second half needs
    the action.
    """

    config_type: ClassVar[type[SV2PConfig]] = SV2PConfig
    config: SV2PConfig

    def __init__(self, config: SV2PConfig) -> None:
        super().__init__(config)
        rows, columns = config.latent_size
        self.noise = rows * columns
        w1, w2, w3, w4, w5, w6, w7 = config.widths
        inputs = (config.stem, w1, w2, w3, w4, w5, w6 + w2)
        self.lstms = nn.ModuleList(
            ConvLSTM(i, o, config.kernel) for i, o in zip(inputs, config.widths, strict=True)
        )
        self.lstm_norms = nn.ModuleList(layer_norm(width) for width in config.widths)
        self.stem, self.stem_norm = Down(3, config.stem, 5), layer_norm(config.stem)
        self.down1, self.down2 = Down(w2, w2, 3), Down(w4, w4, 3)
        self.action_gain = nn.Linear(config.action_dim, w4)
        self.action_shift = nn.Linear(config.action_dim, w4)
        self.bottleneck = nn.Conv2d(w4 + 1, w4, 1)
        last = w7 + config.stem
        self.up1, self.up2, self.up3 = Up(w5), Up(w6 + w2), Up(last)
        self.up_norm = layer_norm(last)
        self.anew = nn.Conv2d(last, 3, 1)
        self.masks = nn.Conv2d(last, config.masks + 1, 1)
        self.moved = MovedImages(rows * columns * w5, config.masks, config.move)
        self.posterior = Posterior(config)
        initialise(self)

    def start(self, frames: Tensor, past: Tensor) -> State:
        """The state of now; see :meth:`VideoModel.start`."""
        return self._see(frames[:, -1], self._no_memory(frames[:, -1]))

    def step(
        self, state: State, actions: Tensor, noise: Tensor | None, *, last: bool = False
    ) -> State:
        """The state one step later; see :meth:`VideoModel.step`."""
        assert noise is not None
        image, memory = self._act(state, actions, noise)
        return (image,) if last else self._see(image, memory)

    def images(self, state: State) -> Tensor:
        """What a state looks like; see :meth:`VideoModel.images`."""
        return state[0]

    def loss(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, step: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Squared error of predicted frames, and from the third stage on the KL divergence.

        Args:
            batch: ``frames`` uint8 ``[B, T, H, W, 3]``, as many as the config says, and ``actions``
                float ``[B, T - 1, A]``.
            generator: of the latent, and of which sequences go on from true frames.
            step: for the three stages and scheduled sampling.

        Raises:
            ValueError: clips of another length.
        """
        frames, actions = batch["frames"], batch["actions"]
        if frames.shape[1] != self.config.frames:
            raise ValueError(f"frames: {frames.shape[1]} in a clip, expected {self.config.frames}")
        clip = to_unit(frames.flatten(0, 1))
        clip = clip.reshape(*frames.shape[:2], *clip.shape[1:])
        count, device = len(clip), clip.device
        latent = torch.randn(count, self.noise, generator=generator, device=device)
        kl = latent.new_zeros(())
        if step >= self.config.posterior_from:
            mean, log_variance = self.posterior(clip)
            latent = mean + (0.5 * log_variance).exp() * latent
            kl = divergence(mean, log_variance).mean()
        true = self.config.true_frames(step, count)
        image, memory = clip[:, 0], self._no_memory(clip[:, 0])
        errors = []
        for time in range(actions.shape[1]):
            if time and true:
                order = torch.randperm(count, generator=generator, device=device)
                image = torch.where((order < true)[:, None, None, None], clip[:, time], image)
            state = self._see(image, memory)
            image, memory = self._act(state, actions[:, time], latent)
            errors.append((image - clip[:, time + 1]).square().mean())
        each = torch.stack(errors)
        loss = each.mean() + self.config.kl_weight_at(step) * kl
        parts = {"mse": each.mean(), "mse_1": each[0], "mse_last": each[-1], "kl": kl}
        return loss, {name: part.detach() for name, part in parts.items()}

    def _no_memory(self, image: Tensor) -> State:
        """Cell and hidden state of each ConvLSTM before the first frame."""
        height, width = self.config.image_size
        zeros = []
        for channels, scale in zip(self.config.widths, (2, 2, 4, 4, 8, 4, 2), strict=True):
            empty = image.new_zeros(len(image), channels, height // scale, width // scale)
            zeros += [empty, empty]
        return tuple(zeros)

    def _see(self, image: Tensor, memory: State) -> State:
        """A frame through the first half, up to the action."""
        after = list(memory)
        skip0 = self.stem_norm(torch.relu(self.stem(image)))
        x = self._remember(1, self._remember(0, skip0, after), after)
        skip1 = torch.relu(self.down1(x))
        x = self._remember(3, self._remember(2, skip1, after), after)
        return (image, skip0, skip1, torch.relu(self.down2(x)), *after)

    def _act(self, state: State, actions: Tensor, noise: Tensor) -> tuple[Tensor, State]:
        """The next frame, and the memories after it."""
        image, (skip0, skip1, x) = state[0], state[_SEEN]
        after = list(state[_MEMORY:])
        unit = self.unit_actions(actions)
        x = x * torch.sigmoid(self.action_gain(unit))[:, :, None, None]
        x = x + self.action_shift(unit)[:, :, None, None]
        latent = noise.reshape(-1, 1, *self.config.latent_size).to(x.dtype)
        x = torch.relu(self.bottleneck(torch.cat([x, latent], dim=1)))
        middle = self._remember(4, x, after)
        x = self._remember(5, self.up1(middle), after)
        x = self._remember(6, self.up2(torch.cat([x, skip1], dim=1)), after)
        x = self.up_norm(self.up3(torch.cat([x, skip0], dim=1)))
        masks = self.masks(x).float().softmax(dim=1)
        drawn = torch.sigmoid(self.anew(x).float())
        moved = self.moved(image, middle.flatten(1), masks[:, 2:])
        return masks[:, :1] * image + masks[:, 1:2] * drawn + moved, tuple(after)

    def _remember(self, number: int, x: Tensor, memory: list[Tensor]) -> Tensor:
        """What a ConvLSTM makes of ``x``, normalised; its memory is replaced."""
        cell, hidden = memory[2 * number : 2 * number + 2]
        memory[2 * number : 2 * number + 2] = self.lstms[number](x, cell, hidden)
        normalised: Tensor = self.lstm_norms[number](memory[2 * number + 1])
        return normalised


class SV2PSmall(SV2P):
    """:class:`SV2P` with narrower layers (:data:`~hvf.models.sv2p.config.SMALL`), for two cores.

    A class of its own, so that checkpoints and reports say which of the two it is.
    """
