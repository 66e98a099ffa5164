"""``hvf train NAME``: models from recorded episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import tyro

from hvf.registry import MODELS


def recipe_class(name: str) -> type[Any]:
    """The :class:`~hvf.training.recipe.Recipe` of the model ``name``: the options of training it.

    Raises:
        ValueError: no such model, or one that is not trained here.
    """
    from hvf.training.recipe import recipe_class as found  # torch, which takes a second

    return found(name)


def trainable() -> list[str]:
    """Names of the models that can be trained here; imports none of them."""
    return [name for name in MODELS if MODELS[name].recipe is not None]


def train(name: str, recipe: Any) -> None:
    """Train a model, or go on with a run that was stopped."""
    from hvf.training.recipe import run

    run(recipe)


def prepare(command: Callable[..., Any], words: Sequence[str]) -> Callable[..., Any]:
    """The command with the options of the model that ``words`` names, and its preset filled in.

    Without a model, the command shows which there are.
    """
    names = trainable()
    chosen = words[0] if words and words[0] in names else None
    if chosen is None:
        return _which(names)
    kind = recipe_class(chosen)
    preset = _preset(words, list(kind.presets))
    default = kind.of(preset, data=tyro.MISSING)

    def prepared(name: Any, recipe: Any = default) -> Any:
        return command(name, recipe)

    presets = ", ".join(["default", *kind.presets])
    prepared.__doc__ = (
        f"{MODELS[chosen].about}\n\nCtrl-C stops; the same command goes on from there. "
        f"Presets: {presets}. Example: hvf train {chosen} --data data/episodes.h5"
    )
    prepared.__annotations__ = {
        "name": _one_of([chosen]),
        "recipe": Annotated[kind, tyro.conf.arg(name="")],
    }
    return prepared


def _which(names: Sequence[str]) -> Callable[..., Any]:
    """A command that takes the name of a model, and is never run: it explains."""

    def which(name: Any) -> None: ...

    listed = "\n\n".join(f"{name}: {MODELS[name].about}" for name in names)
    which.__doc__ = f"Train a model; hvf train NAME --help lists its options.\n\n{listed}"
    which.__annotations__ = {"name": _one_of(names)}
    return which


def _one_of(names: Sequence[str]) -> Any:
    """The type of a positional argument that is one of ``names``."""
    literal: Any = Literal
    return Annotated[literal[tuple(names)], tyro.conf.Positional]


def _preset(words: Sequence[str], presets: Sequence[str]) -> str:
    """The last of the presets named; the recipe refuses one that there is not."""
    found = "default"
    for word, following in zip(words, [*words[1:], ""], strict=True):
        option, equals, value = word.partition("=")
        if option == "--preset":
            value = value if equals else following
            found = value if value in presets else found
    return found
