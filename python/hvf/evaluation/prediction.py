"""What a model of any kind predicts, against what happened: images, and positions in them.

A window of an episode is a start (one frame, or as many as the model wants), the actions that were
done, and the frames and states that they led to. A predicted frame is compared with the true one as
an image (PSNR, SSIM, ST-LPIPS), and by what a probe (:mod:`hvf.models.probe`) reads in it, beside
the same of the last frame seen, copied: what "nothing moves" predicts.

Letters in shapes: `N` windows, `C` frames that the model starts from, `H` steps, `S` image size,
`A` action dimensions, `O` observables.
"""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hvf.agents.frames import remembered
from hvf.blur import blur_matrix
from hvf.data.formats import EpisodeReader
from hvf.models.image_quality import Measure, perceptual_distance, psnr, ssim
from hvf.protocols import Images, Observer, Remembering
from hvf.registry import DOMAINS

MOVED = 10.0
"""Millimetres by which something has to move to count as moved."""
_AT_ONCE = 16
# Pixels that an image has to have on each side for ST-LPIPS.
_ROOM = 32
_AXES = ("x", "y", "z")

Reader = Callable[[torch.Tensor], torch.Tensor]
"""Reads observables `[N, O]`, m, in uint8 frames `[N, S, S, 3]`, such as a
:class:`~hvf.models.probe.PositionProbe`."""

Things = Mapping[str, Sequence[int]]
"""What is reported: names of things, and which of the observables are their coordinates."""


@dataclass(frozen=True)
class Windows:
    """Windows of episodes.

    Attributes:
        past: frames up to now, uint8 `[N, C, S, S, 3]`.
        past_actions: actions between them, float32 `[N, C - 1, A]`.
        actions: what was done then, float32 `[N, H, A]`.
        future: frames that it led to, uint8 `[N, H, S, S, 3]`.
        states: what is observable now and after each step, float64 `[N, H + 1, O]`; None in data
            without.
    """

    past: Images
    past_actions: NDArray[np.float32]
    actions: NDArray[np.float32]
    future: Images
    states: NDArray[np.float64] | None

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def start(self) -> Images:
        """The frames of now, uint8 `[N, S, S, 3]`."""
        return self.past[:, -1]


def read_windows(
    file: EpisodeReader, episodes: Iterable[int], windows: int, horizon: int, context: int = 1
) -> Windows:
    """Windows of some episodes, spread evenly over each.

    They begin where a held action begins, if the data says that actions are held. An episode that
    is shorter than a window is left out; in one with room for few, fewer are taken.

    Args:
        file: where from.
        episodes: numbers of episodes.
        windows: how many of each.
        horizon: steps of a window, `H`.
        context: frames that the model starts from, `C`.

    Raises:
        ValueError: no episode is as long as a window.
    """
    held = int(file.metadata.parameters.get("action_repeat", 1))
    found: dict[str, list[NDArray[Any]]] = defaultdict(list)
    for number in episodes:
        episode = file.read(number, 1)
        steps = int(episode.lengths[0])
        last = steps - horizon
        if last < context - 1:
            continue
        starts = np.linspace(context - 1, last, windows).astype(np.int64) // held * held
        for now in np.unique(starts.clip(context - 1)):
            first, end = now - context + 1, now + horizon
            found["past"].append(episode.frames[0, first : now + 1])
            found["past_actions"].append(episode.actions[0, first:now])
            found["actions"].append(episode.actions[0, now:end])
            found["future"].append(episode.frames[0, now + 1 : end + 1])
            if episode.states is not None:
                found["states"].append(episode.states[0, now : end + 1])
    if not found:
        raise ValueError(
            f"{file.path}: no episode has {horizon + context - 1} steps, as long as a window"
        )
    arrays: dict[str, Any] = {name: np.stack(parts) for name, parts in found.items()}
    return Windows(**{"states": None, **arrays})


