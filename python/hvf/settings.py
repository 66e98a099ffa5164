"""How agents plan and act, in any domain: settings of the planners, of the world, and of the rule.

One dataclass each, checked when it is made; the command line is generated from them, and a preset
is a value of them. The paper's names are in brackets.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal, TypeAlias

import numpy as np

import hvf_core

OverHorizon: TypeAlias = Literal["last", "sum", "min"]
"""Which predicted frames of a rollout count: the last, the sum over all, or the nearest."""
Precision: TypeAlias = Literal["auto", "float32", "bfloat16"]
"""Of convolutions: ``auto`` is bfloat16 on CUDA and float32 on a CPU."""


def check_blur(name: str, blur: float) -> None:
    """Refuse a blur that is not finite and at least 0.

    Raises:
        ValueError: it is not.
    """
    if not 0 <= blur < np.inf:
        raise ValueError(f"{name}: must be finite and not negative, got {blur}")


def check_word(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Refuse a ``value`` of ``name`` that is not one of the words ``allowed``.

    Raises:
        ValueError: it is not.
    """
    if value not in allowed:
        raise ValueError(f"{name}: must be one of {', '.join(allowed)}; got {value!r}")


@dataclasses.dataclass(frozen=True)
class Acting:
    """When to go on to the next subgoal, and when to stop.

    Attributes:
        steps: steps of a trial, ``T``.
        steps_per_subgoal: most steps towards one subgoal, ``T*``.
        threshold: cost below which a subgoal counts as reached; 0 never.
        reached: which cost that is: ``"observed"``, that of the observation to the subgoal (the
            world's own where it has one, else squared pixels); or ``"planned"``, the predicted
            cost of the plan to it.
        reached_blur: standard deviation, pixels, of a Gaussian blur through which observation
            and subgoal are compared; 0 for none.
        choose_anew: whether the subgoals that are left are chosen anew, from what is seen, when
            one is left behind, and all of them after ``T*`` steps towards the goal in vain; the
            paper chooses once. For methods that can.
    """

    steps: int = 50
    steps_per_subgoal: int = 10
    threshold: float = 1e-3
    reached: Literal["observed", "planned"] = "observed"
    reached_blur: float = 0.0
    choose_anew: bool = False

    def __post_init__(self) -> None:
        for name in ("steps", "steps_per_subgoal"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")
        if not self.threshold >= 0:
            raise ValueError(f"threshold: must not be negative, got {self.threshold}")
        check_blur("reached_blur", self.reached_blur)
        check_word("reached", self.reached, ("observed", "planned"))


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
    """How agents plan and act.

    Attributes:
        samples: candidate action sequences per iteration (D).
        elites: of which the best are kept (D*).
        iterations: iterations of the search for actions.
        horizon: model steps that a plan looks ahead (H).
        action_repeat: steps that one planned action is held for; divides the horizon.
        initial: first distribution of actions: uniform over the box, or normal (the paper's).
        initial_std: standard deviation of a normal one, in units of the action (the paper's is 1).
        initial_low: lowest actions of a uniform one, one number a dimension; none for the box's.
        initial_high: highest actions of a uniform one.
        clip: whether actions drawn from a Gaussian are clipped to the box; the authors' code does
            not.
        noise_beta: exponent by which the noise of actions is coloured over time; 0 for white noise,
            2 for iCEM's.
        momentum: share of the old distribution that a refit keeps (iCEM's alpha).
        samples_decay: by how much each iteration has fewer samples than the one before (iCEM's
            gamma).
        temperature: weigh elites by their costs (MPPI's lambda, in units of a cost); none for all
            alike.
        min_std: least standard deviation of a refit, in units of the action.
        covariance: what a refit keeps of the elites' covariance: diagonal or full.
        shrinkage: how far the correlations of a full one are shrunk towards none.
        best: whether the best candidate of all iterations is acted, or of the last (the authors'
            code); the same for subgoals.
        keep_elites: best candidates that compete again in the next iteration.
        warm_start: begin each search around the rest of the last plan.
        shift_elites: best candidates of the last plan that compete again in the next one, shifted
            (iCEM); with warm_start.
        replan_every: steps of a plan that are acted before the next one is made.
        keep_better: go on with the rest of a plan as long as no new one has a lower predicted
            cost: for budgets so small that a good plan may not be found again.
        blur: standard deviation of a Gaussian blur of frames before they are compared, pixels.
        over_horizon: predicted frames that count: the last (the paper's), their sum or minimum.
        scene_weight: how often the distance of what is behind the arm counts, beside that of whole
            frames; for dynamics that tell the two apart (layers), no other has a use for it.
        subgoal_draws: draws of proposed subgoals, where there is no search, of which the best is
            taken; 1 for the mean.
        subgoal_samples: subgoal samples per iteration (M).
        subgoal_elites: of which the best are kept (M*).
        subgoal_iterations: iterations of the search for subgoals.
        subgoal_keep_elites: as ``keep_elites``, for subgoals; so are the next ones.
        subgoal_momentum: share of the old distribution that a refit keeps.
        subgoal_samples_decay: by how much each iteration has fewer samples.
        subgoal_temperature: weigh elites by their costs; none for all alike.
        subgoal_min_std: least standard deviation of a refit; latents have 1 at first.
        subgoal_covariance: diagonal, or full over the latents of all subgoals.
        subgoal_shrinkage: how far the correlations of a full one are shrunk.
        reduction: cost of a sample over its segments: the maximum (the paper's), the mean, or the
            maximum and a tenth of the sum, which tells samples apart whose hardest segments are
            about as hard.
        segment_cost: who says what a segment costs: the planner, which plans it (the paper's); the
            generator, by how likely it is that random play leads from one frame to the next, for
            generators that know, without a plan and far faster; or a distance, by how many steps
            of play that takes, as fast.
        steps: steps of a trial (T); none for the task's own limit.
        steps_per_subgoal: most steps towards one subgoal (T*).
        threshold: cost below which a subgoal counts as reached.
        reached: which cost that is: of the observed frame, or planned.
        reached_blur: as ``blur``, for the observed frame and the subgoal.
        choose_anew: whether subgoals are chosen anew, from what is seen, when one is left behind,
            and after T* steps towards the goal in vain; the paper chooses once. For methods that
            can.
    """

    samples: int = 200
    elites: int = 40
    iterations: int = 5
    horizon: int = 5
    action_repeat: int = 1
    initial: Literal["uniform", "normal"] = "uniform"
    initial_std: float = 1.0
    initial_low: tuple[float, ...] | None = None
    initial_high: tuple[float, ...] | None = None
    clip: bool = True
    best: Literal["all", "last"] = "all"
    keep_elites: int = 0
    noise_beta: float = 0.0
    momentum: float = 0.0
    samples_decay: float = 1.0
    temperature: float | None = None
    min_std: float = 0.0
    covariance: Literal["diagonal", "full"] = "diagonal"
    shrinkage: float = 0.1
    warm_start: bool = False
    shift_elites: int = 0
    replan_every: int = 1
    keep_better: bool = False
    blur: float = 0.0
    over_horizon: OverHorizon = "last"
    scene_weight: float = 0.0
    subgoal_draws: int = 128
    subgoal_samples: int = 200
    subgoal_elites: int = 40
    subgoal_iterations: int = 5
    subgoal_keep_elites: int = 0
    subgoal_momentum: float = 0.0
    subgoal_samples_decay: float = 1.0
    subgoal_temperature: float | None = None
    subgoal_min_std: float = 0.0
    subgoal_covariance: Literal["diagonal", "full"] = "diagonal"
    subgoal_shrinkage: float = 0.1
    reduction: Literal["max", "mean", "max-sum"] = "max"
    segment_cost: Literal["planned", "likelihood", "distance"] = "planned"
    steps: int | None = None
    steps_per_subgoal: int = 10
    threshold: float = 1e-3
    reached: Literal["observed", "planned"] = "observed"
    reached_blur: float = 0.0
    choose_anew: bool = False

    def __post_init__(self) -> None:
        # The planners check what is theirs.
        self.rule(self.steps or 1)
        self.search(1)
        self.replanning.check(self.horizon)
        check_blur("blur", self.blur)
        check_word("over_horizon", self.over_horizon, ("last", "sum", "min"))
        if not 0 <= self.scene_weight < math.inf:
            raise ValueError(
                f"scene_weight: must be finite and not negative, got {self.scene_weight}"
            )
        if self.shift_elites and not self.warm_start:
            raise ValueError("shift_elites: belongs to warm_start, which is off")
        if self.subgoal_draws < 1:
            raise ValueError(f"subgoal_draws: must be at least 1, got {self.subgoal_draws}")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps: must be at least 1, got {self.steps}")

    def rule(self, steps: int) -> Acting:
        """The rule of acting, for tasks of ``steps`` steps (T) unless the plan has its own."""
        return Acting(
            self.steps or steps,
            self.steps_per_subgoal,
            self.threshold,
            self.reached,
            self.reached_blur,
            self.choose_anew,
        )

    @property
    def mpc(self) -> hvf_core.VisualMPC:
        """Search for actions."""
        first: dict[str, Any] = {"initial_low": self.initial_low, "initial_high": self.initial_high}
        if self.initial == "normal":
            first["initial_std"] = self.initial_std
        return hvf_core.VisualMPC(
            horizon=self.horizon,
            samples=self.samples,
            elites=self.elites,
            iterations=self.iterations,
            keep_elites=self.keep_elites,
            action_repeat=self.action_repeat,
            initial=self.initial,
            **first,
            clip=self.clip,
            best=self.best,
            noise_beta=self.noise_beta,
            momentum=self.momentum,
            samples_decay=self.samples_decay,
            temperature=self.temperature,
            min_std=self.min_std,
            covariance=self.covariance,
            shrinkage=self.shrinkage,
            shift_elites=self.shift_elites,
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
            best=self.best,
            # A distance is asked through the generator, whose segments it then judges.
            segment_cost="likelihood" if self.segment_cost == "distance" else self.segment_cost,
            keep_elites=self.subgoal_keep_elites,
            momentum=self.subgoal_momentum,
            samples_decay=self.subgoal_samples_decay,
            temperature=self.subgoal_temperature,
            min_std=self.subgoal_min_std,
            covariance=self.subgoal_covariance,
            shrinkage=self.subgoal_shrinkage,
        )

    @property
    def replanning(self) -> Replanning:
        """When to make a new plan."""
        return Replanning(self.replan_every, self.keep_better, self.warm_start)


@dataclasses.dataclass(frozen=True)
class World:
    """What is planned with: names of the domain's models, or files of checkpoints.

    Attributes:
        dynamics: predicts what actions lead to: a name such as "keypoint", a checkpoint, or
            "simulator" for true dynamics; "default" for the domain's own choice.
        generator: draws the images that subgoals are searched among: a name such as "cvae", a
            checkpoint, or "oracle" for true states; "default" goes with the dynamics.
        cost: what a predicted frame costs: "pixel", the distance to the goal image (the paper's),
            or another cost by name.
        cost_model: checkpoint of the model that the cost asks; none for the domain's own.
        segment_model: checkpoint of the distance that segments cost, with the segment cost
            "distance"; none for the domain's own.
        method_model: checkpoint of the model that the method asks, for methods that ask one of
            their own, such as "tap"; none for the domain's own.
        device: where dynamics run that torch rolls out (sv2p, spatial-latent), such as "cpu" or
            "cuda:1"; none for CUDA where there is one. What follows is for such dynamics, too.
        precision: of convolutions: float32 or bfloat16; auto is bfloat16 on CUDA only.
        memory_gb: gigabytes that batches of rollouts may take; none for 2 on a CPU, and for most
            of what is free on CUDA.
        compile: compile a step of the dynamics: pays in long searches on a GPU.
    """

    dynamics: str = "default"
    generator: str = "default"
    cost: str = "pixel"
    cost_model: str | None = None
    segment_model: str | None = None
    method_model: str | None = None
    device: str | None = None
    precision: Precision = "auto"
    memory_gb: float | None = None
    compile: bool = False

    def __post_init__(self) -> None:
        check_word("precision", self.precision, ("auto", "float32", "bfloat16"))
        if self.memory_gb is not None and not 0 < self.memory_gb < math.inf:
            raise ValueError(f"memory_gb: must be positive and finite, got {self.memory_gb}")

    @property
    def computing(self) -> dict[str, Any]:
        """How dynamics are rolled out in torch, by setting, where that is not as usual."""
        names = ("device", "precision", "memory_gb", "compile")
        # A field's default is the class's own attribute.
        return {n: getattr(self, n) for n in names if getattr(self, n) != getattr(World, n)}


@dataclasses.dataclass(frozen=True)
class Preset:
    """Settings that belong together.

    Attributes:
        planning: how agents plan and act.
        world: what they plan with.
        about: whose settings they are, in a line.
        method: what acts, where the preset is for one method only.
    """

    planning: Planning
    world: World = World()
    about: str = ""
    method: str | None = None

    def changed(self, settings: Mapping[str, Any]) -> Preset:
        """The preset with some settings of its world and planning changed.

        Raises:
            TypeError: a setting that neither has.
        """
        worldly = {field.name for field in dataclasses.fields(World)} & settings.keys()
        world = {name: settings[name] for name in worldly}
        rest = {name: value for name, value in settings.items() if name not in worldly}
        return dataclasses.replace(
            self,
            world=dataclasses.replace(self.world, **world),
            planning=changed(self.planning, rest),
        )


def changed(planning: Planning, settings: Mapping[str, Any]) -> Planning:
    """``planning`` with some settings changed.

    Raises:
        TypeError: a setting that there is not.
    """
    known = {field.name for field in dataclasses.fields(planning)}
    for name in settings:
        if name not in known:
            raise TypeError(f"{name}: there is no such setting")
    return dataclasses.replace(planning, **settings)
