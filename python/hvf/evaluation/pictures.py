"""Pictures of an episode: a strip of what was planned and done, and a film of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle
from numpy.typing import NDArray

from hvf.evaluation.recording import Episode
from hvf.files import replacing

_PATH = "#ff7043"
_TARGET = "#ffd54f"


def save_strip(episode: Episode, path: Path, title: str = "") -> None:
    """Write a PNG: start, subgoals, goal, and the path that was taken.

    Raises:
        OSError: the file cannot be written.
    """
    count = len(episode.subgoals)
    panels = [
        ("start", episode.observations[0]),
        *((f"subgoal {k + 1}", image) for k, image in enumerate(episode.subgoals)),
        ("goal", episode.goal),
    ]
    figure = Figure(figsize=(2.3 * (count + 3), 2.9), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, count + 3)
    for ax, (label, image) in zip(axes, panels, strict=False):
        _show(ax, image, label)
    steps = episode.trial.steps
    end = "end" if episode.path is None else "path"
    _show(axes[-1], episode.observations[-1], f"{end}, {steps} steps: {_verdict(episode)}")
    _draw_path(axes[-1], episode)
    figure.suptitle(title or f"episode {episode.index}", fontsize=12)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def save_film(episode: Episode, path: Path, title: str = "", fps: float = 4.0) -> None:
    """Write a GIF (or MP4, by the name of ``path``): the episode beside what it aims at.

    An MP4 needs imageio's ffmpeg or pyav plugin.

    Raises:
        ValueError: neither ``.gif`` nor ``.mp4``.
        OSError: the file cannot be written.
    """
    kind = path.suffix.lower()
    if kind not in (".gif", ".mp4"):
        raise ValueError(f"path: must end in .gif or .mp4, got {path}")
    frames = _film(episode, title)
    # Stay on the last frame for a while.
    frames += [frames[-1]] * round(1.5 * fps)
    with replacing(path) as temporary:
        if kind == ".gif":
            iio.imwrite(temporary, frames, extension=".gif", duration=1000 / fps, loop=0)
        else:
            iio.imwrite(temporary, np.stack(frames), extension=".mp4", fps=fps)


def save_subgoals(
    start: NDArray[np.uint8],
    subgoals: NDArray[np.uint8],
    goal: NDArray[np.uint8],
    costs: Sequence[float],
    path: Path,
    title: str = "",
    below: Sequence[tuple[str, NDArray[np.uint8]]] = (),
) -> None:
    """Write a PNG: start, subgoals and goal, with the planning cost of each segment between them.

    Args:
        start: uint8 ``[H, W, 3]``.
        subgoals: uint8 ``[K, H, W, 3]``.
        goal: uint8 ``[H, W, 3]``.
        costs: of the ``K + 1`` segments.
        path: file to write.
        title: above the pictures.
        below: what stands below each subgoal, with its label; nothing for no second row.

    Raises:
        OSError: the file cannot be written.
    """
    panels = [start, *subgoals, goal]
    rows = 2 if below else 1
    size = (2.3 * len(panels), 3.1 if rows == 1 else 5.6)
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, len(panels), squeeze=False)
    for ax in axes[1:].flat:
        ax.axis("off")
    for ax, (label, image) in zip(axes[-1, 1:-1], below, strict=False):
        ax.axis("on")
        _show(ax, image, label)
    for k, (ax, image) in enumerate(zip(axes[0], panels, strict=True)):
        label = "start" if k == 0 else "goal" if k == len(panels) - 1 else f"subgoal {k}"
        _show(ax, image, label)
        if k:
            ax.set_xlabel(f"cost from the left: {costs[k - 1]:.2g}", fontsize=8)
    if title:
        figure.suptitle(title, fontsize=12)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def _film(episode: Episode, title: str) -> list[NDArray[np.uint8]]:
    """Frames of the film, uint8 ``[height, width, 3]``."""
    figure = Figure(figsize=(6.4, 3.9), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    seen = _show(left, episode.observations[0], "")
    aimed = _show(right, episode.goal, "")
    (trail,) = left.plot([], [], "-", color=_PATH, linewidth=1.5, alpha=0.8)
    _draw_target(left, episode)
    figure.suptitle(title or f"episode {episode.index}", fontsize=12)
    frames = []
    for step, observation in enumerate(episode.observations):
        seen.set_data(observation)
        if episode.path is not None:
            trail.set_data(episode.path[: step + 1, 0], episode.path[: step + 1, 1])
        last = step == episode.trial.steps
        left.set_title(f"step {step}" + (f": {_verdict(episode)}" if last else ""), fontsize=11)
        # The last observation was reached aiming at what the last action aimed at.
        acted = min(step, episode.trial.steps - 1)
        aim, count = episode.aim(acted), len(episode.subgoals)
        aimed.set_data(episode.aim_image(acted))
        label = f"aiming at subgoal {aim + 1} of {count}" if aim < count else "aiming at the goal"
        right.set_title(label, fontsize=11)
        canvas.draw()  # type: ignore[no-untyped-call]
        picture = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
        frames.append(picture[..., :3].copy())
    return frames


def _verdict(episode: Episode) -> str:
    return "reached" if episode.trial.success else "not reached"


def _show(ax: Axes, image: NDArray[np.uint8], label: str) -> AxesImage:
    ax.set_title(label, fontsize=11)
    ax.set_xticks([])
    ax.set_yticks([])
    shown = ax.imshow(image, interpolation="nearest")
    # What is drawn over the image does not stretch it.
    ax.autoscale(False)
    return shown


def _draw_target(ax: Axes, episode: Episode) -> None:
    if episode.target is None:
        return
    column, row, radius = episode.target
    circle = Circle((column, row), radius, fill=False, color=_TARGET, linewidth=1.5, linestyle="--")
    ax.add_patch(circle)


def _draw_path(ax: Axes, episode: Episode) -> None:
    if episode.path is None:
        return
    x, y = episode.path[:, 0], episode.path[:, 1]
    ax.plot(x, y, "-", color=_PATH, linewidth=1.2)
    ax.plot(x[1:], y[1:], "o", color=_PATH, markersize=2.5)
    for switch in episode.trial.switches:
        ax.plot(x[switch], y[switch], "o", color="white", markersize=5, markeredgecolor=_PATH)
    ax.plot(x[0], y[0], "s", color="white", markersize=5)
    _draw_target(ax, episode)
