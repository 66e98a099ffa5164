"""The package from Python: load, evaluate, train."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvf.evaluation.evaluation import Evaluation
from hvf.evaluation.report import Report
from hvf.protocols import SubgoalModel, WorldModel
from hvf.registry import DOMAINS

if TYPE_CHECKING:
    from rich.console import Console
    from torch.nn import Module


def load(
    domain: str, preset: str = "default", *, task: str | None = None, **settings: Any
) -> tuple[WorldModel[Any], SubgoalModel[Any] | None]:
    """The world model and the subgoal generator of a domain, ready to plan with.

    Args:
        domain: name of the domain.
        preset: settings to begin with.
        task: of which the true dynamics are, where these depend on it: in the maze a layout.
        settings: of the world and its cost: ``dynamics``, ``generator``, ``cost``, ``blur``,
            ``over_horizon``, ... (see :class:`hvf.settings.World`, :class:`hvf.settings.Planning`).

    Returns:
        World and generator; no generator for dynamics that cannot start from a drawn subgoal.

    Raises:
        FileNotFoundError: weights that are not there.
        ValueError: a name that there is not, or a setting out of range.
        TypeError: a setting that there is not.
    """
    from hvf.worlds.load import load as load_world

    place = DOMAINS[domain]
    chosen = place.preset(preset).changed(settings)
    # Not an evaluation: a domain of recorded video has no tasks.
    draws = place.resolved(chosen.world).dynamics not in place.privileged
    opened = place.open()
    try:
        here = opened
        if task is not None:
            place.check_task(task)
            here = opened.of_task(task)
        loaded = load_world(place, chosen.world, chosen.planning, here, generator=draws)
    finally:
        if draws:
            # A simulator goes on running behind its world, until the program ends.
            opened.close()
    return loaded.world, loaded.generator


def evaluate(
    domain: str,
    preset: str = "default",
    *,
    trials: int = 100,
    out: str | Path | None = None,
    workers: int = 0,
    console: Console | None = None,
    **settings: Any,
) -> Report:
    """Success of a method on the first episodes of a split; what ``hvf eval`` does.

    ``hvf.evaluate("maze", method="hvf", subgoals=2, trials=20).success_rate``

    Args:
        domain: name of the domain.
        preset: settings to begin with.
        trials: episodes.
        out: JSON file to write, and to go on from.
        workers: processes that simulate and draw, for domains that have any.
        console: where progress goes.
        settings: of :class:`hvf.evaluation.Evaluation` and its parts: ``task``, ``method``,
            ``subgoals``, ``split``, ``dynamics``, ``samples``, ...

    Raises:
        FileNotFoundError, FileExistsError, ValueError, TypeError: as
            :func:`hvf.evaluation.run.evaluate`.
    """
    from hvf.evaluation.run import evaluate as run

    evaluation = Evaluation.of(domain, preset, **settings)
    file = None if out is None else Path(out)
    return run(evaluation, trials, file, workers=workers, console=console)


def train(model: str, data: str | Path, /, **settings: Any) -> Module:
    """Train a model on a file of episodes, or go on with the run; what ``hvf train`` does.

    Args:
        model: name of the model, see ``hvf.MODELS``.
        data: file of episodes.
        settings: of the model's recipe: ``out``, ``loop``, ``model``, ``preset``, ...

    Raises:
        FileNotFoundError, ValueError, TypeError: as :func:`hvf.training.recipe.train`.
    """
    from hvf.training.recipe import train as run

    trained: Module = run(model, data, **settings)
    return trained
