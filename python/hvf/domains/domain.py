"""A domain: what every command asks of a place to plan in.

A new domain is one object of this class, registered in ``hvf.registry.DOMAINS`` or by an entry
point of the group ``hvf.domains``. It is light: simulators start in :meth:`Domain.open`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hvf.closing import Closing
from hvf.protocols import SubgoalModel, Trials, WorldModel
from hvf.registry import MODELS
from hvf.settings import Planning, Preset, World


class Place(Closing):
    """A domain that is open: it makes trials, and holds what simulates them.

    This class is a place without trials and without a simulator, such as recorded video.
    """

    def trials(self, task: str, seed: int, first: int, count: int) -> Trials:
        """Fresh trials of the episodes ``first..first + count`` of a seed.

        Raises:
            ValueError: there are none here.
        """
        raise ValueError("domain: has no episodes to act in, only recorded ones")

    def of_task(self, task: str) -> Place:
        """The place as a task has it, where true dynamics depend on the task; else itself."""
        return self

    def simulator(self, planning: Planning) -> WorldModel[Any]:
        """True dynamics as a world model.

        Raises:
            ValueError: there are none here.
        """
        raise ValueError("dynamics: 'simulator' is not available here; name a learned model")

    def oracle(self) -> SubgoalModel[Any]:
        """What draws true states as subgoals.

        Raises:
            ValueError: there is none here.
        """
        raise ValueError("generator: 'oracle' is not available here; name a learned model")

    def close(self) -> None:
        """Stop what runs."""


class MoreTasks(Protocol):
    """Tasks beyond those that a domain lists: of names with a number in them, or of files."""

    option: str
    """Another name of the option ``--task`` on the command line."""
    about: str
    """What may be named, in a line."""

    def steps(self, task: str) -> int:
        """Steps of an episode of a task.

        Raises:
            ValueError, FileNotFoundError: there is no such task.
        """
        ...

    def parts(self, task: str) -> Mapping[str, str]:
        """What takes part in a task that reports should name, by its part."""
        ...


Published = Mapping[tuple[str, int], Mapping[str, float]]
"""Method and number of subgoals to success by task, as fractions."""


@dataclass(frozen=True)
class Domain:
    """A place to plan in.

    Attributes:
        name: its name.
        about: what it is, in a line.
        open_with: makes the open place, from a number of processes (0 for as many as cores).
        action_low: lowest action, ``A`` numbers; none where nothing is acted, and the dynamics say.
        action_high: highest action.
        tasks: name to steps of an episode (T), the default task last; none for recorded video.
        more_tasks: tasks beyond these, if there are any.
        task_word: what the paper calls them: "difficulty", "task".
        presets: plan settings by name; "default" is one of them.
        weights: checkpoints that ship, by the names that settings use for them.
        generators: which generator goes with which dynamics, by name, if it is not said. Dynamics
            from a file go by the model that it holds.
        video_generator: which goes with video models that are not among these; None for none.
        distances: which distance in steps goes with which dynamics, by name.
        privileged: dynamics that start from true states: no image gives these.
        published: success rates that Nair & Finn (ICLR 2020) give in numbers, 100 trials each.
        published_kind: how tables name the rows of these.
        collection: the config dataclass of ``hvf collect``, with ``run(console)``; None if nothing
            can be collected. ``"module:attribute"``, imported when asked for, or the class.
        experiments: its tables for ``hvf paper``: a function from
            :class:`~hvf.experiments.cells.Setup` to a list of
            :class:`~hvf.experiments.cells.PaperTable`, or ``"module:attribute"``; None for none.
        groups: names of what a position probe reads, to slices of the recorded states.
        slow: whether a single trial takes so long that progress and results go by trial.
        demo: settings that ``hvf demo`` begins with.
    """

    name: str
    about: str
    open_with: Callable[[int], Place]
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    tasks: Mapping[str, int] = field(default_factory=dict)
    more_tasks: MoreTasks | None = None
    task_word: str = "task"
    presets: Mapping[str, Preset] = field(default_factory=lambda: {"default": Preset(Planning())})
    weights: Mapping[str, Path] = field(default_factory=dict)
    generators: Mapping[str, str] = field(default_factory=dict)
    video_generator: str | None = None
    distances: Mapping[str, str] = field(default_factory=dict)
    privileged: tuple[str, ...] = ()
    published: Published = field(default_factory=dict)
    published_kind: str = "video"
    collection: str | type[Any] | None = None
    experiments: str | Callable[[Any], list[Any]] | None = None
    groups: Mapping[str, slice] = field(default_factory=dict)
    slow: bool = False
    demo: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if "default" not in self.presets:
            raise ValueError(f"presets: {self.name} must have one that is called 'default'")
        boxed = len(self.action_low) > 0 or not self.tasks
        if len(self.action_low) != len(self.action_high) or not boxed:
            raise ValueError("action_low: must have as many dimensions as action_high, at least 1")

    @property
    def action_box(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lowest and highest action, float32 ``[A]`` each."""
        return np.array(self.action_low, np.float32), np.array(self.action_high, np.float32)

    @property
    def default_task(self) -> str:
        """The task that is meant if none is named: the last, the hardest."""
        return list(self.tasks)[-1] if self.tasks else ""

    def preset(self, name: str) -> Preset:
        """Settings by name.

        Raises:
            ValueError: there is no such preset.
        """
        if name not in self.presets:
            names = ", ".join(map(repr, self.presets))
            raise ValueError(f"preset: must be one of {names}, got {name!r}")
        return self.presets[name]

    def check_task(self, task: str) -> None:
        """Refuse a task that there is not.

        Raises:
            ValueError: it is so, or there are no tasks at all.
            FileNotFoundError: it is to be read from a file that is not there.
        """
        self.steps(task)

    def steps(self, task: str) -> int:
        """Steps of an episode of a task (T).

        Raises:
            ValueError, FileNotFoundError: as :meth:`check_task`.
        """
        if not self.tasks:
            raise ValueError(
                f"domain: {self.name} has no episodes to act in; `hvf plan {self.name}` and "
                "`hvf subgoals` work on its recorded ones"
            )
        if task in self.tasks:
            return self.tasks[task]
        if self.more_tasks is not None:
            return self.more_tasks.steps(task)
        words = ", ".join(self.tasks)
        raise ValueError(f"task: must be one of {words}; got {task!r}")

    def parts(self, task: str) -> Mapping[str, str]:
        """What takes part in a task that reports should name, by its part."""
        if task in self.tasks or self.more_tasks is None:
            return {}
        return self.more_tasks.parts(task)

    def open(self, workers: int = 0) -> Place:
        """Start what simulates it.

        Args:
            workers: processes, 0 for as many as there are cores; results do not depend on it.

        Raises:
            RuntimeError: what it needs is not there (MuJoCo, OpenGL); says how to get it.
        """
        if workers < 0:
            raise ValueError(f"workers: must not be negative, got {workers}")
        return self.open_with(workers)

    def resolved(self, world: World) -> World:
        """``world`` with its defaults named."""
        dynamics, generator = world.dynamics, world.generator
        if dynamics == "default":
            dynamics = self.presets["default"].world.dynamics
        if generator == "default":
            generator = self._generator_for(dynamics)
        return dataclasses.replace(world, dynamics=dynamics, generator=generator)

    def model_of(self, name: str) -> str:
        """The kind of model that a name stands for, or a checkpoint holds: its name in ``MODELS``.

        What is neither, or cannot be read, is what it is called: loading it says what is wrong.
        """
        path = self.weights.get(name, Path(name))
        if name in MODELS or not path.is_file():
            return name
        from hvf.models.checkpoint import entry_of, read_header  # torch, only where there is a file

        try:
            header = read_header(path)
            return entry_of(header.model, header.package)[0]
        except (ValueError, OSError):
            return name

    def _generator_for(self, dynamics: str) -> str:
        """The generator that goes with dynamics, or ``"default"`` where there is none."""
        if dynamics in self.generators:
            return self.generators[dynamics]
        model = self.model_of(dynamics)
        if model in self.generators:
            return self.generators[model]
        if model in MODELS and self.video_generator is not None:
            entry = MODELS[model]
            if (entry.role, entry.kind) == ("dynamics", "video"):
                return self.video_generator
        return "default"
