"""``hvf report DOMAIN``: what models make of many held-out recorded episodes.

For each episode: subgoals between its first and last frame, what the segments cost to plan beside
the plan without subgoals; how well the dynamics predict it beside "nothing moves"; and whether the
generator's images keep its scene (:mod:`hvf.evaluation.scenes`). One after another, each saved, so
that a stopped report goes on.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from hvf.agents.frames import images_of, observed
from hvf.data.formats import EpisodeReader, open_episodes
from hvf.data.splits import episodes_of
from hvf.domains.domain import Domain
from hvf.evaluation.between import Recorded, load_for, training_episodes
from hvf.evaluation.code import code_of, same_code
from hvf.evaluation.neighbours import nearest_frames
from hvf.evaluation.prediction import context_of, image_figures, predict, read_windows
from hvf.evaluation.scenes import mean_figures, retrieved, scene_figures, spread
from hvf.experiments.video_tables import markdown
from hvf.files import write_bytes
from hvf.images import frame_grid, write_png
from hvf.progress import progress
from hvf.protocols import Images
from hvf.settings import Planning, World
from hvf.worlds.load import Loaded, load_generator

FORMAT = 1
"""Version of the JSON of a report."""
NONE = "none"
_SHOWN = 6


@dataclasses.dataclass(frozen=True)
class VideoReport:
    """Report what models make of many held-out recorded episodes.

    Writes report.json, report.md and pictures: a strip for each episode (start, subgoals, goal,
    nearest training frames below), samples.png and predictions.png. The same command goes on where
    it was stopped. Example:

        hvf report video --data data/bair-test.h5 --train-data data/bair.h5 --episodes 20
        --dynamics runs/sv2p/model.safetensors --generator runs/cvae/model.safetensors

    Attributes:
        data: file of episodes: all of one for tests, else the validation episodes.
        episodes: how many, spread evenly over those that there are.
        subgoals: how many (K).
        camera: whose frames; the first one's by default.
        train_data: file of the training episodes, for neighbours; the data's own by default.
        draws: images that the generator draws for each episode.
        steps_ahead: steps that the dynamics predict, as far as episodes are as long.
        windows: predictions in each episode.
        preset: settings, by name; the others begin with them.
        world: what is planned with; without dynamics ("none") the report is on the generator only,
            which can be of data without actions, and without a generator on predictions only.
        planning: plan settings.
        out: folder for the report.
        seed: of searches and draws.
        overwrite: begin anew if the folder holds another report.
    """

    data: Path
    episodes: int = 20
    subgoals: int = 2
    camera: str | None = None
    train_data: Path | None = None
    draws: int = 16
    steps_ahead: int = 10
    windows: int = 3
    preset: str = "default"
    world: World = World()
    planning: Planning = Planning()
    out: Path = Path("outputs/report")
    seed: int = 0
    overwrite: bool = False

    def __post_init__(self) -> None:
        for name in ("episodes", "subgoals", "draws", "steps_ahead", "windows"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")
        if self.world.dynamics == self.world.generator == NONE:
            raise ValueError("dynamics: without dynamics and generator there is nothing to report")


def report(domain: Domain, config: VideoReport, console: Console | None = None) -> dict[str, Any]:
    """Make a report; see :class:`VideoReport`.

    Returns:
        What ``report.json`` holds: the settings, ``episodes``, a record each, and ``summary``.

    Raises:
        FileNotFoundError: no data, or no models.
        FileExistsError: the folder holds another report, or one by other code.
        ValueError: data that cannot be used, or models of another size of frames or actions.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    console = console or Console()
    with (
        open_episodes(config.data, camera=config.camera) as file,
        open_episodes(config.train_data or config.data, camera=config.camera) as known,
    ):
        held_out = _held_out(file, config.episodes)
        loaded = _load(domain, config)
        work = _Work(config, loaded, file, known, held_out)
        head = _head(domain, config, loaded, file, known)
        done = _finished(config, head)
        try:
            with progress(
                console, f"{domain.name}:", len(held_out), "episodes", completed=len(done)
            ) as bar:
                for place, number in enumerate(held_out):
                    if number not in done:
                        done[number] = work.episode(place)
                        _save(config.out, head, done, held_out)
                        bar.advance(1)
        except KeyboardInterrupt:
            console.print(f"{config.out}: stopped; the same command goes on from there")
            raise
        written = _save(config.out, head, done, held_out)
        work.pictures()
    text = markdown(written)
    write_bytes(config.out / "report.md", text.encode())
    console.print(text, highlight=False, markup=False, soft_wrap=True)
    return written


