"""What the program knows of a kind of learned model before one is loaded.

No torch here: a command that only lists models stays quick.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from hvf.importing import imported

Role: TypeAlias = Literal["dynamics", "generator", "proposals", "distance", "proposer", "policy"]
"""What a model is good for: predicting frames, drawing subgoals to search among, saying which of a
generator's latents lie on the way to a goal, measuring how far frames are, proposing subgoals
without a search, or acting without a plan."""


@dataclass(frozen=True)
class ModelEntry:
    """A kind of model.

    Targets are ``"module:attribute"``, imported when they are needed, or the thing itself.

    Attributes:
        about: what it is, in a line, for ``hvf train --help``.
        kind: what it may be compared with: a ``video`` model (assumes nothing of a scene but image
            size and action dimension) or an ``object`` model (knows the inventory of one scene).
        role: what it is good for.
        module: the ``torch.nn.Module``, with ``config_type``; checkpoints name its class.
        plannable: makes what the planner wants of a loaded module: ``plannable(module, planning)``
            for dynamics gives a :class:`~hvf.protocols.WorldModel`; ``plannable(module, world)``
            for a generator a :class:`~hvf.protocols.SubgoalModel`; ``plannable(module)`` for
            proposals :class:`~hvf.protocols.Proposals`; ``plannable(module, world, planning)``
            for a distance a :class:`~hvf.protocols.WorldModel` around ``world``, of which it is
            the cost (see :mod:`hvf.worlds.distances`);
            ``plannable(module)`` for a proposer a :class:`~hvf.protocols.Proposer`, for a policy
            a :class:`~hvf.protocols.Policy`.
        recipe: its :class:`~hvf.training.recipe.Recipe`; None if it is not trained here.
        assumes: what it takes for granted about a scene, for the table of models.
        formerly: names that its class had in older checkpoints.
        judge: of a distance, what makes of a generator one whose segments cost this distance:
            ``judge(module, generator)`` gives a :class:`~hvf.protocols.Judging`; None if there is
            none.
        in_torch: of dynamics, whether torch rolls them out: ``plannable`` then takes as keywords
            where and how (:attr:`hvf.settings.World.computing`).
        in_steps: of a distance, whether it is one in steps of play, for the cost "temporal".
    """

    about: str
    kind: Literal["video", "object"]
    role: Role
    module: str | type[Any]
    plannable: Any
    recipe: str | type[Any] | None = None
    assumes: str = ""
    formerly: tuple[str, ...] = ()
    judge: Any = None
    in_steps: bool = False
    in_torch: bool = False

    @property
    def class_name(self) -> str:
        """Name of the module's class, as checkpoints have it."""
        return (
            self.module.rpartition(":")[2] if isinstance(self.module, str) else self.module.__name__
        )

    @property
    def package(self) -> str:
        """The package that the module's class comes from."""
        where = self.module if isinstance(self.module, str) else self.module.__module__
        return where.partition(":")[0].partition(".")[0]

    def resolved(self, attribute: str) -> Any:
        """``module``, ``plannable``, ``judge`` or ``recipe``, imported."""
        target = getattr(self, attribute)
        return imported(target) if isinstance(target, str) else target
