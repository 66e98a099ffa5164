"""What the learned dynamics of the desk predicts: frames, and what a probe reads in them.

`N` windows, `H` steps, `O` observables.
"""

from __future__ import annotations

import contextlib
import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from hvf.data.formats.hdf5 import EpisodeFile
from hvf.evaluation.image_quality import Measure, perceptual_distance, psnr, ssim
from hvf.files import write_bytes
from hvf.models.checkpoint import load_model
from hvf.models.layers.dynamics import LayerDynamics
from hvf.models.probe import PositionProbe, PositionProbeConfig
from hvf.training.loop import LoopConfig, Validation, seeded, train
from hvf.training.pictures import frame_grid, write_png
from hvf.worlds.layers import LayerWorld

HORIZON = 15
STEPS_AHEAD = (1, 5, 15)
_AT_ONCE = 16
_SHOWN = 12
# Millimetres by which something has to move to count as moved.
_MOVED = 10.0
# Held-out frames that validate the probe.
_CHECKED = 2000

# What is reported, and which of the observables it is.
THINGS: Mapping[str, slice] = {
    "end effector": slice(0, 3),
    "door": slice(3, 4),
    "drawer": slice(4, 5),
    "red block": slice(8, 11),
    "green block": slice(11, 14),
    "blue block": slice(14, 17),
}