class _Work:
    """What is done for each episode."""

    def __init__(
        self,
        config: VideoReport,
        loaded: Loaded,
        file: EpisodeReader,
        known: EpisodeReader,
        held_out: Sequence[int],
    ) -> None:
        self._config, self._loaded, self._file, self._known = config, loaded, file, known
        self._numbers = held_out
        self._episodes = [Recorded.read(file, number) for number in held_out]
        self._training = training_episodes(known)
        self._planned = config.world.dynamics != NONE
        # Figures and pictures are of the same images; retrieving reads all training episodes.
        self.drawn = functools.cache(self._draw)
        self.retrieved = functools.cache(self._retrieve)
        if self._planned and file.action_dim != len(loaded.world.action_low):
            raise ValueError(
                f"dynamics: takes actions of {len(loaded.world.action_low)} dimensions, those of "
                f"{file.path} have {file.action_dim}"
            )

    def episode(self, place: int) -> dict[str, Any]:
        """The record of an episode, JSON's types; writes its strip."""
        episode = self._episodes[place]
        found: dict[str, Any] = {"episode": self._numbers[place], "steps": len(episode.actions)}
        if self._planned and self._loaded.generator is not None:
            found |= self._strip(place)
        if self._planned:
            found["prediction"] = self._prediction(place)
        if self._loaded.generator is not None and len(self._episodes) > 1:
            frames = [each.frames for each in self._episodes]
            shown = {"drawn": self.drawn(place), "copied": episode.frames[:1]}
            if self._training is not None:
                shown["retrieved"] = self.retrieved(place)
            found["scene"] = {
                name: scene_figures(images, place, frames) for name, images in shown.items()
            }
            found["true_spread"] = spread(episode.frames)
        return found

    def _draw(self, place: int) -> Images:
        """Images that the generator draws for an episode's first frame."""
        generator, world = self._loaded.generator, self._loaded.world
        assert generator is not None
        rng = np.random.default_rng([self._config.seed, self._numbers[place]])
        latents = rng.standard_normal((self._config.draws, 1, generator.latent_dim))
        first = self._episodes[place].frames[:1]
        scene = observed(world, first) if self._planned else first
        return images_of(generator.decode(scene, latents.astype(np.float32)), world)

    def _retrieve(self, place: int) -> Images:
        """Frames of the most similar training episode."""
        assert self._training is not None
        first, draws = self._episodes[place].frames[0], self._config.draws
        seed = [self._config.seed, self._numbers[place], 1]
        return retrieved(self._known, self._training, first, draws, seed)

    def pictures(self) -> None:
        """Samples, and predictions, of the first episodes."""
        shown = range(min(_SHOWN, len(self._episodes)))
        if self._loaded.generator is not None:
            rows = []
            for place in shown:
                frames = self._episodes[place].frames
                times = np.linspace(0, len(frames) - 1, 4).astype(np.int64)
                parts = [frames[times], self.drawn(place)[:6]]
                if self._training is not None:
                    parts.append(self.retrieved(place)[:2])
                rows.append(np.concatenate(parts))
            write_png(self._config.out / "samples.png", frame_grid(rows, zoom=2))
        if self._planned:
            rows = []
            for place in shown:
                frames, drawn = self._predicted(place)
                times = np.linspace(0, len(drawn) - 1, min(8, len(drawn))).astype(np.int64)
                rows += [frames[times + 1], drawn[times]]
            write_png(self._config.out / "predictions.png", frame_grid(rows, zoom=2))

    def _strip(self, place: int) -> dict[str, Any]:
        config, episode, number = self._config, self._episodes[place], self._numbers[place]
        ends = 0, len(episode.frames) - 1
        found = episode.search(self._loaded, config.planning, ends, config.subgoals, config.seed)
        if self._training is not None:
            near = nearest_frames(self._known, self._training, found.subgoals)
            found = dataclasses.replace(found, nearest=near)
        found.write(config.out / f"episode-{number}.png")
        return found.costs

    def _prediction(self, place: int) -> dict[str, Any]:
        """PSNR and SSIM by steps ahead, of predicted frames and of the start copied."""
        world, config = self._loaded.world, self._config
        number, context = self._numbers[place], context_of(world)
        horizon = min(config.steps_ahead, len(self._episodes[place].actions) - context + 1)
        if horizon < 1:
            return {}
        windows = read_windows(self._file, [number], config.windows, horizon, context)
        drawn = predict(world, windows.past, windows.actions, windows.past_actions)
        return image_figures(drawn, windows, [horizon])

    def _predicted(self, place: int) -> tuple[Images, NDArray[np.uint8]]:
        """All frames of an episode, and what the dynamics predict from its first one."""
        episode, world = self._episodes[place], self._loaded.world
        return episode.frames, predict(world, episode.frames[:1], episode.actions[None])[0]


