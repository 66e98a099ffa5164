"""What verbs share: a name first, options generated from a dataclass, presets as their defaults."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import itertools
import re
import sys
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any, TypeVar, cast

import tyro
from rich.console import Console
from rich.markup import escape

from hvf.domains.domain import Domain
from hvf.evaluation.evaluation import Evaluation
from hvf.registry import COSTS, DOMAINS, METHODS, Registry

ConfigT = TypeVar("ConfigT")


def named(
    verb: str,
    registry: Registry[Any],
    words: Sequence[str],
    about: Callable[[Any], str] = attrgetter("about"),
) -> tuple[str, list[str]]:
    """The name that the words begin with, and the rest; without a name, say which there are.

    Args:
        verb: for messages.
        registry: what may be named.
        words: the command line after the verb.
        about: says what a thing is, in a line.

    Raises:
        ValueError: a name that there is not.
        SystemExit: help was asked for, or nothing at all.
    """
    if words and not words[0].startswith("-"):
        if words[0] not in registry:
            registry[words[0]]  # raises, naming those that there are
        return words[0], list(words[1:])
    helping = any(word in ("-h", "--help") for word in words)
    console = Console(stderr=not helping)
    console.print(
        f"usage: hvf {verb} {registry.kind.upper()} \\[options]; "
        f"hvf {verb} {registry.kind.upper()} --help lists the options\n",
        highlight=False,
    )
    for name in registry:
        console.print(
            f"  [bold]{name:18}[/bold] {escape(_about(registry, name, about))}", highlight=False
        )
    raise SystemExit(0 if helping else 2)


def _about(
    registry: Registry[Any], name: str, about: Callable[[Any], str] = attrgetter("about")
) -> str:
    """What a name stands for, in a line; or why it stands for nothing.

    Another package's module may be missing: help on all others comes nevertheless.
    """
    try:
        return about(registry[name])
    except ImportError as error:
        return f"cannot be imported: {error}"


def domain_named(verb: str, words: Sequence[str]) -> tuple[Domain, list[str]]:
    """The domain that the words begin with, and the rest; see :func:`named`."""
    name, rest = named(verb, DOMAINS, words)
    domain = DOMAINS[name]
    words_for_task = {domain.task_word}
    # Collections have an option of that name themselves.
    if domain.more_tasks is not None and verb != "collect":
        words_for_task.add(domain.more_tasks.option)
    for word_for_task in words_for_task - {"task"}:
        rest = [_renamed(word, f"--{word_for_task}", "--task") for word in rest]
    return domain, rest


def parsed(
    config: type[ConfigT],
    verb: str,
    words: Sequence[str],
    prefixes: bool = False,
    **settings: Any,
) -> ConfigT:
    """A config from the command line.

    Args:
        config: its class; a dataclass, whose docstring is the help.
        verb: with the name that follows it, for the usage line.
        words: the rest of the command line.
        prefixes: whether options of inner dataclasses are called ``--loop.steps``, not ``--steps``.
        settings: keywords of :func:`tyro.cli`: ``default``, ``description``.

    Raises:
        SystemExit: help was asked for, or there is no such option.
        ValueError: a value that the config refuses.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            made: ConfigT = tyro.cli(
                config,
                prog=f"hvf {verb}",
                args=list(words),
                config=() if prefixes else (tyro.conf.OmitArgPrefixes,),
                **settings,
            )
    except SystemExit:
        refused = _refused(said.getvalue())
        if refused is not None:
            raise ValueError(refused) from None
        raise
    finally:
        if _refused(said.getvalue()) is None:
            sys.stderr.write(said.getvalue())
    return made


def _refused(text: str) -> str | None:
    """The line in which tyro tells of a value that cannot be, taken out of its box; None if none.

    The config's own words are enough: they name the argument.
    """
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
    lines = [line.strip("╭╮╰╯│─ ") for line in plain.splitlines()]
    if lines[:1] != ["Value error"]:
        return None
    # Rules are above and below; without Unicode they are dashes.
    lines = list(itertools.dropwhile(lambda line: not line.strip("-"), lines[1:]))
    message = " ".join(itertools.takewhile(lambda line: line.strip("-"), lines))
    return re.sub(r"^Error parsing (\w+: )?", "", message)


