from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, Literal, SupportsIndex, TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Never, Self

__all__ = [
    "HVF",
    "MAZE_ACTION_LIMIT",
    "MAZE_AGENT_HALF",
    "MAZE_ARENA",
    "MAZE_GAP_HALF",
    "MAZE_GAP_LIMIT",
    "MAZE_GAP_RANGE",
    "MAZE_IMAGE_SIZE",
    "MAZE_LAYOUTS",
    "MAZE_REACH",
    "MAZE_SUCCESS_DISTANCE",
    "MAZE_VIEW",
    "MAZE_WALL_X",
    "KeypointFrames",
    "KeypointWorld",
    "LatentFrames",
    "LatentWorld",
    "LayerFrames",
    "LayerWorld",
    "MazeFrames",
    "MazeLayout",
    "MazeSubgoals",
    "MazeWorld",
    "Plan",
    "Plans",
    "SearchResult",
    "VisualMPC",
    "__version__",
    "image_cost",
    "maze_collect",
    "maze_episodes",
    "maze_locate",
    "maze_render",
    "maze_step",
    "maze_subgoals",
    "maze_success",
]

__version__: str

_Index: TypeAlias = SupportsIndex | Sequence[SupportsIndex] | NDArray[np.integer]

# --- maze ---------------------------------------------------------------------------------

MAZE_ACTION_LIMIT: float
MAZE_AGENT_HALF: float
MAZE_ARENA: float
MAZE_GAP_HALF: float
MAZE_GAP_LIMIT: float
MAZE_GAP_RANGE: float
MAZE_IMAGE_SIZE: int
MAZE_LAYOUTS: tuple[str, ...]
MAZE_REACH: float
MAZE_SUCCESS_DISTANCE: float
MAZE_VIEW: float
MAZE_WALL_X: tuple[float, float]

@final
class MazeLayout:
    """A maze of any layout: walls as boxes that may be turned and may have gaps.

    A state of a layout is a row `(x, y, gap, ..)` of `2 + G` numbers, metres: where the centres of
    the agent and of the gaps (along their walls) are. Layouts compare by what they are, and can be
    copied and pickled.

    Args:
        name: Its name.
        walls: Float `[W, 5]`, rows `(x, y, half_x, half_y, angle)`: centre and half extents,
            metres, turn in degrees, anticlockwise.
        start: Where episodes start, `(low x, high x, low y, high y)`, metres.
        goal: Where they aim.
        arena: Half-widths of the arena, up to 0.3 m, which is what the camera sees; None for 0.3.
        gaps: Float `[G, 4]`, rows `(wall, half, low, high)` in the order of their walls, at most
            one a wall: an opening of half-width `half` across the wall's second axis, whose centre
            every episode draws from `[low, high]`, from the wall's centre. None for none.

    Raises:
        ValueError: Numbers out of range, a wall outside the arena, a gap that the agent does not
            fit through, a start or goal that walls fill, a goal that cannot be reached.
        TypeError: An argument of another kind.
    """

    def __new__(
        cls,
        name: str,
        walls: ArrayLike,
        start: ArrayLike,
        goal: ArrayLike,
        arena: ArrayLike | None = (0.3, 0.3),
        gaps: ArrayLike | None = (),
    ) -> Self: ...
    @staticmethod
    def preset(name: str) -> MazeLayout:
        """The layout of a name, one of `MAZE_LAYOUTS`.

        Args:
            name: 'easy', 'medium' or 'hard' (the paper's), 'corridor-1' to 'corridor-7' (walls from
                border to border with a gap each), 'u-maze' or 'spiral'.

        Raises:
            ValueError: Another name.
            TypeError: What is no string.
        """
    @property
    def name(self) -> str:
        """Its name."""
    @property
    def arena(self) -> tuple[float, float]:
        """Half-widths of the arena, m."""
    @property
    def walls(self) -> NDArray[np.float64]:
        """Walls, float64 `[W, 5]` (a copy)."""
    @property
    def gaps(self) -> NDArray[np.float64]:
        """Gaps, float64 `[G, 4]` (a copy)."""
    @property
    def start(self) -> tuple[float, float, float, float]:
        """Where episodes start, `(low x, high x, low y, high y)`, m."""
    @property
    def goal(self) -> tuple[float, float, float, float]:
        """Where episodes aim, `(low x, high x, low y, high y)`, m."""
    @property
    def columns(self) -> int:
        """Numbers of a state's row: 2 and one for each gap."""
    def __eq__(self, other: object, /) -> bool: ...
    def __ne__(self, other: object, /) -> bool: ...
    def __hash__(self) -> int: ...
    def __reduce__(self) -> tuple[object, tuple[object, ...]]: ...

def maze_step(
    states: ArrayLike, actions: ArrayLike, layout: MazeLayout | None = None
) -> NDArray[np.float64]:
    """States after one step, float64 `[N, 4]`.

    Args:
        states: float `[N, 4]`, rows `(x, y, w1, w2)` in metres: centre of the agent and of the gaps
            of the left and right wall.
        actions: float `[N, 2]` in units of 0.05 N, clipped to `[-3, 3]`.
        layout: The layout that states are of, whose rows are `(x, y, gap, ..)`, here and in the
            other functions of the maze; None for the paper's maze.

    Raises:
        ValueError: Shapes that do not match, states outside the arena or in a wall, actions that
            are not finite.
        TypeError: What is no array of numbers.
    """

def maze_render(
    states: ArrayLike, size: SupportsIndex | None = 64, layout: MazeLayout | None = None
) -> NDArray[np.uint8]:
    """Images of states: uint8 `[N, size, size, 3]`, RGB, row 0 at the top.

    Args:
        states: float `[N, 4]`, as for `maze_step`.
        size: Height and width, pixels, from 8 to 2048; None for 64.
        layout: As for `maze_step`.

    Raises:
        ValueError: A size out of range, or states that `maze_step` refuses.
        TypeError: An argument of another kind.
        MemoryError: The images do not fit into memory.
    """

def maze_locate(images: NDArray[np.uint8], layout: MazeLayout | None = None) -> NDArray[np.float64]:
    """The states that images show, float64 `[N, 4]`.

    Right to about 0.1 mm on rendered frames of 64 pixels or more; a best guess, and always a legal
    state, on others.

    Args:
        images: uint8 `[N, S, S, 3]`.
        layout: The layout that they show; None for the paper's maze.

    Raises:
        ValueError: Another shape.
        TypeError: Another dtype, or what is no array.
    """

