"""A recipe says how one model is trained; one driver runs all of them.

A recipe is a frozen dataclass, and its fields are the options of ``hvf train NAME``. Its
:meth:`Recipe.stages` is a generator of :class:`Stage`s, each of which is trained by the one loop
(:func:`hvf.training.loop.train`) and sent back to it: a model of one part is one stage, a model
whose cell learns from what its perception sees is two. To train a model of your own::

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class MineRecipe(Recipe):
        name: ClassVar[str] = "mine"
        batch_size: int = 16

        def stages(self, data: TrainingData) -> Stages:
            pool = data.pool(memory_gb=2.0)
            model = seeded(self.loop.seed, lambda: Mine(MineConfig(data.image_size)))
            yield Stage(model, PairSampler(pool, self.batch_size, self.loop.seed), self.loop)

and name it in the model's entry (``ModelEntry(recipe=MineRecipe)``).

**Presets** are named sets of settings, ``{"paper": {"batch_size": 256, "loop.steps": 100_000}}``. A
name with dots is a field of a field; a value for a dataclass may be the whole dataclass, or a
mapping to some of its fields. The command line and :func:`train` read settings the same way.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeAlias, TypeVar

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TimeElapsedColumn
from torch import nn

from hvf.action_box import Box, box_around, extremes
from hvf.data.loader import EpisodePool
from hvf.data.splits import Split, episodes_of
from hvf.registry import MODELS
from hvf.training.loop import LoopConfig, Sampler, Validation
from hvf.training.loop import train as train_stage


@dataclasses.dataclass(frozen=True)
class Stage:
    """A model, or a part of one, that is trained in one go.

    Attributes:
        model: freshly made with the loop's seed (:func:`hvf.training.loop.seeded`).
        sampler: where its batches come from.
        loop: how to optimise.
        about: what it is, in a line, said when it begins.
        folder: where it is kept, below the run's folder; the last stage's is the run's own, "".
        settings: what else its result is a function of, as JSON's types; a stage that is already
            there with others is refused.
        validate: measures it on held-out episodes (see :func:`hvf.training.loop.train`).
    """

    model: nn.Module
    sampler: Sampler
    loop: LoopConfig
    about: str = ""
    folder: str = ""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    validate: Callable[[Any, Any], Validation] | None = None


ConfigT = TypeVar("ConfigT")

Stages: TypeAlias = Generator[Stage, Any, None]
"""Stages, in order; each is sent back trained."""


class TrainingData:
    """The episodes that a run learns from, and those that it is measured on.

    Args:
        path: episodes, of any registered format.
        seed: of the order in which episodes pass through pools.
        console: where the phases are told.
        camera: whose frames to learn from; the first one's by default.

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, a single episode, or without this camera.

    Attributes:
        held_out: the validation episodes, in memory.
        metadata: where all of them come from.
    """

    def __init__(self, path: Path, seed: int, console: Console, camera: str | None = None) -> None:
        self.path = path
        self.console = console
        self.camera = camera
        self._seed = seed
        self._pools: list[EpisodePool] = []
        self.held_out = self._open("validation")
        self.held_out.move_to(0)
        self.metadata = self.held_out.metadata

    def __enter__(self) -> TrainingData:
        return self

    def __exit__(self, *_: object) -> None:
        for pool in self._pools:
            pool.close()

    @property
    def environment(self) -> str:
        """Name of the environment, or of whatever else the episodes were recorded in."""
        return self.metadata.environment

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the frames, pixels."""
        height, width = self.held_out.frames.shape[2:4]
        return int(height), int(width)

    @property
    def action_dim(self) -> int:
        """Action dimensions, ``A``."""
        return int(self.held_out.actions.shape[2])

    @property
    def largest_action(self) -> float | None:
        """Largest absolute number in an action, if the data tells the range of its actions."""
        low, high = self.metadata.action_low, self.metadata.action_high
        if low is None or high is None:
            return None
        return float(max(abs(number) for number in (*low, *high)))

    @property
    def action_box(self) -> Box:
        """Lowest and highest action, ``A`` numbers each: as the data tells, or as they were.

        Without a range in the data it is that of the validation episodes' actions, a little wider
        where a dimension never changes.
        """
        low, high = self.metadata.action_low, self.metadata.action_high
        if low is None or high is None:
            return box_around(*extremes(self.held_out.actions, self.held_out.lengths))
        return low, high

    @property
    def training(self) -> int:
        """Number of the episodes to learn from: the first ones of the file."""
        return len(episodes_of("train", self.metadata))

    def fitted(
        self, config: ConfigT, what: str = "the model cannot take its images", **sizes: Any
    ) -> ConfigT:
        """A model's ``config`` with the data's size of images, and with other ``sizes`` of it.

        Raises:
            ValueError: the config refuses them; says ``what`` that means.
        """
        try:
            return dataclasses.replace(config, image_size=self.image_size, **sizes)  # type: ignore[type-var]
        except ValueError as error:
            raise ValueError(f"{self.path}: {what}: {error}") from error

    def fitted_to_held(self, config: ConfigT, what: str) -> ConfigT:
        """The same with the data's actions, too, and with macro-steps as long as they are held.

        Raises:
            ValueError: as :meth:`fitted`, or episodes without actions.
        """
        low, high = self.action_box
        hold = int(self.metadata.parameters.get("action_repeat", getattr(config, "hold", 1)))
        return self.fitted(config, what, action_low=low, action_high=high, hold=hold)

    def square(self, model: str) -> int:
        """Height and width of the frames, for a ``model`` that takes square ones only.

        Raises:
            ValueError: they are not square.
        """
        height, width = self.image_size
        if height != width:
            raise ValueError(
                f"{self.path}: frames are {self.image_size}, {model} takes square ones"
            )
        return height

    def pool(self, memory_gb: float = 2.0) -> EpisodePool:
        """A pool of the episodes to learn from, closed when the run ends."""
        return self._open("train", memory_gb)

    @contextlib.contextmanager
    def phase(self, about: str) -> Iterator[None]:
        """Say that something that is no stage begins, and on a terminal that it goes on."""
        self.console.print(about, highlight=False)
        if not self.console.is_terminal:
            yield
            return
        with Progress(
            SpinnerColumn(), TimeElapsedColumn(), console=self.console, transient=True
        ) as spinner:
            spinner.add_task("", total=None)
            yield

    def _open(self, split: Split, memory_gb: float = 2.0) -> EpisodePool:
        pool = EpisodePool(
            self.path, split, memory_gb=memory_gb, seed=self._seed, camera=self.camera
        )
        self._pools.append(pool)
        return pool


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recipe:
    """What every training has to know.

    Attributes:
        data: episodes, of any registered format.
        camera: whose frames to learn from; the first one's by default.
        out: directory of the run, by default below ``runs`` and named after model and preset; a
            run that is already there is continued.
        preset: name of the settings that the others began with.
        loop: how to optimise.
    """

    name: ClassVar[str]
    """The model's name in :data:`hvf.registry.MODELS`."""
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Settings by name; ``default`` is none."""

    data: Path
    camera: str | None = None
    out: Path | None = None
    preset: str = "default"
    loop: LoopConfig = LoopConfig()

    def __post_init__(self) -> None:
        if self.preset != "default" and self.preset not in self.presets:
            names = ", ".join(["default", *self.presets])
            raise ValueError(f"preset: must be one of {names}; got {self.preset!r}")

    @property
    def folder(self) -> Path:
        """Directory of the run."""
        name = self.name if self.preset == "default" else f"{self.name}-{self.preset}"
        return Path("runs", name) if self.out is None else self.out

    def stages(self, data: TrainingData) -> Stages:
        """What to train, in order; the last stage's model is the result.

        Raises:
            ValueError: data that the model cannot be trained on.
        """
        raise NotImplementedError

    def at_least_one(self, *names: str) -> None:
        """Raise ValueError if one of these fields is below 1."""
        for name in names:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")

    def positive(self, *names: str) -> None:
        """Raise ValueError if one of these fields is not a finite number above 0."""
        for name in names:
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    @classmethod
    def of(cls, preset: str, **settings: Any) -> Any:
        """The recipe with a preset, and with ``settings`` on top of it. Paths may be words.

        Raises:
            ValueError: no such preset or setting, or a value that a recipe refuses.
            TypeError: no data.
        """
        if preset != "default" and preset not in cls.presets:
            names = ", ".join(["default", *cls.presets])
            raise ValueError(f"preset: must be one of {names}; got {preset!r}")
        if "data" not in settings:
            raise TypeError(f"data: the recipe of {cls.name!r} needs a file of episodes")
        for field in dataclasses.fields(cls):
            path = field.name in ("data", "out") or isinstance(field.default, Path)
            if path and isinstance(settings.get(field.name), str):
                settings[field.name] = Path(settings[field.name])
        recipe = cls(data=settings.pop("data"), preset=preset)
        return with_settings(with_settings(recipe, cls.presets.get(preset, {})), settings)


def with_settings(config: ConfigT, settings: Mapping[str, Any]) -> ConfigT:
    """A copy of a dataclass with some settings replaced; see the module's documentation.

    Raises:
        ValueError: a field that there is not, or a value that the dataclass refuses.
    """
    kind = type(config).__name__
    names = {field.name for field in dataclasses.fields(config)}  # type: ignore[arg-type]
    changed: dict[str, Any] = {}
    inside: dict[str, dict[str, Any]] = {}
    for key, value in settings.items():
        name, _, rest = key.partition(".")
        if name not in names:
            raise ValueError(f"{kind} has no setting {name!r}; it has {', '.join(sorted(names))}")
        if rest:
            inside.setdefault(name, {})[rest] = value
        elif isinstance(value, Mapping) and dataclasses.is_dataclass(getattr(config, name)):
            inside.setdefault(name, {}).update(value)
        else:
            changed[name] = value
    # All fields of a field at once: one alone may not fit the others as they were.
    for name, fields in inside.items():
        before = changed.get(name, getattr(config, name))
        if not dataclasses.is_dataclass(before):
            raise ValueError(f"{kind}.{name} has no setting {next(iter(fields))!r}, nor any other")
        changed[name] = with_settings(before, fields)
    return dataclasses.replace(config, **changed)  # type: ignore[type-var]


def recipe_class(name: str) -> type[Recipe]:
    """The recipe of the model of this name in :data:`hvf.registry.MODELS`.

    Raises:
        ValueError: no such model, or one that is not trained here; names those that are.
    """
    entry = MODELS[name]
    if entry.recipe is None:
        raise ValueError(f"model: {name!r} has no recipe, so it cannot be trained here")
    found: type[Recipe] = entry.resolved("recipe")
    return found


def run(recipe: Recipe, console: Console | None = None) -> nn.Module:
    """Train a model by its recipe, or go on with the run in the recipe's folder.

    Returns:
        The trained model, in evaluation mode, as ``model.safetensors`` in the folder has it.

    Raises:
        FileNotFoundError: no data file, or no model that the recipe needs.
        ValueError: damaged data, data that the model cannot take, or another run in the folder.
        RuntimeError: the loss is NaN or infinite.
        OSError: the folder cannot be written to.
        KeyboardInterrupt: stopped; the same call goes on from there.
    """
    console = console or Console()
    with contextlib.ExitStack() as run_through:
        data = run_through.enter_context(
            TrainingData(recipe.data, recipe.loop.seed, console, recipe.camera)
        )
        identity = {
            "command": f"hvf train {recipe.name}",
            "preset": recipe.preset,
            "data": dataclasses.asdict(data.metadata),
            **({} if recipe.camera is None else {"camera": recipe.camera}),
        }
        stages = run_through.enter_context(contextlib.closing(recipe.stages(data)))
        trained: nn.Module | None = None
        while True:
            try:
                stage = stages.send(trained)
            except StopIteration:
                break
            if stage.about:
                console.print(stage.about, highlight=False)
            trained = train_stage(
                stage.model,
                stage.sampler,
                stage.loop,
                recipe.folder / stage.folder,
                environment=data.environment,
                run={**identity, **stage.settings},
                validate=stage.validate,
                console=console,
            )
    if trained is None:
        raise TypeError(f"{type(recipe).__name__} has no stage")
    return trained


def train(
    name: str,
    data: str | Path,
    *,
    preset: str = "default",
    console: Console | None = None,
    **settings: Any,
) -> nn.Module:
    """Train the model ``name`` on a file of episodes, as ``hvf train NAME`` does.

    Args:
        name: in :data:`hvf.registry.MODELS`: ``"cvae"``, ``"keypoint"``, ...
        data: file of episodes.
        preset: settings to begin with.
        console: where progress goes.
        settings: of the recipe, on top of the preset: ``out="runs/mine"``,
            ``loop={"steps": 100}``, or ``**{"loop.steps": 100}``.

    Returns:
        The trained model, in evaluation mode.

    Raises:
        As :func:`run`; ValueError for a name, preset or setting that there is not.
    """
    return run(recipe_class(name).of(preset, data=Path(data), **settings), console)