def predict(
    world: Any,
    frames: Images,
    actions: NDArray[np.float32],
    past_actions: NDArray[np.float32] | None = None,
) -> Images:
    """What `world` predicts: uint8 `[N, H, S, S, 3]`.

    Args:
        world: anything with `predict(frames, actions)`, which gives images uint8
            `[N, H, S, S, 3]` for its own frames `[N]` and actions `[N, H, A]`. Its frames are made
            with `observe_history` or `observe` if it has them (:mod:`hvf.protocols`), and are
            images otherwise.
        frames: images of now, uint8 `[N, S, S, 3]`, or with those before, `[N, C, S, S, 3]`.
        actions: float32 `[N, H, A]`.
        past_actions: between the frames of a history, float32 `[N, C - 1, A]`.

    Raises:
        TypeError: `world` cannot predict images.
        ValueError: predictions of another shape or dtype.
    """
    if not callable(getattr(world, "predict", None)):
        raise TypeError(f"world: {type(world).__name__} has no `predict`, which draws images")
    history = frames[:, None] if frames.ndim == 4 else frames
    count, horizon = actions.shape[:2]
    if past_actions is None:
        past_actions = np.zeros((count, history.shape[1] - 1, actions.shape[2]), np.float32)
    drawn = [np.empty((0, horizon, *history.shape[2:]), np.uint8)]
    for i in range(0, count, _AT_ONCE):
        part = slice(i, i + _AT_ONCE)
        starts = _starts(world, history[part], past_actions[part])
        images = np.asarray(world.predict(starts, actions[part]))
        expected = (len(actions[part]), horizon, *history.shape[2:])
        if images.shape != expected or images.dtype != np.uint8:
            raise ValueError(
                f"world: predicted {images.dtype} {images.shape}, expected uint8 {expected}"
            )
        drawn.append(images)
    return np.concatenate(drawn)


def context_of(world: Any) -> int:
    """Frames that `world` wants to start from, `C`."""
    return int(world.context) if isinstance(world, Remembering) else 1


def image_figures(
    drawn: Images,
    windows: Windows,
    steps_ahead: Sequence[int] | None = None,
    blur: float = 0.0,
) -> dict[str, list[float | None]]:
    """Mean PSNR (dB), SSIM and ST-LPIPS by steps ahead, `[H]` each.

    Of predicted frames as `psnr`, `ssim` and `st_lpips`, of the last frame seen as `..._still`.
    ST-LPIPS only where it is installed, and its network has room in the images. With a blur also
    the PSNR of blurred frames, `psnr_blurred`.

    Args:
        drawn: predicted frames, uint8 `[N, H, S, S, 3]`.
        windows: what happened.
        steps_ahead: from 1 to `H`: those at which ST-LPIPS is measured, whose network takes a
            hundred times longer than the rest; None elsewhere.
        blur: standard deviation, pixels, of a Gaussian blur as the planner's; 0 for none.
    """
    measures: dict[str, Measure] = {"psnr": psnr, "ssim": ssim}
    if blur > 0:
        measures["psnr_blurred"] = _psnr_through(blur, *drawn.shape[2:4])
    if min(drawn.shape[2:4]) >= _ROOM:
        with contextlib.suppress(ModuleNotFoundError):
            measures["st_lpips"] = perceptual_distance()
    horizon = drawn.shape[1]
    every = range(1, horizon + 1)
    result: dict[str, list[float | None]] = {}
    for name, measure in measures.items():
        steps = every if steps_ahead is None or name != "st_lpips" else sorted(set(steps_ahead))
        chosen = np.array(steps) - 1
        found: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
        for i in range(0, len(windows), _AT_ONCE):
            part = slice(i, i + _AT_ONCE)
            truth = windows.future[part][:, chosen]
            found[name].append(measure(drawn[part][:, chosen], truth))
            still = windows.start[part, None].repeat(truth.shape[1], axis=1)
            found[f"{name}_still"].append(measure(still, truth))
        for key, values in found.items():
            means = dict(zip(steps, np.concatenate(values).mean(axis=0).round(4), strict=True))
            result[key] = [float(means[h]) if h in means else None for h in every]
    return result


def _psnr_through(blur: float, height: int, width: int) -> Measure:
    down, across = blur_matrix(height, blur), blur_matrix(width, blur)

    def blurred(images: Images) -> NDArray[np.float64]:
        smooth: NDArray[np.float64] = np.einsum(
            "hi,wj,...ijc->...hwc", down, across, images.astype(np.float64), optimize=True
        )
        return smooth

    return lambda guess, truth: psnr(blurred(guess), blurred(truth))