def maze_episodes(
    seed: SupportsIndex,
    first: SupportsIndex,
    count: SupportsIndex,
    difficulty: Literal["easy", "medium", "hard"] | None = None,
    layout: MazeLayout | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Episodes of a seed: `(starts [N, 4], targets [N, 2])`, float64, metres.

    Episode `i` is keyed by `(seed, i)`, so it is the same whatever range it is drawn in. The goal
    state is `(target_x, target_y, w1, w2)`, its image the goal image.

    Args:
        seed: From 0 to 2**64 - 1.
        first: Number of the first episode.
        count: How many, `N`.
        difficulty: 'easy', 'medium' or 'hard' (none, one or two gaps to pass).
        layout: In place of a difficulty: starts and targets are drawn from the layout's regions,
            and starts are its states, `(x, y, gap, ..)`.

    Raises:
        ValueError: Another difficulty, both or neither of the two, or negative numbers.
        TypeError: An argument of another kind.
        MemoryError: The episodes do not fit into memory.
    """

def maze_subgoals(
    starts: ArrayLike,
    targets: ArrayLike,
    subgoals: SupportsIndex,
    layout: MazeLayout | None = None,
) -> NDArray[np.float64]:
    """Ground-truth subgoals: states, float64 `[N, subgoals, 4]`.

    The agent centred in the gaps that it has to pass, in order; on the straight line to the
    target if there are none. In a `layout` at turns of the shortest way to the target, or between
    them if there are fewer, moved a little towards the middle of free space.

    Args:
        starts: States that episodes start from, float `[N, 4]`, as for `maze_step`.
        targets: Where they aim, float `[N, 2]`, metres.
        subgoals: How many for each, `K`.
        layout: As for `maze_step`.

    Raises:
        ValueError: Shapes that do not match, or numbers out of range.
        TypeError: An argument of another kind.
        MemoryError: The subgoals do not fit into memory.
    """

def maze_collect(
    seed: SupportsIndex,
    first: SupportsIndex,
    count: SupportsIndex,
    steps: SupportsIndex,
    size: SupportsIndex | None = 64,
    layout: MazeLayout | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float64]]:
    """Random interaction: `(images, actions, states)`.

    `images` are uint8 `[N, T + 1, size, size, 3]`, `actions` float32 `[N, T, 2]`, `states` float64
    `[N, T + 1, 4]`. Starts are uniform over free space in random scenes, actions uniform over the
    box. Episode `i` is keyed by `(seed, i)`: ranges can be collected in any order and chunking.
    Ctrl-C stops it.

    Args:
        seed: From 0 to 2**64 - 1.
        first: Number of the first episode.
        count: How many, `N`.
        steps: Steps of each, `T`, at least 1.
        size: Height and width of the images, pixels, from 8 to 2048; None for 64.
        layout: As for `maze_step`.

    Raises:
        ValueError: Negative or zero sizes.
        TypeError: An argument of another kind.
        MemoryError: The frames do not fit into memory.
    """

def maze_success(
    states: ArrayLike, targets: ArrayLike, layout: MazeLayout | None = None
) -> NDArray[np.bool_]:
    """Whether agents are within 0.05 m of their targets: bool `[N]`.

    Args:
        states: float `[N, 4]`, as for `maze_step`.
        targets: float `[N, 2]`, metres.
        layout: As for `maze_step`.

    Raises:
        ValueError: Shapes that do not match, or numbers that are not finite.
        TypeError: What is no array of numbers.
    """

# --- image costs --------------------------------------------------------------------------

def image_cost(
    a: NDArray[np.uint8] | NDArray[np.float32],
    b: NDArray[np.uint8] | NDArray[np.float32],
    mode: Literal["pairs", "all_pairs"] = "pairs",
    blur: float = 0.0,
) -> NDArray[np.float64]:
    """Squared L2 between frames, per pixel: `sum((a - b)**2) / (H * W)` of colours in `[0, 1]`.

    Without blur, costs of uint8 frames are exact up to one rounding. Nothing is copied.

    Args:
        a: Frames `[N, H, W, C]`, uint8 or float32 within `[0, 1]`, C-contiguous.
        b: Frames of the same dtype.
        mode: 'pairs' for float64 `[N]`, or 'all_pairs' for `[len(a), len(b)]` (one to many: one
            frame in `a`).
        blur: Standard deviation, in pixels, of a Gaussian blur of both frames first, as
            `scipy.ndimage.gaussian_filter` does on each channel; 0 for none.

    Raises:
        ValueError: Shapes that do not match, empty batches, memory that is not contiguous, float32
            values outside `[0, 1]` or a negative blur.
        TypeError: Other dtypes.
    """

# --- planner ------------------------------------------------------------------------------

@final
class VisualMPC:
    """Visual model-predictive control: the cross-entropy method over actions.

    Draws `samples` candidates of `horizon` steps, keeps the `elites` with the lowest predicted
    cost and refits a diagonal Gaussian to them, until its largest variance falls below
    `min_variance` or `iterations` are used up (paper, section 3 and algorithm 1). Options make it
    iCEM, MPPI or a search with full covariance. Objects are immutable, compare and hash by value,
    and can be copied and pickled.

    Args:
        horizon: Model steps that a plan looks ahead (`H`).
        action_repeat: Model steps that one drawn action is held for; divides `horizon`.
        initial: First iteration's distribution: 'uniform' over the action box, or 'normal' (the
            paper's has mean 0 and deviation 1).
        initial_low: Lower corner of a part of the action box, `[A]`, for 'uniform'; None for the
            box's own.
        initial_high: Upper corner, `[A]`. The original maze code drew `x >= 0` only, a hint that
            the goal is to the right.
        initial_mean: Mean of 'normal', in units of an action.
        initial_std: Standard deviation of 'normal'.
        warm_start_std: Standard deviation around a warm start, in units of an action.
        clip: Whether candidates drawn from a Gaussian (a refitted one, 'normal', around a warm
            start) are clipped to the action box. The authors' released code does not: plans may
            then lie beyond the box, and what a model makes of such actions is its own affair
            (`MazeWorld` clips them, learned worlds extrapolate).
        noise_beta: How fast the power of the noise of drawn actions falls with its frequency over
            the time steps of a plan, `f**-noise_beta`: 0 for white noise, 2 for iCEM's (Pinneri
            et al., 2020). Single actions are distributed as without. For at most 256 actions a
            plan, and 'diagonal'.
        shift_elites: Best candidates of its last iteration that a plan keeps; in a next plan with
            this as `warm_start` they take the place of as many samples of the first iteration,
            shifted by one step (iCEM). At most `elites`.
        samples: Samples per iteration: candidate plans (`D`), or sets of subgoals (`M`).
        elites: Samples that the distribution is refitted to (`D*`, `M*`), at most `samples`.
        iterations: Most iterations.
        min_variance: Variance below which a problem is done, in squared units of an action or a
            latent.
        keep_elites: Best samples that compete again in the next iteration, with the cost they had;
            at most `elites`.
        best: Where the answer comes from: 'all', the sample with the lowest cost of all
            iterations, or 'last', that of the last iteration that was run (kept elites included),
            as in the authors' released code.
        momentum: Share of the old mean, deviations and correlations that a refit keeps, from 0 to
            below 1 (iCEM's alpha).
        samples_decay: By how much each iteration has fewer samples than the one before, at least
            1: `samples / samples_decay**i`, but no fewer than twice the elites (iCEM's gamma).
        temperature: Elites count by `exp((best - cost) / temperature)` in the refit (MPPI's
            lambda, in units of a cost); None for all alike.
        min_std: Least standard deviation of the refitted distribution, in units of an action
            or a latent. Above the root of `min_variance` no problem is done early.
        covariance: What the refit keeps of the elites' covariance: 'diagonal', the variances, or
            'full', the correlations, too, for samples of at most 256 dimensions.
        shrinkage: How far the correlations of 'full' are shrunk towards none, from 1e-6 to 1; 1
            draws as 'diagonal' does.

    Raises:
        ValueError: An argument is out of range; the message names it.
        TypeError: An argument has the wrong type.
    """

    def __new__(
        cls,
        *,
        horizon: SupportsIndex = 5,
        samples: SupportsIndex = 200,
        elites: SupportsIndex = 40,
        iterations: SupportsIndex = 5,
        min_variance: float = 1e-3,
        action_repeat: SupportsIndex = 1,
        initial: Literal["uniform", "normal"] = "uniform",
        initial_low: Sequence[float] | NDArray[np.floating] | None = None,
        initial_high: Sequence[float] | NDArray[np.floating] | None = None,
        initial_mean: float = 0.0,
        initial_std: float = 1.0,
        keep_elites: SupportsIndex = 0,
        warm_start_std: float = 1.0,
        clip: bool = True,
        best: Literal["all", "last"] = "all",
        momentum: float = 0.0,
        samples_decay: float = 1.0,
        temperature: float | None = None,
        min_std: float = 0.0,
        covariance: Literal["diagonal", "full"] = "diagonal",
        shrinkage: float = 0.1,
        noise_beta: float = 0.0,
        shift_elites: SupportsIndex = 0,
    ) -> Self: ...
    def __hash__(self) -> int: ...
    def __getnewargs_ex__(self) -> tuple[tuple[()], dict[str, Any]]: ...
    @property
    def horizon(self) -> int:
        """The argument of this name."""
    @property
    def samples(self) -> int:
        """The argument of this name."""
    @property
    def elites(self) -> int:
        """The argument of this name."""
    @property
    def iterations(self) -> int:
        """The argument of this name."""
    @property
    def min_variance(self) -> float:
        """The argument of this name."""
    @property
    def action_repeat(self) -> int:
        """The argument of this name."""
    @property
    def initial(self) -> Literal["uniform", "normal"]:
        """The argument of this name."""
    @property
    def initial_low(self) -> list[float] | None:
        """The argument of this name; None for the box's own and for 'normal'."""
    @property
    def initial_high(self) -> list[float] | None:
        """The argument of this name; None for the box's own and for 'normal'."""
    @property
    def initial_mean(self) -> float:
        """The argument of this name; 0 for 'uniform'."""
    @property
    def initial_std(self) -> float:
        """The argument of this name; 1 for 'uniform'."""
    @property
    def keep_elites(self) -> int:
        """The argument of this name."""
    @property
    def warm_start_std(self) -> float:
        """The argument of this name."""
    @property
    def clip(self) -> bool:
        """The argument of this name."""
    @property
    def best(self) -> Literal["all", "last"]:
        """The argument of this name."""
    @property
    def momentum(self) -> float:
        """The argument of this name."""
    @property
    def samples_decay(self) -> float:
        """The argument of this name."""
    @property
    def temperature(self) -> float | None:
        """The argument of this name."""
    @property
    def min_std(self) -> float:
        """The argument of this name."""
    @property
    def covariance(self) -> Literal["diagonal", "full"]:
        """The argument of this name."""
    @property
    def shrinkage(self) -> float:
        """The argument of this name; its default where no correlations are kept."""
    @property
    def noise_beta(self) -> float:
        """The argument of this name."""
    @property
    def shift_elites(self) -> int:
        """The argument of this name."""
    def plan(
        self,
        model: Any,
        start: Any,
        goal: Any,
        seed: SupportsIndex = 0,
        warm_start: Plan | ArrayLike | None = None,
        warm_elites: ArrayLike | None = None,
    ) -> Plan:
        """Find actions that lead from `start` to `goal`.

        Args:
            model: A world of this module, an object whose `native` is one, or any object with the
                methods of `hvf.protocols.WorldModel`. Costs of its own that `native` would hide
                are refused; see there.
            start: One uint8 image `[height, width, 3]` (which goes through the model's `observe`,
                if it has one) or one frame of the model, `[1]`.
            goal: The same for the goal.
            seed: From 0 to 2**64 - 1. The same seed gives the same plan to the last bit, with any
                number of threads, alone or in a batch.
            warm_start: The last plan, as it was before its first action was taken: the search
                starts from a Gaussian around the rest of it. A `Plan` or float actions `[H, A]`.
            warm_elites: The best candidates of that plan, as they were before its first action was
                taken, float `[S, H, A]` with `S` at most `shift_elites`; None for those that a
                `Plan` brings.

        Raises:
            ValueError: An argument does not fit, or the model answered with the wrong shape or with
                NaN only; the message names the argument or the model's method.
            TypeError: An argument is of the wrong kind, or the model lacks a method.
            KeyboardInterrupt: Ctrl-C: within a second of native work, else between two calls of
                the model. What a model raises comes back as it is.
            RuntimeError: This process was forked after the module had worked in its parent, whose
                threads it lacks; start processes by 'spawn' or 'forkserver'.
        """

    def plan_batch(
        self,
        model: Any,
        starts: Any,
        goals: Any,
        seeds: SupportsIndex | Sequence[SupportsIndex] | NDArray[np.integer] | None = None,
        warm_start: Plans | ArrayLike | None = None,
        warm_elites: ArrayLike | None = None,
    ) -> Plans:
        """Solve `B` problems together: as `plan` one by one, to the last bit.

        Args:
            model: As for `plan`.
            starts: Uint8 images `[B, height, width, 3]` or frames of the model, `[B]`, at most
                2**20; or one, `[1, ...]`, for all goals. Three axes are never one image here.
            goals: Images or frames, `[B]`.
            seeds: One seed for all, one for each `[B]`, or None for 0. Problems with one start and
                one seed share their first iteration's rollouts where the model can.
            warm_start: The last plans: `Plans` or float actions `[B, H, A]`.
            warm_elites: Their best candidates, float `[B, S, H, A]`, unless `Plans` bring them.

        Raises:
            As `plan`.
        """

@final
class Plan:
    """The best actions found for one problem."""

    def __new__(cls, never: Never, /) -> Self: ...
    @property
    def actions(self) -> NDArray[np.float32]:
        """Actions, float32 `[H, A]`."""

    @property
    def cost(self) -> float:
        """Predicted cost of these actions: the lowest of the iterations that `best` says."""

    @property
    def elites(self) -> NDArray[np.float32]:
        """Best candidates of the last iteration, best first, float32 `[S, H, A]`.

        `S` is the planner's `shift_elites`. A next plan with this `warm_start` begins with them.
        """

    @property
    def iterations(self) -> int:
        """Iterations that were run, `I`."""

    @property
    def history(self) -> dict[str, NDArray[np.float32]]:
        """Costs of every iteration by name, float32 `[I]` each.

        `best`, `elite_mean` and `elite_worst` of the elites, `population_mean` of all finite costs,
        and `max_std`, the largest deviation of the refitted Gaussian.
        """

@final
class Plans:
    """The best actions found for every problem of a batch; `plans[b]` is a `Plan`."""

    def __new__(cls, never: Never, /) -> Self: ...
    @property
    def actions(self) -> NDArray[np.float32]:
        """Actions, float32 `[B, H, A]`."""

    @property
    def costs(self) -> NDArray[np.float32]:
        """Predicted costs, float32 `[B]`."""

    @property
    def elites(self) -> NDArray[np.float32]:
        """As `Plan.elites`, float32 `[B, S, H, A]`."""

    @property
    def iterations(self) -> NDArray[np.int64]:
        """Iterations that each problem ran, int64 `[B]`."""

    @property
    def history(self) -> dict[str, NDArray[np.float32]]:
        """As `Plan.history`, float32 `[B, I]` each; NaN after a problem was done."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: SupportsIndex, /) -> Plan: ...
    def __iter__(self) -> Iterator[Plan]: ...

@final
class HVF:
    """Hierarchical visual foresight: the search for subgoal images.

    The cross-entropy method over the latents of `subgoals` images, from a standard normal, or from
    what the generator proposes (`hvf.protocols.Proposing`). A sample costs what the hardest of its
    `subgoals + 1` segments costs to plan with `mpc` (paper, section 4 and algorithm 2). Subgoals,
    latents, cost and plans of the answer are of one sample; how segments are planned is for the
    options of `mpc` to say. Objects are immutable, compare and hash by value, and can be
    copied and pickled.

    Args:
        mpc: How a segment is planned; None for `VisualMPC()`.
        subgoals: Number of subgoals (`K`); 0 plans to the goal directly.
        reduction: Cost of a sample from those of its segments: 'max', the hardest (the paper's),
            'mean', or 'max-sum', the hardest and a tenth of the sum of all, so that of samples
            whose hardest segments are about as hard the one with the least to do in all counts as
            the best.
        prune: Plan the segment of a sample first that a few candidates take for its hardest, drop
            samples whose worst segment exceeds the `elites`-th best complete sample, and plan
            other segments only until they are known to be no harder. Changes nothing but the time,
            and what `population_mean` is over. Only with 'max'.
        share_rollouts: Share the first iteration's rollouts of all first segments where the model
            can (`shared_rollout_costs`). Changes nothing but the time.
        chunk: Samples that pruning completes at a time, before it looks what is still worth
            completing; None for as many as `elites`. Larger ones make fewer, fuller calls. Changes
            nothing but the time.
        segment_cost: Who says what a segment costs: 'planned', the planner, by the predicted cost
            of its best plan (the paper's), or 'likelihood', the generator, by its `segment_costs`
            and without a plan.
        samples: Samples per iteration: candidate plans (`D`), or sets of subgoals (`M`).
        elites: Samples that the distribution is refitted to (`D*`, `M*`), at most `samples`.
        iterations: Most iterations.
        min_variance: Variance below which a problem is done, in squared units of an action or a
            latent.
        keep_elites: Best samples that compete again in the next iteration, with the cost they had;
            at most `elites`.
        best: Where the answer comes from: 'all', the sample with the lowest cost of all
            iterations, or 'last', that of the last iteration that was run (kept elites included),
            as in the authors' released code.
        momentum: Share of the old mean, deviations and correlations that a refit keeps, from 0 to
            below 1 (iCEM's alpha).
        samples_decay: By how much each iteration has fewer samples than the one before, at least
            1: `samples / samples_decay**i`, but no fewer than twice the elites (iCEM's gamma).
        temperature: Elites count by `exp((best - cost) / temperature)` in the refit (MPPI's
            lambda, in units of a cost); None for all alike.
        min_std: Least standard deviation of the refitted distribution, in units of an action
            or a latent. Above the root of `min_variance` no problem is done early.
        covariance: What the refit keeps of the elites' covariance: 'diagonal', the variances, or
            'full', the correlations, too, for samples of at most 256 dimensions.
        shrinkage: How far the correlations of 'full' are shrunk towards none, from 1e-6 to 1; 1
            draws as 'diagonal' does.

    Raises:
        ValueError: An argument is out of range; the message names it.
        TypeError: An argument has the wrong type.
    """

    TIE: Final[float]
    """Share of the sum of segments in `reduction='max-sum'`."""

    def __new__(
        cls,
        *,
        mpc: VisualMPC | None = None,
        subgoals: SupportsIndex = 2,
        samples: SupportsIndex = 200,
        elites: SupportsIndex = 40,
        iterations: SupportsIndex = 5,
        min_variance: float = 1e-3,
        reduction: Literal["max", "mean", "max-sum"] = "max",
        keep_elites: SupportsIndex = 0,
        prune: bool = True,
        share_rollouts: bool = True,
        chunk: SupportsIndex | None = None,
        best: Literal["all", "last"] = "all",
        segment_cost: Literal["planned", "likelihood"] = "planned",
        momentum: float = 0.0,
        samples_decay: float = 1.0,
        temperature: float | None = None,
        min_std: float = 0.0,
        covariance: Literal["diagonal", "full"] = "diagonal",
        shrinkage: float = 0.1,
    ) -> Self: ...
    def __hash__(self) -> int: ...
    def __getnewargs_ex__(self) -> tuple[tuple[()], dict[str, Any]]: ...
    @property
    def mpc(self) -> VisualMPC:
        """The argument of this name."""
    @property
    def subgoals(self) -> int:
        """The argument of this name."""
    @property
    def samples(self) -> int:
        """The argument of this name."""
    @property
    def elites(self) -> int:
        """The argument of this name."""
    @property
    def iterations(self) -> int:
        """The argument of this name."""
    @property
    def min_variance(self) -> float:
        """The argument of this name."""
    @property
    def reduction(self) -> Literal["max", "mean", "max-sum"]:
        """The argument of this name."""
    @property
    def keep_elites(self) -> int:
        """The argument of this name."""
    @property
    def prune(self) -> bool:
        """The argument of this name."""
    @property
    def share_rollouts(self) -> bool:
        """The argument of this name."""
    @property
    def chunk(self) -> int | None:
        """The argument of this name."""
    @property
    def best(self) -> Literal["all", "last"]:
        """The argument of this name."""
    @property
    def segment_cost(self) -> Literal["planned", "likelihood"]:
        """The argument of this name."""
    @property
    def momentum(self) -> float:
        """The argument of this name."""
    @property
    def samples_decay(self) -> float:
        """The argument of this name."""
    @property
    def temperature(self) -> float | None:
        """The argument of this name."""
    @property
    def min_std(self) -> float:
        """The argument of this name."""
    @property
    def covariance(self) -> Literal["diagonal", "full"]:
        """The argument of this name."""
    @property
    def shrinkage(self) -> float:
        """The argument of this name; its default where no correlations are kept."""
    def search(
        self,
        model: Any,
        generator: Any,
        start: Any,
        goal: Any,
        seed: SupportsIndex = 0,
        progress: Callable[[int, int, float], object] | None = None,
    ) -> SearchResult:
        """Search for subgoals between `start` and `goal`.

        Args:
            model: The world, as for `VisualMPC.plan`.
            generator: An object with the methods of `hvf.protocols.SubgoalModel`; may be None for
                `subgoals=0`.
            start: One uint8 image `[height, width, 3]` or one frame of the model, `[1]`.
            goal: The same for the goal.
            seed: From 0 to 2**64 - 1. The same seed gives the same result to the last bit, with any
                number of threads, and with `prune` and `share_rollouts` on or off.
            progress: Called as `progress(iteration, iterations, cost)` after every iteration, the
                first being 1, of at most `iterations`, with the lowest cost so far (of the last
                iteration for `best='last'`). What it raises ends the search.

        Raises:
            As `VisualMPC.plan`. An exception that ends a search after its first iteration
            (KeyboardInterrupt by Ctrl-C, or any of `progress` or a model) has an attribute
            `partial`: the `SearchResult` that the search would have given after its last finished
            iteration (by 'likelihood', without plans).
        """

    def search_batch(
        self,
        model: Any,
        generator: Any,
        starts: Any,
        goals: Any,
        seeds: SupportsIndex | Sequence[SupportsIndex] | NDArray[np.integer] | None = None,
    ) -> list[SearchResult]:
        """Search for `B` pairs of start and goal: each result is what `search` finds alone.

        The searches go on side by side: a model whose frames can be joined (`hvf.protocols.Frames`)
        plans the segments of all of them in the same calls.

        Args:
            model: As for `search`.
            generator: As for `search`.
            starts: Uint8 images `[B, height, width, 3]` or frames of the model, `[B]`; or one,
                `[1, ...]`, for all goals.
            goals: Images or frames, `[B]`.
            seeds: One seed for all, one for each `[B]`, or None for 0.

        Raises:
            As `search`.
        """

@final
class SearchResult:
    """What the subgoal search found."""

    def __new__(cls, never: Never, /) -> Self: ...
    @property
    def subgoals(self) -> Any:
        """Subgoals in the order to reach them: frames of the model, `[K]`."""

    @property
    def latents(self) -> NDArray[np.float32]:
        """Latents of the subgoals, float32 `[K, L]`."""

    @property
    def cost(self) -> float:
        """Cost of the segments together: what `reduction` makes of `segment_costs`."""

    @property
    def segment_costs(self) -> NDArray[np.float32]:
        """Planning cost of every segment, float32 `[K + 1]`."""

    @property
    def plans(self) -> Plans:
        """Best plan of every segment, `K + 1`."""

    @property
    def iterations(self) -> int:
        """Iterations that were run, `I`; 0 without subgoals."""

    @property
    def history(self) -> dict[str, NDArray[np.float32] | NDArray[np.int64]]:
        """Figures of every iteration by name, `[I]` each.

        Those of `Plan.history` over the samples (`population_mean`: the completed ones), and the
        planning problems `evaluated` (to their end, or until it was clear that they are not their
        sample's hardest) and `skipped`, int64.
        """

# --- the maze as a world model --------------------------------------------------------------

@final
class MazeFrames:
    """Frames of the maze: states, with the images they were read off where there are any.

    Frames of states have their images drawn where they are needed; `MazeWorld.observe` makes frames
    of images. `frames[i]` are those at an integer (one frame, still a batch) or at integers `[N]`.

    Args:
        states: float `[N, 4]`, rows `(x, y, w1, w2)`, metres.
        image_size: Height and width of the images, pixels, from 8 to 2048.
        layout: The layout that the states are of, whose rows are `(x, y, gap, ..)`; None for the
            paper's maze.

    Raises:
        ValueError: States or sizes that `maze_render` refuses.
        TypeError: An argument of another kind.
    """

    def __new__(
        cls,
        states: ArrayLike,
        image_size: SupportsIndex = 64,
        layout: MazeLayout | None = None,
    ) -> Self: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: _Index, /) -> MazeFrames: ...
    @property
    def states(self) -> NDArray[np.float64]:
        """States, float64 `[N, 4]`, rows `(x, y, w1, w2)`, or those of a layout (a copy)."""
    @property
    def images(self) -> NDArray[np.uint8]:
        """Images, uint8 `[N, S, S, 3]` (a copy): those that were observed, or else drawn."""
    @property
    def image_size(self) -> int:
        """Height and width of the images, pixels."""

@final
class MazeWorld:
    """The maze's true simulator as a world model.

    The planning cost is the pixel cost (`image_cost`) between the frame that simulator and
    renderer would give and the goal image, computed without drawing it. Actions beyond the box
    `[-3, 3]` count as the nearest within, as in the environment. The planners use it without the
    GIL.

    Args:
        image_size: Height and width of the images, pixels, from 8 to 2048.
        blur: Standard deviation, in pixels, of a Gaussian blur of both images.
        over_horizon: Which predicted frames count: 'last', 'sum' or 'min'.
        layout: What images are read as showing; None for the paper's maze. Frames of states have
            their layout with them.

    Raises:
        ValueError: A number out of range, or another name.
        TypeError: An argument of another kind.
    """

    def __new__(
        cls,
        image_size: SupportsIndex = 64,
        blur: float = 0.0,
        over_horizon: Literal["last", "sum", "min"] = "last",
        layout: MazeLayout | None = None,
    ) -> Self: ...
    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 `[A]`."""
    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 `[A]`."""
    @property
    def image_size(self) -> int:
        """Height and width of the images, pixels."""
    @property
    def blur(self) -> float:
        """Standard deviation of the blur, pixels."""
    @property
    def over_horizon(self) -> Literal["last", "sum", "min"]:
        """Which predicted frames count."""
    def observe(self, images: NDArray[np.uint8]) -> MazeFrames:
        """Frames of images; where a rollout starts is read off them.

        Args:
            images: uint8 `[N, S, S, 3]`, or one, `[S, S, 3]`.

        Raises:
            ValueError: Images of another size.
            TypeError: What is not uint8.
        """
    def rollout_costs(
        self,
        starts: MazeFrames | NDArray[np.uint8],
        goals: MazeFrames | NDArray[np.uint8],
        actions: ArrayLike,
    ) -> NDArray[np.float32]:
        """Planning costs of candidates, float32 `[B, D]`.

        One whose actions are not finite costs NaN.

        Args:
            starts: `MazeFrames`, or uint8 images, that candidates start from, `[B]`.
            goals: Frames or images that they are compared with, `[B]`.
            actions: float `[B, D, H, 2]`, at most 2**28 numbers.

        Raises:
            ValueError: Frames or actions that do not fit the world or each other.
            TypeError: An argument of another kind.
        """
    def shared_rollout_costs(
        self,
        start: MazeFrames | NDArray[np.uint8],
        goals: MazeFrames | NDArray[np.uint8],
        actions: ArrayLike,
    ) -> NDArray[np.float32]:
        """Planning costs of the same candidates from one start to every goal, float32 `[B, D]`.

        Those of `rollout_costs`, to the last bit.

        Args:
            start: The frame or image that all candidates start from, `[1]`.
            goals: Frames or images that they are compared with, `[B]`.
            actions: float `[D, H, 2]`, at most 2**28 numbers.

        Raises:
            As `rollout_costs`.
        """
    def rollout(
        self, start: MazeFrames | NDArray[np.uint8], actions: ArrayLike
    ) -> NDArray[np.float64]:
        """States that candidates lead through, float64 `[D, H, S]`.

        Args:
            start: The frame or image that all candidates start from, `[1]`.
            actions: float `[D, H, 2]`, at most 2**28 numbers.

        Raises:
            As `rollout_costs`.
        """

@final
class MazeSubgoals:
    """The oracle among subgoal generators: images of a scene with the agent anywhere it can stand.

    Uniformly: what a perfect generative model of the maze would do.

    Args:
        latent_dim: Numbers of a latent, at least 2: the first two say where the agent is.
        layout: What images are read as showing; None for the paper's maze.

    Raises:
        ValueError: A number out of range.
        TypeError: An argument of another kind.
    """

    def __new__(cls, latent_dim: SupportsIndex = 8, layout: MazeLayout | None = None) -> Self: ...
    @property
    def latent_dim(self) -> int:
        """Numbers of a latent, `L`."""
    def decode(self, scene: object, latents: ArrayLike) -> MazeFrames:
        """`MazeFrames` of `M * K` images, sample-major.

        Args:
            scene: One frame of any world: `MazeFrames`, a uint8 image `[1, S, S, 3]`, or frames
                with such `images`.
            latents: float `[M, K, L]`.

        Raises:
            ValueError: A scene of more or less than one frame, or latents of another shape.
            TypeError: An argument of another kind.
        """

# --- the compact learned dynamics model -----------------------------------------------------

@final
class KeypointFrames:
    """Frames of a `KeypointWorld`: images, where the moving part is, and a map of the rest.

    Made by `KeypointWorld.frames`. `frames[i]` are those at an integer (one frame, still a batch)
    or at integers `[N]`. What the model sees in a scene is computed once, when first needed; frames
    picked with `[]` and frames from `moved` share it.
    """

    def __new__(cls, never: Never, /) -> Self: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: _Index, /) -> KeypointFrames: ...
    @property
    def images(self) -> NDArray[np.uint8]:
        """The images, uint8 `[N, S, S, 3]` (a copy)."""
    @property
    def keypoints(self) -> NDArray[np.float32]:
        """The keypoints, float32 `[N, 2]`, (row, column) in pixels (a copy)."""
    @property
    def maps(self) -> NDArray[np.float32]:
        """The scene maps, float32 `[N, S, S]` (a copy)."""
    def moved(self, images: NDArray[np.uint8], keypoints: NDArray[np.float32]) -> KeypointFrames:
        """Frames of the same scene in which the moving part is elsewhere.

        Args:
            images: uint8 `[N, S, S, 3]`.
            keypoints: float32 `[N, 2]`, (row, column) in pixels.

        Raises:
            ValueError: Not exactly one frame here, shapes that do not fit each other, or keypoints
                that are not finite.
            TypeError: Arrays of another dtype, or what is no array.
        """

@final
class KeypointWorld:
    """The compact learned dynamics model, evaluated in Rust; a world model.

    `hvf.worlds.keypoint.KeypointWorld` makes one from a trained `KeypointDynamics`. The cost is the
    squared pixel distance of the predicted frame to the goal, per pixel, in closed form. A
    candidate costs about `H * substeps * hidden**2` multiply-adds. Actions beyond the box are taken
    as they are: the model, which was trained within it, extrapolates.

    Args:
        patch: Weights of the first layer for what is around the keypoint, float32
            `[hidden, taps**2]`.
        patch_bias: float32 `[hidden]`.
        context: Weights of the first layer for action and memory, float32 `[hidden, A + C]`.
        middle: float32 `[hidden, hidden]`.
        middle_bias: float32 `[hidden]`.
        output: Motion in pixels, then change of the memory, float32 `[2 + C, hidden]`.
        output_bias: float32 `[2 + C]`.
        free: Motion per substep that is linear in the action, float32 `[2, A]`.
        action_scale: Number by which actions are divided.
        spacing: Pixels between the taps of a patch.
        substeps: Substeps of an action.
        half_size: Half the sprite's size along rows and columns, in pixels.
        edge: Width of its soft edge along rows and columns, in pixels.
        colour: Its colour relative to the background, in units of full intensity.
        action_low: Lowest action, `[A]`.
        action_high: Highest action, `[A]`.
        image_size: Height and width of the images, `S`.
        blur: Standard deviation of the Gaussian blur before frames are compared, in pixels.
        over_horizon: 'last', 'sum' or 'min' over the predicted frames.

    Raises:
        ValueError: Shapes that do not fit each other, or numbers out of range, of any size.
        TypeError: Arrays of another dtype, or objects of another kind.
    """

    def __new__(
        cls,
        *,
        patch: NDArray[np.float32],
        patch_bias: NDArray[np.float32],
        context: NDArray[np.float32],
        middle: NDArray[np.float32],
        middle_bias: NDArray[np.float32],
        output: NDArray[np.float32],
        output_bias: NDArray[np.float32],
        free: NDArray[np.float32],
        action_scale: float,
        spacing: SupportsIndex,
        substeps: SupportsIndex,
        half_size: Sequence[float],
        edge: Sequence[float],
        colour: Sequence[float],
        action_low: Sequence[float],
        action_high: Sequence[float],
        image_size: SupportsIndex,
        blur: float = 0.0,
        over_horizon: Literal["last", "sum", "min"] = "last",
    ) -> Self: ...
    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 `[A]`."""
    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 `[A]`."""
    def frames(
        self,
        images: NDArray[np.uint8],
        keypoints: NDArray[np.float32],
        maps: NDArray[np.float32],
    ) -> KeypointFrames:
        """Frames of this world.

        Args:
            images: uint8 `[N, S, S, 3]`.
            keypoints: float32 `[N, 2]`, (row, column) in pixels.
            maps: What does not move, as the model was trained to see it, float32 `[N, S, S]`.

        Raises:
            ValueError: Shapes that do not fit each other or the world, or numbers that are not
                finite.
            TypeError: Arrays of another dtype, or what is no array.
        """
    def rollout_costs(
        self, starts: KeypointFrames, goals: KeypointFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs of candidates, float32 `[B, D]`.

        One whose actions are not numbers costs NaN.

        Args:
            starts: Frames of this world that candidates start from, `[B]`.
            goals: Frames that they are compared with, `[B]`.
            actions: float32 `[B, D, H, A]`, at most 2**28 numbers.

        Raises:
            ValueError: Frames or actions do not fit the world or each other.
            TypeError: An argument of another kind or dtype.
        """
    def rollout(self, starts: KeypointFrames, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Predicted keypoints, float32 `[B, D, H, 2]`, (row, column) in pixels.

        Args:
            starts: Frames of this world that candidates start from, `[B]`.
            actions: float32 `[B, D, H, A]`, at most 2**28 numbers, as must the answer be.

        Raises:
            As `rollout_costs`.
        """

# --- latents of any model -------------------------------------------------------------------

@final
class LatentFrames:
    """Frames of a `LatentWorld`: latents, and what is known of the frames besides. Immutable.

    Frames are of no world: any with latents of this length takes them. As starts, only their
    latents count; as goals, their targets (where there are none, what the world reads out of their
    latents) and constants. `frames[i]` are those at an integer (one frame, still a batch) or at
    integers `[N]`; they share memory.

    Args:
        latents: float32 `[N, Z]`.
        targets: What the read-out of a predicted latent is compared with where a frame is the goal,
            float32 `[N, P]`; None for the read-out of the frame's own latent.
        constants: What every predicted frame that counts costs more where a frame is the goal,
            float32 `[N]`; None for nothing. A read-out of the main part of an image makes its whole
            pixel cost so: the rest of the goal image, which no read-out can reach, is a constant.
        images: What the frames look like, uint8 `[N, H, W, 3]`: kept for others.

    Raises:
        ValueError: Another shape, not as many of one as of the other, or numbers that are not
            finite.
        TypeError: Another dtype, or what is no array.
    """

    def __new__(
        cls,
        latents: NDArray[np.float32],
        targets: NDArray[np.float32] | None = None,
        constants: NDArray[np.float32] | None = None,
        images: NDArray[np.uint8] | None = None,
    ) -> Self: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: _Index, /) -> LatentFrames: ...
    @property
    def latents(self) -> NDArray[np.float32]:
        """The latents, float32 `[N, Z]` (a copy)."""
    @property
    def targets(self) -> NDArray[np.float32] | None:
        """What read-outs are compared with, float32 `[N, P]` (a copy), or None."""
    @property
    def constants(self) -> NDArray[np.float32]:
        """What predicted frames cost more, float32 `[N]` (a copy)."""
    @property
    def images(self) -> NDArray[np.uint8]:
        """The images, uint8 `[N, H, W, 3]` (a copy).

        Raises:
            AttributeError: No images were given.
        """

@final
class LatentWorld:
    """A world whose frames are latents, moved by a network that is given by its weights.

    For models whose state is a vector, trained with torch or anything else: rollouts and costs run
    in Rust on all cores, without torch and without the GIL. To plan from images, give the planner
    an object with this world as its `native` and a method `observe(images) -> LatentFrames`.

    *Dynamics.* An action `[A]` is scaled so that its box is from -1 to 1 (one beyond the box is
    taken as it is): `u`. Then `z' = z + scale * network([z, u])`, or `z' = GRUCell(u, z)`.

    *Networks* are dicts of weights as `torch.nn.Linear` stores them, `(weight [outputs, inputs],
    bias [outputs])`, all float32:

    ```python
    {"input": (weight, bias),
     "blocks": [((weight, bias), (weight, bias)), ...],   # may be left out
     "output": (weight, bias),
     "activation": "relu" or "sin"}                       # may be left out: "relu"
    ```

    that is `h = activation(input(x))`, `h = relu(h + second(relu(first(h))))` for every block,
    `output(h)`.

    *Cost.* `sum(weights * (read(z) - target)**2) + constant` of every predicted latent that counts;
    target and constant are the goal's (`LatentFrames`). Without a read-out, `read(z) = z`.

    The same costs to the last bit alone and in a batch, with rollouts shared or not, on any number
    of threads, on any machine; those of torch within float32's rounding.

    Args:
        action_low: Lowest action, `[A]`.
        action_high: Highest action, `[A]`.
        dynamics: A network's dict, from `Z + A` numbers (the latent first) to `Z`, with one more
            entry, `"scale"`: a number or float32 `[Z]`, 1 if left out; or the weights of a
            `torch.nn.GRUCell(A, Z)` under their names there (`weight_ih [3 Z, A]`,
            `weight_hh [3 Z, Z]`, `bias_ih`, `bias_hh [3 Z]`): `cell.state_dict()`, as arrays.
        readout: What is compared of a latent: None for the latent itself (`P = Z`), a network's
            dict from `Z` numbers to `P`, or a float32 matrix `[P, Z]`. A matrix costs no more than
            `Z` rows would, however many it has, but is compared with goals' latents only, not with
            targets.
        weights: Of the numbers of the read-out, float32 `[P]`, none negative; None for 1.
        over_horizon: 'last', 'sum' or 'min' over the predicted latents.
        hold: Steps of actions that one step of the dynamics is long. The first of each `hold`
            actions is taken. A horizon must be a multiple of it, and so should the planners'
            `action_repeat`.

    Raises:
        ValueError: Shapes that do not fit each other, numbers out of range or not finite, entries
            that are missing or unknown; the message names the argument.
        TypeError: An argument of another kind or dtype.
    """

    def __new__(
        cls,
        action_low: Sequence[float] | NDArray[np.floating],
        action_high: Sequence[float] | NDArray[np.floating],
        dynamics: Mapping[str, Any],
        *,
        readout: NDArray[np.float32] | Mapping[str, Any] | None = None,
        weights: NDArray[np.float32] | None = None,
        over_horizon: Literal["last", "sum", "min"] = "last",
        hold: SupportsIndex = 1,
    ) -> Self: ...
    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 `[A]`."""
    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 `[A]`."""
    @property
    def latent_dim(self) -> int:
        """Length of a latent, `Z`."""
    @property
    def over_horizon(self) -> str:
        """Which predicted latents count."""
    @property
    def hold(self) -> int:
        """Steps of actions that one step of the dynamics is long."""
    @property
    def max_candidates(self) -> int:
        """The most candidates that the planners ask for in one call: fewer for dearer networks."""
    def rollout_costs(
        self, starts: LatentFrames, goals: LatentFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs of candidates, float32 `[B, D]`.

        One whose actions are not numbers costs NaN.

        Args:
            starts: Frames of this world that candidates start from, `[B]`.
            goals: Frames that they are compared with, `[B]`.
            actions: float32 `[B, D, H, A]`, at most 2**28 numbers.

        Raises:
            ValueError: Frames or actions do not fit the world or each other.
            TypeError: An argument of another kind or dtype.
        """
    def shared_rollout_costs(
        self, start: LatentFrames, goals: LatentFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs of the same candidates from one start to every goal, float32 `[B, D]`.

        Those of `rollout_costs`, to the last bit.

        Args:
            start: The frame that all candidates start from, `[1]`.
            goals: Frames that they are compared with, `[B]`.
            actions: float32 `[D, H, A]`, at most 2**28 numbers.

        Raises:
            As `rollout_costs`.
        """
    def rollout(self, starts: LatentFrames, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Predicted latents, float32 `[B, D, H / hold, Z]`.

        Args:
            starts: Frames that candidates start from, `[B]`.
            actions: float32 `[B, D, H, A]`, at most 2**28 numbers, as must the answer be.

        Raises:
            As `rollout_costs`.
        """

# --- the desk's learned dynamics model ------------------------------------------------------

_Layer: TypeAlias = tuple[NDArray[np.float32], NDArray[np.float32]]

@final
class LayerFrames:
    """Frames of a `LayerWorld`: images, the same without the arm, where parts are, and states.

    Made by `LayerWorld.frames`. `frames[i]` are those at an integer (one frame, still a batch) or
    at integers `[N]`; they share memory.
    """

    def __new__(cls, never: Never, /) -> Self: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: _Index, /) -> LayerFrames: ...
    @property
    def images(self) -> NDArray[np.uint8]:
        """The images, uint8 `[N, S, S, 3]` (a copy)."""
    @property
    def states(self) -> NDArray[np.float32]:
        """The states, float32 `[N, X]` (a copy)."""

@final
class LayerWorld:
    """The desk's learned dynamics model, evaluated in Rust; a world model with actions in [-1, 1].

    `hvf.worlds.layers.LayerWorld` makes one from a trained
    `hvf.models.layers.dynamics.LayerDynamics`. The cost is the squared pixel distance of the
    predicted frame to the goal, per pixel. Costs agree with those of torch to 1e-3 of their value,
    rollouts of 15 steps to 1e-2 pixels. Actions beyond the box are taken as they are: the model,
    which was trained within it, extrapolates.

    Letters in shapes: `A` = 3 action dimensions, `G` = 2 sliders, `R` parts that roam, `C` length
    of their memory, `T` size of a tile, `W` size of a sprite, `S` image size, `X` = A + G + 3R
    length of a state (hand; sliders; row, column and presence of each part).
    Networks are lists of layers, weights `[outputs, inputs]` and bias `[outputs]` as in
    `torch.nn.Linear`, with rectified units between.

    Args:
        hand: From hand, action and sliders (2A + G) to the hand's motion (A).
        sliders: For each, from sliders, hand, motion and action (G + 3A) to its motion (1).
        parts: From the hand beside the part, the hand's way, hand, motion, action, the part and its
            memory (7 + 3A + C) to its motion, change of presence and of memory (3 + C).
        contact: Terms of the pixel where the hand meets parts, float32
            `[1 + A + A (A + 1) / 2, 2]`.
        reach: Pixels from the hand's way beyond which a part does not move.
        arm_low: The hand's code at the first place of the grid of the arm's images, A numbers.
        arm_step: From one place to the next.
        arm_places: Places of the grid in each dimension.
        arm_patches: Opacity and colour times opacity of tiles, uint8 `[M, 4, T, T]`; the first is
            empty.
        arm_index: Number of the patch in each tile of each place's image, int32
            `[places, (S / T)**2]`.
        table: What is behind everything, uint8 `[bins, bins, 3, S, S]` over the sliders' ways.
        sprites: Opacity and colour times opacity of each part, float32 `[R, 4, W, W]`.
        blur: Standard deviation of the Gaussian blur before frames are compared, in pixels.
        over_horizon: 'last', 'sum' or 'min' over the predicted frames.
        hold: Steps that each action is held for; only frames after a held action count.
        scene_weight: How often what is behind the arm counts, beside the whole frame: the squared
            distance of frames without their arms, where the goal's hides nothing, without a blur.

    Raises:
        ValueError: Shapes that do not fit each other, or numbers out of range, of any size.
        TypeError: Arrays of another dtype, or objects of another kind.
    """

    def __new__(
        cls,
        *,
        hand: Sequence[_Layer],
        sliders: Sequence[Sequence[_Layer]],
        parts: Sequence[_Layer],
        contact: NDArray[np.float32],
        reach: float,
        arm_low: Sequence[float],
        arm_step: Sequence[float],
        arm_places: Sequence[int],
        arm_patches: NDArray[np.uint8],
        arm_index: NDArray[np.int32],
        table: NDArray[np.uint8],
        sprites: NDArray[np.float32],
        blur: float = 0.0,
        over_horizon: Literal["last", "sum", "min"] = "last",
        hold: SupportsIndex = 1,
        scene_weight: float = 0.0,
    ) -> Self: ...
    @property
    def action_low(self) -> NDArray[np.float32]:
        """Lowest action, float32 `[A]`."""
    @property
    def action_high(self) -> NDArray[np.float32]:
        """Highest action, float32 `[A]`."""
    def frames(
        self,
        images: NDArray[np.uint8],
        clean: NDArray[np.float32],
        regions: NDArray[np.bool_],
        states: NDArray[np.float32],
    ) -> LayerFrames:
        """Frames of this world.

        Args:
            images: uint8 `[N, S, S, 3]`.
            clean: The same without the arm, in [0, 1], float32 `[N, S, S, 3]`.
            regions: Where each part is in them, bool `[N, R, S, S]`.
            states: float32 `[N, X]`.

        Raises:
            ValueError: Shapes that do not fit each other or the world, or numbers that are not
                finite.
            TypeError: Arrays of another dtype, or what is no array.
        """
    def rollout_costs(
        self, starts: LayerFrames, goals: LayerFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs of candidates, float32 `[B, D]`.

        One whose actions are not numbers costs NaN.

        Args:
            starts: Frames of this world that candidates start from, `[B]`.
            goals: Frames that they are compared with, `[B]`.
            actions: float32 `[B, D, H, A]`, at most 2**28 numbers.

        Raises:
            ValueError: Frames or actions do not fit the world or each other.
            TypeError: An argument of another kind or dtype.
        """
    def shared_rollout_costs(
        self, start: LayerFrames, goals: LayerFrames, actions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Planning costs of the same candidates from one start to every goal, float32 `[B, D]`.

        Those of `rollout_costs`, to the last bit.

        Args:
            start: The frame that all candidates start from, `[1]`.
            goals: Frames that they are compared with, `[B]`.
            actions: float32 `[D, H, A]`, at most 2**28 numbers.

        Raises:
            As `rollout_costs`.
        """
    def rollout(self, starts: LayerFrames, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Predicted states, float32 `[B, D, H, X]`.

        Args:
            starts: Frames of this world that candidates start from, `[B]`.
            actions: float32 `[B, D, H, A]`, at most 2**28 numbers, as must the answer be.

        Raises:
            As `rollout_costs`.
        """
    def draw(self, starts: LayerFrames, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """What frames look like with other states, float32 `[N, S, S, 3]` in [0, 1].

        Args:
            starts: Frames of this world, `[N]`: their scene, and what is seen where.
            states: The states to be drawn, float32 `[N, X]`.

        Raises:
            ValueError: Frames or states that do not fit the world or each other.
            TypeError: An argument of another kind or dtype.
        """
    def predict(self, starts: LayerFrames, actions: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Predicted frames, uint8 `[N, H, S, S, 3]`.

        Args:
            starts: Frames of this world, `[N]`.
            actions: What is done from each, float32 `[N, H, A]`. The answer may have at most 2**28
                numbers.

        Raises:
            As `rollout_costs`.
        """
