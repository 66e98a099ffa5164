"""How well a model of any kind predicts a domain's data: what ``hvf probe`` measures.

Designs are chosen on the last twentieth of the data that models are trained on (validation). What
is published is measured on a second collection, of another seed (test), that nothing was chosen on.

In a layout of the maze (``--layout``) there need be no data: windows are of random interaction
there, on episodes of the validation split, and positions are read by the simulator's own eyes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from hvf.data.formats import open_episodes
from hvf.data.splits import episodes_of
from hvf.evaluation.prediction import (
    Reader,
    Things,
    Windows,
    check_disjoint,
    context_of,
    image_figures,
    observables_of,
    predict,
    read_positions,
    read_windows,
    thing_figures,
    things_of,
)
from hvf.files import write_bytes
from hvf.images import frame_grid, write_png
from hvf.models.probe import PositionProbe
from hvf.settings import check_blur
from hvf.training.loop import LoopConfig
from hvf.training.probe import train_probe

_SHOWN = 12
_STRIPS = 6


@dataclass(frozen=True)
class Probe:
    """Measure what a learned model predicts.

    Attributes:
        data: file of episodes; a probe of positions is trained on it where it has states. None with
            a layout.
        model: checkpoint of the model.
        test_data: file of other episodes of the same environment, collected with another seed, on
            which figures are measured; without one they are those of the data's last twentieth,
            which models are chosen on, and the report says so.
        out: directory for the trained probe, the figures and pictures.
        episodes: episodes that are measured, at most.
        windows: windows in each of them.
        horizon: steps that a window has.
        steps_ahead: steps ahead that tables and pictures show, up to the horizon.
        blur: standard deviation, pixels, of a Gaussian blur through which images are compared once
            more, as planning may do; 0 for none.
        probe_episodes: training episodes that the probe learns from, at most.
        layout: in place of data, for models of the maze: a layout (corridor-4, u-maze, spiral, a
            TOML file) in which random interaction is simulated; positions are read exactly.
        loop: how to optimise the probe.
    """

    data: Path | None
    model: Path
    test_data: Path | None = None
    out: Path = Path("runs/probe")
    episodes: int = 200
    windows: int = 4
    horizon: int = 15
    steps_ahead: tuple[int, ...] = (1, 5, 15)
    blur: float = 0.0
    probe_episodes: int = 1000
    layout: str | None = None
    loop: LoopConfig = LoopConfig(
        steps=5000,
        learning_rate=2e-3,
        schedule="cosine",
        warmup_steps=100,
        clip_norm=5.0,
        precision="float32",
        validate_every=1000,
        checkpoint_every=1000,
        threads=1,
    )

    def __post_init__(self) -> None:
        for name in ("episodes", "windows", "horizon", "probe_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        check_blur("blur", self.blur)
        if not self.steps_ahead or not all(1 <= h <= self.horizon for h in self.steps_ahead):
            raise ValueError(
                f"steps_ahead must be from 1 to the horizon {self.horizon}, got {self.steps_ahead}"
            )


def probe(config: Probe, console: Console | None = None) -> dict[str, Any]:
    """Measure the model of a checkpoint; see :func:`measure`.

    Raises:
        FileNotFoundError: no data, or no checkpoint.
        ValueError: a checkpoint of a model that predicts no frames, or for another environment;
            and as :func:`measure`.
    """
    from hvf.models.checkpoint import load_any
    from hvf.settings import Planning

    if (config.data is None) == (config.layout is None):
        raise ValueError("data: give either a file of episodes or a layout of the maze")
    if config.layout is not None and config.test_data is not None:
        raise ValueError("test_data: a layout is simulated, there is no other data")
    environment = "maze"
    if config.data is not None:
        with open_episodes(config.data) as file:
            environment = file.metadata.environment
    found = load_any(config.model, environment=environment)
    if found.entry.role != "dynamics":
        raise ValueError(
            f"model: {config.model} holds a {found.name} model, which is good for "
            f"{found.entry.role}, not for predicting frames"
        )
    # A model of long steps wants its actions held as long.
    hold = int(getattr(found.module, "hold", 1))
    planning = Planning(horizon=hold, action_repeat=hold)
    world = found.entry.resolved("plannable")(found.module, planning)
    described = {"name": found.name, "kind": found.entry.kind}
    if config.layout is not None:
        from hvf.experiments.layouts import measure_layout

        return measure_layout(world, config, console, described)
    return measure(world, config, console, described)


def measure(
    world: Any,
    config: Probe,
    console: Console | None = None,
    described: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Train the position probe, or take the one in ``config.out``, and measure predictions.

    Writes ``figures.json`` and two pictures into ``config.out``: ``predictions.png``
    (:func:`picture`) and ``strips.png`` (:func:`strips`).

    Args:
        world: the model (:func:`hvf.evaluation.prediction.predict`); ``config.model`` names it.
        config: what to measure it on.
        console: where progress and tables go.
        described: what else the report says of the model.

    Returns:
        What the file of figures holds: ``split``, ``data``, ``windows``, ``images``
        (:func:`~hvf.evaluation.prediction.image_figures`), ``things``
        (:func:`~hvf.evaluation.prediction.thing_figures`; empty for data without states) and
        ``config``.

    Raises:
        FileNotFoundError: no data.
        ValueError: data that is too short, or test data that is not another collection of the
            same environment.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    if config.data is None:
        raise ValueError("data: is needed where no layout is simulated")
    console = console or Console()
    with open_episodes(config.data) as file, open_episodes(config.test_data or config.data) as test:
        if len(file) < 2:
            raise ValueError(f"{config.data}: needs 2 episodes, has {len(file)}")
        training, measured = (episodes_of(s, file.metadata) for s in ("train", "validation"))
        held_out = measured
        if config.test_data is not None:
            check_disjoint(file, test)
            measured = range(len(test))
        windows = read_windows(
            test, measured[: config.episodes], config.windows, config.horizon, context_of(world)
        )
        reader, things = None, {}
        if windows.states is not None:
            names = observables_of(file.metadata.parameters, windows.states.shape[2])
            things = things_of(file.metadata.environment, names)
            reader = train_probe(
                file,
                training[: config.probe_episodes],
                held_out,
                config.loop,
                config.out / "probe",
                lambda trained, frames, states: _misread(trained, frames, states, things),
                console,
            )
        figures: dict[str, Any] = {
            "split": "validation" if config.test_data is None else "test",
            "model": dict(described or {}),
            "data": {"trained": asdict(file.metadata), "measured": asdict(test.metadata)},
        }
    return written(world, windows, reader, things, figures, config, console)


def written(
    world: Any,
    windows: Windows,
    reader: Reader | None,
    things: Things,
    figures: dict[str, Any],
    config: Probe,
    console: Console,
) -> dict[str, Any]:
    """Predict windows, and write and print what :func:`measure` promises.

    Args:
        world: the model.
        windows: what happened.
        reader: reads positions in frames; None where nobody knows them.
        things: what to report of these.
        figures: what is known of model and data.
        config: what to measure.
        console: where tables go.
    """
    drawn = predict(world, windows.past, windows.actions, windows.past_actions)
    figures |= {
        "windows": len(windows),
        "images": image_figures(drawn, windows, config.steps_ahead, config.blur),
        "things": thing_figures(drawn, windows, reader, things, config.steps_ahead)
        if reader
        else {},
        "config": asdict(config),
    }
    figures = json.loads(json.dumps(figures, default=str))
    write_bytes(config.out / "figures.json", json.dumps(figures, indent=1).encode())
    write_png(config.out / "predictions.png", picture(drawn, windows, config.steps_ahead))
    write_png(config.out / "strips.png", strips(drawn, windows))
    _report(console, figures, config.steps_ahead)
    return figures


def picture(
    drawn: NDArray[np.uint8], windows: Windows, steps_ahead: Sequence[int]
) -> NDArray[np.uint8]:
    """Predictions beside the truth, a window a column: uint8 `[height, width, 3]`.

    Rows: the last frame seen, then the true and the predicted one for each of the steps ahead.
    """
    shown = _some(windows, _SHOWN)
    rows = [windows.start[shown]]
    for h in steps_ahead:
        rows += [windows.future[shown, h - 1], drawn[shown, h - 1]]
    return frame_grid(rows, zoom=2)


def strips(drawn: NDArray[np.uint8], windows: Windows) -> NDArray[np.uint8]:
    """Whole predictions, a step a column from the last frame seen on: uint8 `[height, width, 3]`.

    Two rows a window: what happened, and what is predicted.
    """
    rows = []
    for n in _some(windows, _STRIPS):
        rows += [np.stack([windows.start[n], *future]) for future in (windows.future[n], drawn[n])]
    return frame_grid(rows, zoom=2)


def _some(windows: Windows, count: int) -> NDArray[np.int64]:
    """Numbers of windows, spread evenly over all."""
    return np.linspace(0, len(windows) - 1, min(count, len(windows))).astype(np.int64)


def _misread(
    probe: PositionProbe, frames: NDArray[np.uint8], states: NDArray[np.float32], things: Things
) -> dict[str, float]:
    """Mean error of one number, mm, by thing."""
    wrong = 1e3 * np.abs(read_positions(probe, frames) - states)
    return {name: float(wrong[:, list(which)].mean()) for name, which in things.items()}


def _report(console: Console, figures: Mapping[str, Any], steps_ahead: Sequence[int]) -> None:
    split = figures["split"]
    of = "another collection" if split == "test" else "the data's last twentieth"
    of = f"random interaction in {figures['layout']}" if "layout" in figures else of
    title = f"images, {split} ({of})"
    table = Table("steps ahead", *map(str, steps_ahead), title=title)
    for name, values in figures["images"].items():
        table.add_row(name, *(f"{values[h - 1]:.3f}" for h in steps_ahead))
    console.print(table)
    if "st_lpips" not in figures["images"]:
        console.print("ST-LPIPS is not measured: pip install 'hvf[metrics]'", markup=False)
    if not figures["things"]:
        console.print("positions are not measured: the data has no states")
        return
    kinds = ("true", "predicted", "still")
    columns = (*kinds, "moved", *(f"moved_{kind}" for kind in kinds))
    table = Table("thing", "steps", *columns, title=f"mm, {split}")
    for name, rows in figures["things"].items():
        for h, row in rows.items():
            values = (row[column] for column in columns)
            table.add_row(name, h, *(f"{x:g}" if math.isfinite(x) else "-" for x in values))
    console.print(table)
