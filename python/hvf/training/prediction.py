"""How well a video model predicts held-out clips, for validation while it is trained.

What is published is measured by ``hvf probe`` (:mod:`hvf.evaluation.prediction`).
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.data.loader import EpisodePool
from hvf.images import frame_grid
from hvf.models.frames import to_frames, to_unit
from hvf.models.image_quality import psnr
from hvf.models.video import VideoModel, sequence_noise
from hvf.training.loop import Validation

# Held-out clips that are measured, and how many of them the picture shows.
_CLIPS = 64
_SHOWN = 6


def validate_prediction(model: VideoModel, held_out: EpisodePool, steps: int) -> Validation:
    """How like the true ones predicted frames are, by steps ahead.

    Noise is drawn from the prior, as in planning.

    Args:
        model: in evaluation mode.
        held_out: episodes.
        steps: of the model, at least 1.

    Returns:
        PSNR (dB) 1 step ahead, halfway and at the end, as ``psnr_...``, and of the last frame seen,
        copied, as ``still_...``; and a picture with a row for a true clip and one for what is
        predicted of it, below each other.

    Raises:
        ValueError: no episode that is long enough.
    """
    context, hold = model.context, model.hold
    length = (context - 1 + steps) * hold
    enough = np.flatnonzero(held_out.lengths >= length)
    if not len(enough):
        raise ValueError(f"held-out episodes: none has {length} steps")
    episodes = enough[np.arange(_CLIPS) % len(enough)]
    rng = np.random.default_rng(0)
    # Where actions are held, an action begins at every `hold`-th step.
    first = rng.integers(held_out.lengths[episodes] - length + 1) // hold * hold
    times = first[:, None] + hold * np.arange(context + steps)
    clips = held_out.frames[episodes[:, None], times]
    actions = held_out.actions[episodes[:, None], times[:, :-1]]
    now, truth = clips[:, context - 1], clips[:, context:]
    drawn = _predicted(model, clips[:, :context], actions)
    metrics = {}
    for ahead in sorted({1, (steps + 1) // 2, steps}):
        metrics[f"psnr_{ahead}"] = float(psnr(drawn[:, ahead - 1], truth[:, ahead - 1]).mean())
        metrics[f"still_{ahead}"] = float(psnr(now, truth[:, ahead - 1]).mean())
    rows = []
    for start, true, guess in zip(now[:_SHOWN], truth, drawn, strict=False):
        rows += [np.stack([start, *true]), np.stack([start, *guess])]
    return Validation(metrics, {"predictions": frame_grid(rows, zoom=2)})


def _predicted(
    model: VideoModel, seen: NDArray[np.uint8], actions: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Predicted frames uint8 ``[N, H, S, S, 3]`` after those that were seen, ``[N, C, ...]``."""
    device = next(model.parameters()).device
    frames = to_unit(torch.from_numpy(seen).to(device).flatten(0, 1))
    acted = torch.from_numpy(actions).to(device)
    before = model.context - 1
    noise = None
    if model.noise:
        noise = sequence_noise(torch.arange(len(seen)), model.noise).to(device)
    state = model.start(frames.reshape(*seen.shape[:2], *frames.shape[1:]), acted[:, :before])
    drawn = []
    for step in range(before, acted.shape[1]):
        state = model.step(state, acted[:, step], noise, last=step + 1 == acted.shape[1])
        drawn.append(to_frames(model.images(state).float()))
    return torch.stack(drawn, dim=1).cpu().numpy()
