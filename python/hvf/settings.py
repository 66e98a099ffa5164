"""How agents plan and act, in any environment: settings of the planners and of the rule."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, TypeAlias

import numpy as np

import hvf_core

OverHorizon: TypeAlias = Literal["last", "sum", "min"]


@dataclasses.dataclass(frozen=True)
class Acting:
    """When to go on to the next subgoal, and when to stop.

    Attributes:
        steps: steps of a trial, ``T``.
        steps_per_subgoal: most steps towards one subgoal, ``T*``.
        threshold: cost below which a subgoal counts as reached; 0 never.
        reached: which cost that is: ``"observed"``, the pixel cost of the observation to the
            subgoal; or ``"planned"``, the predicted cost of the plan to it.
        reached_blur: standard deviation, pixels, of a Gaussian blur through which observation
            and subgoal are compared; 0 for none.
    """

    steps: int = 50
    steps_per_subgoal: int = 10
    threshold: float = 1e-3
    reached: Literal["observed", "planned"] = "observed"
    reached_blur: float = 0.0

    def __post_init__(self) -> None:
        for name in ("steps", "steps_per_subgoal"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")
        if not self.threshold >= 0:
            raise ValueError(f"threshold: must not be negative, got {self.threshold}")
        if not 0 <= self.reached_blur < np.inf:
            raise ValueError(
                f"reached_blur: must be finite and not negative, got {self.reached_blur}"
            )
        if self.reached not in ("observed", "planned"):
            raise ValueError(f"reached: must be 'observed' or 'planned', got {self.reached!r}")


@dataclasses.dataclass(frozen=True)
class Replanning:
    """When a plan is replaced by a new one. A new target always gets a new plan.

    Attributes:
        every: steps of a plan that are acted before the next one is made, up to the horizon.
        keep_better: go on with the rest of a plan, if it has one, as long as no new plan has a
            lower predicted cost.
        warm_start: begin each search of actions around the rest of the last plan.
    """

    every: int = 1
    keep_better: bool = False
    warm_start: bool = False

    def check(self, horizon: int) -> None:
        """Refuse to act more steps than a plan has.

        Raises:
            ValueError: it is so, or fewer than one.
        """
        if not 1 <= self.every <= horizon:
            raise ValueError(
                f"replan_every: must be from 1 to the horizon {horizon}, got {self.every}"
            )


@dataclasses.dataclass(frozen=True)
class Planning:
    """How agents plan and act. The paper's names are in brackets.

    Attributes:
        samples: candidate action sequences per iteration (D).
        elites: of which the best are kept (D*).
        iterations: iterations of the search for actions.
        horizon: model steps that a plan looks ahead (H).
        initial: first distribution of actions: uniform over the box, or normal (the paper's).
        keep_elites: best candidates that compete again in the next iteration.
        warm_start: begin each search around the rest of the last plan.
        blur: standard deviation of a Gaussian blur of frames before they are compared, pixels.
        over_horizon: predicted frames that count: the last (the paper's), their sum or minimum.
        subgoal_samples: subgoal samples per iteration (M).
        subgoal_elites: of which the best are kept (M*).
        subgoal_iterations: iterations of the search for subgoals.
        reduction: cost of a sample over its segments: the maximum (the paper's) or the mean.
        steps_per_subgoal: most steps towards one subgoal (T*).
        threshold: cost below which a subgoal counts as reached.
        reached: which cost that is: of the observed frame, or planned.
        reached_blur: as ``blur``, for the observed frame and the subgoal.
    """

    samples: int = 200
    elites: int = 40
    iterations: int = 5
    horizon: int = 5
    initial: str = "uniform"
    keep_elites: int = 0
    warm_start: bool = False
    blur: float = 0.0
    over_horizon: OverHorizon = "last"
    subgoal_samples: int = 200
    subgoal_elites: int = 40
    subgoal_iterations: int = 5
    reduction: Literal["max", "mean"] = "max"
    steps_per_subgoal: int = 10
    threshold: float = 1e-3
    reached: Literal["observed", "planned"] = "observed"
    reached_blur: float = 0.0

    def __post_init__(self) -> None:
        # The planners check what is theirs.
        self.rule(1)
        self.search(1)
        self.replanning.check(self.horizon)

    def rule(self, steps: int) -> Acting:
        """The rule of acting, for trials of ``steps`` steps (T)."""
        return Acting(
            steps, self.steps_per_subgoal, self.threshold, self.reached, self.reached_blur
        )

    @property
    def mpc(self) -> hvf_core.VisualMPC:
        """Search for actions."""
        return hvf_core.VisualMPC(
            horizon=self.horizon,
            samples=self.samples,
            elites=self.elites,
            iterations=self.iterations,
            keep_elites=self.keep_elites,
            **self._actions(),
        )

    def search(self, subgoals: int) -> hvf_core.HVF:
        """Search for subgoals."""
        return hvf_core.HVF(
            mpc=self.mpc,
            subgoals=subgoals,
            samples=self.subgoal_samples,
            elites=self.subgoal_elites,
            iterations=self.subgoal_iterations,
            reduction=self.reduction,
        )

    @property
    def replanning(self) -> Replanning:
        """When to make a new plan."""
        return Replanning(warm_start=self.warm_start)

    def _actions(self) -> dict[str, Any]:
        """What the search for actions is told of an environment's actions."""
        return {"initial": self.initial}