@dataclass(frozen=True)
class DeskModelProbe:
    """Measure what the learned dynamics of the desk predicts on held-out episodes.

    Attributes:
        data: file of episodes (``hvf collect desk``); its last twentieth is held out.
        dynamics: checkpoint of the dynamics.
        out: directory for the trained probe, the figures and pictures.
        probe_episodes: training episodes that the probe learns from.
        windows: windows of 15 steps in each held-out episode.
        loop: how to optimise the probe.
    """

    data: Path
    dynamics: Path
    out: Path = Path("runs/desk_probe")
    probe_episodes: int = 1000
    windows: int = 4
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
        for name in ("probe_episodes", "windows"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


def probe_desk(config: DeskModelProbe, console: Console | None = None) -> dict[str, object]:
    """Train the probe, or take the one in ``config.out``, and measure predictions.

    Writes ``figures.json`` and ``predictions.png`` into ``config.out``.

    Returns:
        What the file of figures holds.

    Raises:
        FileNotFoundError: no data, or no checkpoint.
        ValueError: data of another environment, too short, or a checkpoint of another model.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    console = console or Console()
    world = LayerWorld(load_model(config.dynamics, LayerDynamics, environment="desk"))
    with EpisodeFile(config.data, "desk") as file:
        total, steps = len(file), file.metadata.steps
        held_out = min(max(total // 20, 1), 200)
        if steps < HORIZON or total < 2:
            raise ValueError(
                f"{config.data}: needs 2 episodes of {HORIZON} steps, has {total} of {steps}"
            )
        probe = _train_probe(config, file, total - held_out, held_out, console)
        frames, actions, states = _windows(file, total - held_out, held_out, config.windows)
    figures: dict[str, object] = {
        "windows": len(frames),
        "images": image_figures(world, frames, actions),
        "things": thing_figures(world, probe, frames, actions, states),
        "config": json.loads(json.dumps(asdict(config), default=str)),
    }
    write_bytes(config.out / "figures.json", json.dumps(figures, indent=1).encode())
    shown = np.linspace(0, len(frames) - 1, min(_SHOWN, len(frames))).astype(np.int64)
    drawn = world.predict(world.observe(frames[shown, 0]), actions[shown])
    rows = [frames[shown, 0]]
    for h in STEPS_AHEAD:
        rows += [frames[shown, h], drawn[:, h - 1]]
    write_png(config.out / "predictions.png", frame_grid(rows, zoom=2))
    _report(console, figures)
    return figures


class _ProbeSampler:
    """Frames and states of some episodes, uniformly."""

    def __init__(
        self, frames: NDArray[np.uint8], states: NDArray[np.float32], count: int, seed: int
    ) -> None:
        self._frames, self._states, self._count, self._seed = frames, states, count, seed

    def batch(self, step: int) -> Mapping[str, torch.Tensor]:
        """The batch of training step ``step``."""
        rng = np.random.default_rng([self._seed, step])
        chosen = rng.integers(len(self._frames), size=self._count)
        return {
            "frames": torch.from_numpy(self._frames[chosen]),
            "states": torch.from_numpy(self._states[chosen]),
        }


def _train_probe(
    config: DeskModelProbe, file: EpisodeFile, training: int, held_out: int, console: Console
) -> PositionProbe:
    def read(first: int, count: int, stride: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        parts = [file.read(first + i, 1) for i in range(count)]
        frames = np.concatenate([part.frames[0, ::stride] for part in parts])
        states = np.concatenate([part.true_states[0, ::stride] for part in parts])
        return frames, states.astype(np.float32)

    frames, states = read(0, min(config.probe_episodes, training), 3)
    checked, truth = read(training, held_out, 7)
    checked, truth = checked[:_CHECKED], truth[:_CHECKED]

    def validate(model: PositionProbe, _: torch.Generator) -> Validation:
        wrong = 1e3 * np.abs(read_all(model, checked) - truth)
        return Validation({name: float(wrong[:, x].mean()) for name, x in THINGS.items()})

    seed = config.loop.seed
    sizes = PositionProbeConfig(image_size=frames.shape[1], observables=states.shape[1])
    return train(
        seeded(seed, lambda: PositionProbe(sizes)).fit_scale(torch.from_numpy(states)),
        _ProbeSampler(frames, states, 64, seed),
        config.loop,
        config.out / "probe",
        environment="desk",
        run={
            "command": "hvf probe desk",
            "data": asdict(file.metadata),
            "episodes": config.probe_episodes,
        },
        validate=validate,
        console=console,
    )


def _windows(
    file: EpisodeFile, first: int, count: int, windows: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float64]]:
    """Frames `[N, 16, S, S, 3]`, actions `[N, 15, 3]` and states `[N, 16, O]`, spread evenly.

    Windows begin where a held action begins, if actions are held for three steps.
    """
    starts = np.linspace(0, file.metadata.steps - HORIZON, windows).astype(np.int64) // 3 * 3
    frames, actions, states = [], [], []
    for i in range(count):
        episode = file.read(first + i, 1)
        for start in np.unique(starts):
            frames.append(episode.frames[0, start : start + HORIZON + 1])
            actions.append(episode.actions[0, start : start + HORIZON])
            states.append(episode.true_states[0, start : start + HORIZON + 1])
    return np.stack(frames), np.stack(actions), np.stack(states)


def read_all(probe: PositionProbe, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
    """What the probe reads in `frames [N, S, S, 3]`, m: `[N, O]`."""
    with torch.inference_mode():
        parts = torch.split(torch.from_numpy(np.ascontiguousarray(frames)), 256)
        read: NDArray[np.float32] = torch.cat([probe(part) for part in parts]).numpy()
    return read


def image_figures(
    world: LayerWorld, frames: NDArray[np.uint8], actions: NDArray[np.float32]
) -> dict[str, list[float]]:
    """Mean PSNR (dB), SSIM and ST-LPIPS of predicted frames and of the start frame, by steps ahead.

    ST-LPIPS only where it is installed.

    Args:
        world: the model.
        frames: uint8 `[N, 16, S, S, 3]`.
        actions: float32 `[N, 15, 3]`.
    """
    measures: dict[str, Measure] = {"psnr": psnr, "ssim": ssim}
    with contextlib.suppress(ModuleNotFoundError):
        measures["st_lpips"] = perceptual_distance()
    found: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
    for i in range(0, len(frames), _AT_ONCE):
        part = frames[i : i + _AT_ONCE]
        drawn = world.predict(world.observe(part[:, 0]), actions[i : i + _AT_ONCE])
        still = np.broadcast_to(part[:, :1], drawn.shape)
        for name, measure in measures.items():
            found[name].append(measure(drawn, part[:, 1:]))
            found[f"{name}_still"].append(measure(still, part[:, 1:]))
    return {
        name: np.concatenate(values).mean(axis=0).round(4).tolist()
        for name, values in found.items()
    }


def thing_figures(
    world: LayerWorld,
    probe: PositionProbe,
    frames: NDArray[np.uint8],
    actions: NDArray[np.float32],
    states: NDArray[np.float64],
) -> dict[str, dict[str, dict[str, float]]]:
    """Mean errors in millimetres, by thing and steps ahead.

    `true` is what the probe misreads in true frames, `predicted` what it misreads in predicted
    ones, `still` how far the thing moved: the error of "nothing moves". The same over those windows
    in which the thing moved by more than a centimetre is `moved_...`, with their part as `moved`.
    """
    drawn = np.concatenate(
        [
            world.predict(world.observe(frames[i : i + _AT_ONCE, 0]), actions[i : i + _AT_ONCE])[
                :, [h - 1 for h in STEPS_AHEAD]
            ]
            for i in range(0, len(frames), _AT_ONCE)
        ]
    )
    found: dict[str, dict[str, dict[str, float]]] = {}
    for column, h in enumerate(STEPS_AHEAD):
        true, guess = read_all(probe, frames[:, h]), read_all(probe, drawn[:, column])
        for name, which in THINGS.items():
            truth, start = states[:, h, which], states[:, 0, which]
            errors = {
                "true": _distance(true[:, which], truth),
                "predicted": _distance(guess[:, which], truth),
                "still": _distance(start, truth),
            }
            moved = errors["still"] > _MOVED
            row = {kind: round(float(error.mean()), 1) for kind, error in errors.items()}
            row["moved"] = round(float(moved.mean()), 4)
            for kind, error in errors.items():
                row[f"moved_{kind}"] = round(float(error[moved].mean()), 1) if moved.any() else 0.0
            found.setdefault(name, {})[str(h)] = row
    return found


def _distance(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray(1e3 * np.linalg.norm(a.astype(np.float64) - b, axis=1))


def _report(console: Console, figures: Mapping[str, object]) -> None:
    images: dict[str, list[float]] = figures["images"]  # type: ignore[assignment]
    table = Table("steps ahead", *map(str, STEPS_AHEAD), title="images")
    for name, values in images.items():
        table.add_row(name, *(f"{values[h - 1]:.3f}" for h in STEPS_AHEAD))
    console.print(table)
    if "st_lpips" not in images:
        console.print("ST-LPIPS is not measured: pip install 'hvf[metrics]'", markup=False)
    things: dict[str, dict[str, dict[str, float]]] = figures["things"]  # type: ignore[assignment]
    columns = ("true", "predicted", "still", "moved", "moved_true", "moved_predicted")
    table = Table("thing", "steps", *columns, "moved_still", title="mm")
    for name, rows in things.items():
        for h, row in rows.items():
            table.add_row(name, h, *(f"{row[column]:g}" for column in (*columns, "moved_still")))
    console.print(table)
