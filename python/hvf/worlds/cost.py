"""What a predicted frame costs, by name: light, so that commands can list them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hvf.importing import imported
from hvf.protocols import WorldModel
from hvf.settings import Planning


@dataclass(frozen=True)
class Cost:
    """A cost.

    Attributes:
        about: what it measures, in a line.
        target: makes a world with this cost from (world, model, planning): a function, or
            ``"module:attribute"``; None for what worlds measure by themselves, and for a cost
            ``in_steps``.
        model: the model that it asks, by its name among the domain's weights; None for none.
        in_steps: whether it is, in place of that, the distance in steps that goes with the
            dynamics (:attr:`hvf.domains.domain.Domain.distances`), whose entry makes the world.
    """

    about: str
    target: str | Callable[[Any, Any, Planning], WorldModel[Any]] | None = None
    model: str | None = None
    in_steps: bool = False

    @property
    def world(self) -> Callable[[Any, Any, Planning], WorldModel[Any]] | None:
        """The function, imported."""
        if isinstance(self.target, str):
            made: Callable[[Any, Any, Planning], WorldModel[Any]] = imported(self.target)
            return made
        return self.target


PIXEL = Cost("squared pixel distance of the predicted frame to the goal image (the paper's)")
LATENT = Cost(
    "squared distance in the latent of a VAE or CVAE (a table of the paper)",
    "hvf.worlds.distances:latent_world",
    "cvae",
)
TEMPORAL = Cost(
    "learned distance in steps of random play, of what an object model perceives",
    in_steps=True,
)
TDM = Cost(
    "how likely the predicted frame and the goal image are many steps apart (the paper's)",
    "hvf.worlds.distances:tdm_world",
    "tdm",
)