def evaluating(
    config: type[ConfigT], verb: str, domain: Domain, words: Sequence[str], **own: Any
) -> ConfigT:
    """A config that has an ``evaluation``, with a preset of the domain as its defaults.

    The preset that is named fills in the defaults of all other options before these are parsed, so
    that ``--help`` shows what holds, and any single setting can be changed.

    Args:
        config: its class; a dataclass with a field ``evaluation``.
        verb: for the usage line.
        domain: whose presets.
        words: the command line after the domain.
        own: settings that the command begins with in place of the preset's: of the evaluation, or
            of the config itself.
    """
    preset = asked(words, "preset", "default")
    fields = {field.name for field in dataclasses.fields(config)}  # type: ignore[arg-type]
    mine = {name: value for name, value in own.items() if name in fields}
    rest = {name: value for name, value in own.items() if name not in fields}
    evaluation = Evaluation.of(domain.name, preset, **rest)
    default: Any = config(evaluation=evaluation, **mine)  # type: ignore[call-arg]
    about = (config.__doc__ or "").partition("\n\n    Attributes:")[0]
    return parsed(
        config,
        f"{verb} {domain.name}",
        words,
        default=default,
        description=f"{about}\n\n{choices(domain)}",
    )


def searching_with(
    config: type[ConfigT],
    verb: str,
    domain: Domain,
    words: Sequence[str],
    needed: Sequence[str],
) -> ConfigT:
    """A config of a search that acts in nothing, with a preset of the domain as its defaults.

    Args:
        config: its class; a dataclass with fields ``preset``, ``world`` and ``planning``.
        verb: for the usage line.
        domain: whose presets.
        words: the command line after the verb and its name.
        needed: fields that have no default.

    Raises:
        ValueError: the model of a method is named, but nothing acts.
    """
    preset = asked(words, "preset", "default")
    chosen = domain.preset(preset)
    missing = dict.fromkeys(needed, tyro.MISSING)
    default: Any = config(  # type: ignore[call-arg]
        preset=preset, world=chosen.world, planning=chosen.planning, **missing
    )
    about = (config.__doc__ or "").partition("\n\n    Attributes:")[0]
    lines = [f"preset {name}: {known.about}" for name, known in domain.presets.items()]
    description = "\n\n".join([about, *lines])
    made: Any = parsed(config, verb, words, default=default, description=description)
    if made.world.method_model is not None:
        raise ValueError("method_model: no method acts here, so none asks a model of its own")
    return cast(ConfigT, made)


def asked(words: Sequence[str], option: str, default: str) -> str:
    """What a command line says of an option that the defaults of the others depend on.

    A preset's settings are the defaults of all others, and its domain says which presets there are.
    """
    scanner = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    scanner.add_argument(f"--{option}", default=default, dest="said")
    return str(scanner.parse_known_args(list(words))[0].said)


def choices(domain: Domain) -> str:
    """What may be named in a domain, for help."""
    lines = [
        f"{domain.name}: {domain.about}.",
        f"tasks ({domain.task_word}): {', '.join(domain.tasks) or 'none'}",
        *_more(domain),
        *(f"preset {name}: {preset.about}" for name, preset in domain.presets.items()),
        *(f"method {name}: {_about(METHODS, name)}" for name in METHODS),
        f"dynamics and generators: {', '.join(domain.weights) or 'none ship'}, simulator, oracle, "
        "or a checkpoint",
        *(f"cost {name}: {_about(COSTS, name)}" for name in COSTS),
    ]
    return "\n\n".join(lines)


def _more(domain: Domain) -> list[str]:
    """What else may be named as a task."""
    more = domain.more_tasks
    return [] if more is None else [f"--{more.option}, in place of --task: {more.about}"]


def _renamed(word: str, old: str, new: str) -> str:
    """An option under another name."""
    return new + word[len(old) :] if word == old or word.startswith(f"{old}=") else word