def summary(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over episodes, JSON's types.

    Returns:
        ``episodes``; with plans, ``hardest_segment``, ``without_subgoals`` and the part of episodes
        in which the first is ``easier``; with predictions, PSNR and SSIM by steps ahead; with
        drawn images, ``scene`` by where they come from, ``true_spread`` and ``chance``.
    """
    found: dict[str, Any] = {"episodes": len(records)}
    planned = [record for record in records if "segment_costs" in record]
    if planned:
        hardest = np.array([max(record["segment_costs"]) for record in planned])
        direct = np.array([record["cost_without_subgoals"] for record in planned])
        found["hardest_segment"] = float(hardest.mean())
        found["without_subgoals"] = float(direct.mean())
        found["easier"] = float((hardest < direct).mean())
    predicted = [record["prediction"] for record in records if record.get("prediction")]
    if predicted:
        found["prediction"] = {
            name: _by_steps([figures[name] for figures in predicted])
            for name in predicted[0]
            if not name.startswith("st_lpips")
        }
    scenes = [record["scene"] for record in records if "scene" in record]
    if scenes:
        found["scene"] = {
            name: mean_figures([scene[name] for scene in scenes]) for name in scenes[0]
        }
        found["true_spread"] = float(np.mean([record["true_spread"] for record in records]))
        found["chance"] = 1 / len(records)
    return found


def _by_steps(rows: Sequence[Sequence[float]]) -> list[float]:
    """Means over episodes, of those that are long enough."""
    return [
        float(np.mean([row[step] for row in rows if step < len(row)]))
        for step in range(max(map(len, rows)))
    ]


def _held_out(file: EpisodeReader, count: int) -> list[int]:
    """Numbers of the episodes to report on."""
    if training_episodes(file) is None:
        numbers = range(len(file))
    else:
        numbers = episodes_of("validation", file.metadata)
    chosen = np.linspace(0, len(numbers) - 1, min(count, len(numbers))).astype(np.int64)
    return [numbers[place] for place in chosen]


def _load(domain: Domain, config: VideoReport) -> Loaded:
    world = config.world
    if world.dynamics == NONE:
        return load_generator(domain, world.generator)
    return load_for(domain, world, config.planning, generator=world.generator != NONE)


def _head(
    domain: Domain,
    config: VideoReport,
    loaded: Loaded,
    file: EpisodeReader,
    known: EpisodeReader,
) -> dict[str, Any]:
    """All that a report is a function of, but the number of its episodes; JSON's types."""
    settings = dataclasses.asdict(config)
    for name in ("data", "train_data", "episodes", "out", "overwrite"):
        del settings[name]
    # Models stand for themselves, by their weights, wherever their files are.
    settings["world"] = {"cost": config.world.cost, **config.world.computing}
    head = {
        "format": FORMAT,
        "domain": domain.name,
        "data": dataclasses.asdict(file.metadata),
        "train_data": dataclasses.asdict(known.metadata),
        "weights": {
            part: {"model": weights.model, "sha256": weights.sha256}
            for part, weights in loaded.weights.items()
        },
        "settings": settings,
        "code": code_of(),
    }
    plain: dict[str, Any] = json.loads(json.dumps(head))
    return plain


def _finished(config: VideoReport, head: Mapping[str, Any]) -> dict[int, dict[str, Any]]:
    """Records that an earlier run of the same report has made."""
    path = config.out / "report.json"
    if config.overwrite or not path.exists():
        return {}
    again = "choose another out, or overwrite"
    try:
        earlier = json.loads(path.read_text())
        records = {int(record["episode"]): record for record in earlier["episodes"]}
        differing = [key for key in head if key != "code" and earlier.get(key) != head[key]]
        same = same_code(earlier["code"], head["code"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FileExistsError(f"{path}: holds something else; {again}") from error
    if differing:
        raise FileExistsError(f"{path}: holds another report (other {differing[0]}); {again}")
    if not same:
        raise FileExistsError(f"{path}: was begun by other code; {again}")
    return records


def _save(
    out: Path, head: Mapping[str, Any], done: Mapping[int, Any], held_out: Sequence[int]
) -> dict[str, Any]:
    records = [done[number] for number in held_out if number in done]
    written = {**head, "summary": summary(records), "episodes": records}
    write_bytes(out / "report.json", (json.dumps(written, indent=1) + "\n").encode())
    return written
