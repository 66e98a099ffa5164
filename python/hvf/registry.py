"""Names to things: domains, models, methods and costs, each imported when it is asked for.

A thing of this package is listed here. One of another package registers itself when that is
imported (``hvf.registry.DOMAINS.register("toy", TOY)``), or by an entry point of its
``pyproject.toml``, which needs no import::

    [project.entry-points."hvf.domains"]
    toy = "my_package.domain:TOY"

The groups are ``hvf.domains``, ``hvf.models``, ``hvf.methods`` and ``hvf.costs``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Generic, TypeVar, cast

from hvf.importing import imported

if TYPE_CHECKING:
    from hvf.agents.method import Method
    from hvf.domains.domain import Domain
    from hvf.models.entry import ModelEntry
    from hvf.worlds.cost import Cost

T = TypeVar("T")


class Registry(Generic[T]):
    """Things of one kind by their names, in the order in which they were registered.

    Args:
        kind: what they are, for errors: ``"domain"``.
        group: group of entry points through which other packages add to them.
        targets: name to ``"module:attribute"``, imported when asked for.
    """

    def __init__(self, kind: str, group: str, targets: dict[str, str]) -> None:
        self.kind = kind
        self.group = group
        self._targets: dict[str, str | T] = dict(targets)
        self._scanned = False

    def register(self, name: str, target: str | T, *, replace: bool = False) -> None:
        """Add a thing, or ``"module:attribute"`` where it is.

        Raises:
            ValueError: the name is taken, and not to be replaced.
        """
        if name in self._found() and not replace:
            raise ValueError(f"{self.kind}: there is a {self.kind} {name!r} already")
        self._targets[name] = target

    def __contains__(self, name: object) -> bool:
        return name in self._found()

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self._found()))

    def __len__(self) -> int:
        return len(self._found())

    def __getitem__(self, name: str) -> T:
        """The thing of this name.

        Raises:
            ValueError: there is none; names those that there are.
            ImportError: it is another package's, and cannot be imported; names both.
        """
        found = self._found()
        if name not in found:
            raise ValueError(f"{self.kind}: must be one of {', '.join(found)}; got {name!r}")
        target = found[name]
        if isinstance(target, str):
            try:
                made = cast(T, imported(target))
            except Exception as error:  # whatever the module of another package comes to
                raise ImportError(f"{self.kind} {name!r} ({target}): {error}") from error
            self._targets[name] = target = made
        return target

    def importable(self) -> Iterator[T]:
        """All things but those of other packages that cannot be imported."""
        for name in self:
            with contextlib.suppress(ImportError):
                yield self[name]

    def _found(self) -> dict[str, str | T]:
        """All targets, with those of other packages' entry points."""
        if not self._scanned:
            self._scanned = True
            for point in entry_points(group=self.group):
                self._targets.setdefault(point.name, point.value)
        return self._targets


DOMAINS: Registry[Domain] = Registry(
    "domain",
    "hvf.domains",
    {
        "maze": "hvf.domains.maze:MAZE",
        "desk": "hvf.domains.desk:DESK",
        "video": "hvf.domains.video:VIDEO",
    },
)
"""Places to plan in."""

MODELS: Registry[ModelEntry] = Registry(
    "model",
    "hvf.models",
    {
        "keypoint": "hvf.models.catalogue:KEYPOINT",
        "keypoint-generator": "hvf.models.catalogue:KEYPOINT_GENERATOR",
        "temporal-distance": "hvf.models.catalogue:TEMPORAL_DISTANCE",
        "layers": "hvf.models.catalogue:LAYERS",
        "layers-generator": "hvf.models.catalogue:LAYERS_GENERATOR",
        "layers-proposals": "hvf.models.catalogue:LAYERS_PROPOSALS",
        "layers-distance": "hvf.models.catalogue:LAYERS_DISTANCE",
        "cvae": "hvf.models.catalogue:CVAE",
        "vae": "hvf.models.catalogue:VAE",
        "sv2p": "hvf.models.catalogue:SV2P",
        "sv2p-small": "hvf.models.catalogue:SV2P_SMALL",
        "spatial-latent": "hvf.models.catalogue:SPATIAL_LATENT",
        "tap": "hvf.models.catalogue:TAP",
        "tdm": "hvf.models.catalogue:TDM",
        "rig": "hvf.models.catalogue:RIG",
        "latent": "hvf.models.catalogue:LATENT",
    },
)
"""Kinds of learned models: what ``hvf train NAME`` trains and checkpoints hold."""

METHODS: Registry[Method] = Registry(
    "method",
    "hvf.methods",
    {
        "none": "hvf.agents.method:NONE",
        "hvf": "hvf.agents.method:HVF",
        "hvf-proposals": "hvf.agents.method:HVF_PROPOSALS",
        "amortised": "hvf.agents.method:AMORTISED",
        "tap": "hvf.agents.method:TAP",
        "ground-truth": "hvf.agents.method:GROUND_TRUTH",
        "rig": "hvf.agents.method:RIG",
        "random": "hvf.agents.method:RANDOM",
    },
)
"""What acts: where its subgoals come from, and how it chooses actions."""

COSTS: Registry[Cost] = Registry(
    "cost",
    "hvf.costs",
    {
        "pixel": "hvf.worlds.cost:PIXEL",
        "latent": "hvf.worlds.cost:LATENT",
        "temporal": "hvf.worlds.cost:TEMPORAL",
        "tdm": "hvf.worlds.cost:TDM",
    },
)
"""What a predicted frame costs."""
