"""``hvf train MODEL``: models from recorded episodes."""

from __future__ import annotations

from collections.abc import Sequence

import tyro

from hvf.cli.arguments import asked, named, parsed
from hvf.registry import MODELS


def run(words: Sequence[str]) -> None:
    """Train a model, or go on with a run that was stopped."""
    name, rest = named("train", MODELS, words)
    from hvf.training.recipe import recipe_class, run  # torch, which takes a second

    recipe = recipe_class(name)
    preset = asked(rest, "preset", "default")
    about = (
        f"{MODELS[name].about}\n\nAssumes: {MODELS[name].assumes}.\n\n"
        "Ctrl-C stops; the same command goes on from there. "
        f"Presets: {', '.join(['default', *recipe.presets])}. "
        f"Example: hvf train {name} --data data/episodes.h5"
    )
    default = recipe.of(preset, data=tyro.MISSING)
    run(parsed(recipe, f"train {name}", rest, prefixes=True, default=default, description=about))
