"""How well a model of the maze predicts in a layout that it may not have been trained on.

Nothing has to be collected: the simulator makes windows of random interaction, and reads positions
in predicted frames exactly (to a tenth of a millimetre in frames that it could have drawn itself).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from rich.console import Console

import hvf_core
from hvf.data.splits import EPISODE_SEEDS
from hvf.envs.maze.layouts import fingerprint, layout_of, state_names
from hvf.evaluation.prediction import Windows, context_of, things_of
from hvf.experiments.prediction import Probe, written


def measure_layout(
    world: Any,
    config: Probe,
    console: Console | None = None,
    described: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Measure predictions in ``config.layout``; writes what ``hvf.experiments.prediction`` does.

    Args:
        world: the model (:func:`hvf.evaluation.prediction.predict`), of images of 64 pixels.
        config: what to measure; ``episodes``, ``windows``, ``horizon`` and ``steps_ahead`` count.
        console: where tables go.
        described: what else the report says of the model.

    Raises:
        ValueError, FileNotFoundError: there is no such layout.
    """
    layout = layout_of(config.layout or "")
    windows = simulated(layout, config, context_of(world))
    figures: dict[str, Any] = {
        "split": "validation",
        "model": dict(described or {}),
        "layout": fingerprint(layout),
    }

    def reader(frames: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(hvf_core.maze_locate(frames.numpy(), layout))

    things = things_of("maze", state_names(layout))
    console = console or Console()
    return written(world, windows, reader, things, figures, config, console)


def simulated(layout: hvf_core.MazeLayout, config: Probe, context: int = 1) -> Windows:
    """Windows of random interaction in a layout, on episodes of the validation split.

    Args:
        layout: where.
        config: how many episodes, windows in each and steps of a window.
        context: frames that the model starts from.
    """
    between = context - 1
    steps = between + config.windows * config.horizon
    frames, actions, states = hvf_core.maze_collect(
        EPISODE_SEEDS["validation"], 0, config.episodes, steps, layout=layout
    )
    now = between + config.horizon * np.arange(config.windows)
    ahead = np.arange(config.horizon)
    before = np.arange(-between, 1)

    def cut(array: Any, offsets: Any) -> Any:
        parts = array[:, now[:, None] + offsets]
        return parts.reshape(config.episodes * config.windows, *parts.shape[2:])

    return Windows(
        past=cut(frames, before),
        past_actions=cut(actions, before[:-1]),
        actions=cut(actions, ahead),
        future=cut(frames, ahead + 1),
        states=cut(states, np.arange(config.horizon + 1)),
    )