def thing_figures(
    drawn: Images,
    windows: Windows,
    probe: Reader,
    things: Things,
    steps_ahead: Sequence[int],
) -> dict[str, dict[str, dict[str, float]]]:
    """Mean errors in millimetres, by thing and steps ahead.

    `true` is what the probe misreads in true frames, `predicted` what it misreads in predicted
    ones, `still` how far the thing moved: the error of "nothing moves". The same over those windows
    in which the thing moved by more than a centimetre is `moved_...`, with their part as `moved`.

    Args:
        drawn: predicted frames, uint8 `[N, H, S, S, 3]`.
        windows: what happened; with states, in metres.
        probe: reads observables.
        things: what to report.
        steps_ahead: from 1 to `H`.

    Raises:
        ValueError: windows without states.
    """
    if windows.states is None:
        raise ValueError("windows: have no states to compare positions with")
    found: dict[str, dict[str, dict[str, float]]] = {}
    for h in steps_ahead:
        true = read_positions(probe, windows.future[:, h - 1])
        guess = read_positions(probe, drawn[:, h - 1])
        for name, which in things.items():
            which = list(which)
            truth, start = windows.states[:, h, which], windows.states[:, 0, which]
            errors = {
                "true": _distance(true[:, which], truth),
                "predicted": _distance(guess[:, which], truth),
                "still": _distance(start, truth),
            }
            moved = errors["still"] > MOVED
            row = {kind: round(float(error.mean()), 1) for kind, error in errors.items()}
            row["moved"] = round(float(moved.mean()), 4)
            for kind, error in errors.items():
                row[f"moved_{kind}"] = round(float(error[moved].mean()), 1) if moved.any() else 0.0
            found.setdefault(name, {})[str(h)] = row
    return found


def read_positions(probe: Reader, frames: Images) -> NDArray[np.float32]:
    """What the probe reads in uint8 `frames [N, S, S, 3]`, m: `[N, O]`."""
    with torch.inference_mode():
        parts = torch.split(torch.from_numpy(np.ascontiguousarray(frames)), 256)
        read: NDArray[np.float32] = torch.cat([probe(part) for part in parts]).numpy()
    return read


def observables_of(parameters: Mapping[str, Any], count: int) -> list[str]:
    """Names of what the states of a data set hold, `[O]`, as the data says, or else numbers.

    Args:
        parameters: of the data set; `states` has the names.
        count: of them, `O`.

    Raises:
        ValueError: other than `count` names.
    """
    names = list(parameters.get("states") or (f"state {i}" for i in range(count)))
    if len(names) != count:
        raise ValueError(f"data: {len(names)} names of states, {names}, for {count} numbers")
    return names


def things_of(environment: str, names: Sequence[str]) -> dict[str, list[int]]:
    """What to report of observables: as the domain says (`groups`), or what belongs together.

    `red_x`, `red_y` and `red_z` are a thing called `red`; `x` and `y` alone are a `position`.
    """
    groups: Mapping[str, slice] = {}
    with contextlib.suppress(ValueError, ImportError):  # recorded elsewhere, or not installed here
        groups = getattr(DOMAINS[environment], "groups", groups)
    found = {name: list(range(len(names))[which]) for name, which in groups.items()}
    if found and all(found.values()):
        return found
    found = {}
    for i, name in enumerate(names):
        stem, _, axis = name.rpartition("_")
        thing = (stem.replace("_", " ") or "position") if axis in _AXES else name
        found.setdefault(thing, []).append(i)
    return found


def check_disjoint(data: EpisodeReader, test: EpisodeReader) -> None:
    """Refuse to test on what was trained on.

    Two collections of one environment with the same seed hold the same episodes, as many as they
    both have; unless they turn out to have none in common (recorded data, say, has no seeds).

    Raises:
        ValueError: another environment, image size or action dimension; or common episodes.
    """
    for name in ("environment", "frame_shape", "action_dim"):
        ours, theirs = (
            getattr(file.metadata if name == "environment" else file, name) for file in (data, test)
        )
        if ours != theirs:
            raise ValueError(f"test_data: {name} is {theirs!r}, that of the data is {ours!r}")
    if data.metadata.seed != test.metadata.seed:
        return
    known = {key for i in range(len(data)) for key in _keys(data, i)}
    if any(key in known for i in range(len(test)) for key in _keys(test, i)):
        raise ValueError(
            f"test_data: has episodes of the data itself (both of {data.metadata.environment}, "
            f"seed {data.metadata.seed}); collect it with another --seed"
        )


def _keys(file: EpisodeReader, number: int) -> list[tuple[str, bytes]]:
    """What two recordings of one episode have in common: its actions, or how it starts."""
    episode = file.read(number, 1)
    keys = [("actions", episode.actions.tobytes())]
    if episode.states is not None:
        keys.append(("states", episode.states[0, 0].tobytes()))
    return keys


def _starts(world: Any, history: Images, past_actions: NDArray[np.float32]) -> Any:
    if isinstance(world, Remembering):
        return remembered(world, history, past_actions)
    images = np.ascontiguousarray(history[:, -1])
    return world.observe(images) if isinstance(world, Observer) else images


def _distance(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray(1e3 * np.linalg.norm(a.astype(np.float64) - b, axis=1))
