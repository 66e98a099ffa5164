//! `VisualMPC` for Python.

use hvf_core_rs::planner::mpc::plan;
use hvf_core_rs::planner::sampler::{Purpose, Stream};
use hvf_core_rs::planner::{ActionInitial, Frames, MpcConfig, Plan, Problems, WarmStart};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use super::arguments::{
    corner, keywords, one_frame, one_warm_start, seeds, warm_starts, LastPlans,
};
use super::border::{with_border, Axes, Border, FramesOf};
use super::budget::{budget_doc, budget_getters, Budget, SHRINKAGE};
use super::results::{PyPlan, PyPlans};
use super::signals;
use crate::arguments::{check_problems, text, Flag, Given, Real, Text, Whole};
use crate::error::to_py;
use crate::threads::detached;

/// Visual model-predictive control: the cross-entropy method over actions.
///
/// Draws `samples` candidates of `horizon` steps, keeps the `elites` with the lowest predicted
/// cost and refits a diagonal Gaussian to them, until its largest variance falls below
/// `min_variance` or `iterations` are used up (paper, section 3 and algorithm 1). Options make it
/// iCEM, MPPI or a search with full covariance. Objects are immutable, compare and hash by value,
/// and can be copied and pickled.
///
/// Args:
///     horizon: Model steps that a plan looks ahead (`H`).
///     action_repeat: Model steps that one drawn action is held for; divides `horizon`.
///     initial: First iteration's distribution: 'uniform' over the action box, or 'normal' (the
///         paper's has mean 0 and deviation 1).
///     initial_low: Lower corner of a part of the action box, `[A]`, for 'uniform'; None for the
///         box's own.
///     initial_high: Upper corner, `[A]`. The original maze code drew `x >= 0` only, a hint that
///         the goal is to the right.
///     initial_mean: Mean of 'normal', in units of an action.
///     initial_std: Standard deviation of 'normal'.
///     warm_start_std: Standard deviation around a warm start, in units of an action.
///     clip: Whether candidates drawn from a Gaussian (a refitted one, 'normal', around a warm
///         start) are clipped to the action box. The authors' released code does not: plans may
///         then lie beyond the box, and what a model makes of such actions is its own affair
///         (`MazeWorld` clips them, learned worlds extrapolate).
///     noise_beta: How fast the power of the noise of drawn actions falls with its frequency over
///         the time steps of a plan, `f**-noise_beta`: 0 for white noise, 2 for iCEM's (Pinneri
///         et al., 2020). Single actions are distributed as without. For at most 256 actions a
///         plan, and 'diagonal'.
///     shift_elites: Best candidates of its last iteration that a plan keeps; in a next plan with
///         this as `warm_start` they take the place of as many samples of the first iteration,
///         shifted by one step (iCEM). At most `elites`.
#[doc = budget_doc!()]
///
/// Raises:
///     ValueError: An argument is out of range; the message names it.
///     TypeError: An argument has the wrong type.
#[pyclass(name = "VisualMPC", module = "hvf_core", frozen, eq, hash)]
#[derive(Clone, PartialEq, Hash)]
pub struct PyVisualMpc {
    /// The settings, validated.
    pub config: MpcConfig,
}

#[pymethods]
impl PyVisualMpc {
    #[new]
    #[pyo3(
        signature = (
            *, horizon=Given::of(5), samples=Given::of(200), elites=Given::of(40), iterations=Given::of(5),
            min_variance=Given::of(1e-3), action_repeat=Given::of(1), initial=text("uniform"), initial_low=None,
            initial_high=None, initial_mean=Given::of(0.0), initial_std=Given::of(1.0),
            keep_elites=Given::of(0), warm_start_std=Given::of(1.0), clip=Given::of(true),
            best=text("all"), momentum=Given::of(0.0),
            samples_decay=Given::of(1.0), temperature=None, min_std=Given::of(0.0),
            covariance=text("diagonal"), shrinkage=Given::of(SHRINKAGE), noise_beta=Given::of(0.0),
            shift_elites=Given::of(0)
        ),
        text_signature = "(*, horizon=5, samples=200, elites=40, iterations=5, \
                          min_variance=0.001, action_repeat=1, initial='uniform', \
                          initial_low=None, initial_high=None, initial_mean=0.0, \
                          initial_std=1.0, keep_elites=0, warm_start_std=1.0, clip=True, \
                          best='all', momentum=0.0, samples_decay=1.0, \
                          temperature=None, min_std=0.0, covariance='diagonal', \
                          shrinkage=0.1, noise_beta=0.0, shift_elites=0)"
    )]
    #[allow(clippy::too_many_arguments)]
    fn new(
        horizon: Whole,
        samples: Whole,
        elites: Whole,
        iterations: Whole,
        min_variance: Real,
        action_repeat: Whole,
        initial: Text,
        initial_low: Option<&Bound<'_, PyAny>>,
        initial_high: Option<&Bound<'_, PyAny>>,
        initial_mean: Real,
        initial_std: Real,
        keep_elites: Whole,
        warm_start_std: Real,
        clip: Flag,
        best: Text,
        momentum: Real,
        samples_decay: Real,
        temperature: Option<&Bound<'_, PyAny>>,
        min_std: Real,
        covariance: Text,
        shrinkage: Real,
        noise_beta: Real,
        shift_elites: Whole,
    ) -> PyResult<Self> {
        let low = corner("initial_low", initial_low)?;
        let high = corner("initial_high", initial_high)?;
        let (mean, std) = (initial_mean.get("initial_mean")?, initial_std.get("initial_std")?);
        let initial = match &*initial.get("initial")? {
            "uniform" => ActionInitial::Uniform { low, high },
            "normal" => match (low, high) {
                (None, None) => ActionInitial::Normal { mean, std },
                (low, _) => {
                    let name = if low.is_some() { "initial_low" } else { "initial_high" };
                    return Err(PyValueError::new_err(format!(
                        "{name}: belongs to initial='uniform', got initial='normal'"
                    )));
                }
            },
            other => {
                return Err(PyValueError::new_err(format!(
                    "initial: must be 'uniform' or 'normal', got '{other}'"
                )))
            }
        };
        let budget = Budget {
            samples,
            elites,
            iterations,
            min_variance,
            keep_elites,
            best,
            momentum,
            samples_decay,
            temperature,
            min_std,
            covariance,
            shrinkage,
        };
        let mut config = MpcConfig::default();
        config.horizon = horizon.count("horizon")?;
        config.action_repeat = action_repeat.count("action_repeat")?;
        config.initial = initial;
        config.warm_start_std = warm_start_std.get("warm_start_std")?;
        config.clip = clip.get("clip")?;
        config.noise_beta = noise_beta.get("noise_beta")?;
        config.shift_elites = shift_elites.count("shift_elites")?;
        config.cem = budget.config()?;
        config.validate().map_err(to_py)?;
        Ok(Self { config })
    }

    /// Find actions that lead from `start` to `goal`.
    ///
    /// Args:
    ///     model: A world of this module, an object whose `native` is one, or any object with the
    ///         methods of `hvf.protocols.WorldModel`. Costs of its own that `native` would hide
    ///         are refused; see there.
    ///     start: One uint8 image `[height, width, 3]` (which goes through the model's `observe`,
    ///         if it has one) or one frame of the model, `[1]`.
    ///     goal: The same for the goal.
    ///     seed: From 0 to 2**64 - 1. The same seed gives the same plan to the last bit, with any
    ///         number of threads, alone or in a batch.
    ///     warm_start: The last plan, as it was before its first action was taken: the search
    ///         starts from a Gaussian around the rest of it. A `Plan` or float actions `[H, A]`.
    ///     warm_elites: The best candidates of that plan, as they were before its first action was
    ///         taken, float `[S, H, A]` with `S` at most `shift_elites`; None for those that a
    ///         `Plan` brings.
    ///
    /// Raises:
    ///     ValueError: An argument does not fit, or the model answered with the wrong shape or with
    ///         NaN only; the message names the argument or the model's method.
    ///     TypeError: An argument is of the wrong kind, or the model lacks a method.
    ///     KeyboardInterrupt: Ctrl-C: within a second of native work, else between two calls of
    ///         the model. What a model raises comes back as it is.
    ///     RuntimeError: This process was forked after the module had worked in its parent, whose
    ///         threads it lacks; start processes by 'spawn' or 'forkserver'.
    #[pyo3(
        signature = (model, start, goal, seed=Given::of(0), warm_start=None, warm_elites=None),
        text_signature = "($self, model, start, goal, seed=0, warm_start=None, warm_elites=None)"
    )]
    fn plan(
        &self,
        model: &Bound<'_, PyAny>,
        start: &Bound<'_, PyAny>,
        goal: &Bound<'_, PyAny>,
        seed: Whole,
        warm_start: Option<&Bound<'_, PyAny>>,
        warm_elites: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<PyPlan> {
        let seed = seed.seed("seed")?;
        let warm_start = one_warm_start(warm_start, warm_elites, self.config.shift_elites)?;
        let plans = with_border!(model, |border| {
            let start = one_frame(&border, "start", start)?;
            let goal = one_frame(&border, "goal", goal)?;
            self.solve(model.py(), &border, &start, &goal, &[seed], warm_start)
        })?;
        let inner = plans.into_iter().next().expect("one problem, one plan");
        Ok(PyPlan { inner })
    }

    /// Solve `B` problems together: as `plan` one by one, to the last bit.
    ///
    /// Args:
    ///     model: As for `plan`.
    ///     starts: Uint8 images `[B, height, width, 3]` or frames of the model, `[B]`, at most
    ///         2**20; or one, `[1, ...]`, for all goals. Three axes are never one image here.
    ///     goals: Images or frames, `[B]`.
    ///     seeds: One seed for all, one for each `[B]`, or None for 0. Problems with one start and
    ///         one seed share their first iteration's rollouts where the model can.
    ///     warm_start: The last plans: `Plans` or float actions `[B, H, A]`.
    ///     warm_elites: Their best candidates, float `[B, S, H, A]`, unless `Plans` bring them.
    ///
    /// Raises:
    ///     As `plan`.
    #[pyo3(signature = (model, starts, goals, seeds=None, warm_start=None, warm_elites=None))]
    fn plan_batch(
        &self,
        model: &Bound<'_, PyAny>,
        starts: &Bound<'_, PyAny>,
        goals: &Bound<'_, PyAny>,
        seeds: Option<&Bound<'_, PyAny>>,
        warm_start: Option<&Bound<'_, PyAny>>,
        warm_elites: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<PyPlans> {
        let warm_start = warm_starts(warm_start, warm_elites, self.config.shift_elites)?;
        let inner = with_border!(model, |border| {
            let starts = border.read("starts", starts, Axes::Batch)?;
            let goals = border.read("goals", goals, Axes::Batch)?;
            check_problems("starts", starts.len())?;
            let seeds = self::seeds(seeds, check_problems("goals", goals.len())?)?;
            self.solve(model.py(), &border, &starts, &goals, &seeds, warm_start)
        })?;
        Ok(PyPlans { inner })
    }

    /// The argument of this name.
    #[getter]
    fn horizon(&self) -> usize {
        self.config.horizon
    }
    /// The argument of this name.
    #[getter]
    fn action_repeat(&self) -> usize {
        self.config.action_repeat
    }
    /// The argument of this name.
    #[getter]
    fn warm_start_std(&self) -> f64 {
        self.config.warm_start_std
    }
    /// The argument of this name.
    #[getter]
    fn clip(&self) -> bool {
        self.config.clip
    }
    /// The argument of this name.
    #[getter]
    fn noise_beta(&self) -> f64 {
        self.config.noise_beta
    }
    /// The argument of this name.
    #[getter]
    fn shift_elites(&self) -> usize {
        self.config.shift_elites
    }
    /// The argument of this name.
    #[getter]
    fn initial(&self) -> &'static str {
        match self.config.initial {
            ActionInitial::Uniform { .. } => "uniform",
            ActionInitial::Normal { .. } => "normal",
        }
    }
    /// The argument of this name; None for the box's own and for 'normal'.
    #[getter]
    fn initial_low(&self) -> Option<Vec<f64>> {
        match &self.config.initial {
            ActionInitial::Uniform { low, .. } => low.clone(),
            ActionInitial::Normal { .. } => None,
        }
    }
    /// The argument of this name; None for the box's own and for 'normal'.
    #[getter]
    fn initial_high(&self) -> Option<Vec<f64>> {
        match &self.config.initial {
            ActionInitial::Uniform { high, .. } => high.clone(),
            ActionInitial::Normal { .. } => None,
        }
    }
    /// The argument of this name; 0 for 'uniform'.
    #[getter]
    fn initial_mean(&self) -> f64 {
        match self.config.initial {
            ActionInitial::Uniform { .. } => 0.0,
            ActionInitial::Normal { mean, .. } => mean,
        }
    }
    /// The argument of this name; 1 for 'uniform'.
    #[getter]
    fn initial_std(&self) -> f64 {
        match self.config.initial {
            ActionInitial::Uniform { .. } => 1.0,
            ActionInitial::Normal { std, .. } => std,
        }
    }
    /// The arguments that make an equal object, for copies and pickles.
    fn __getnewargs_ex__<'py>(
        slf: &Bound<'py, Self>,
    ) -> PyResult<(Bound<'py, PyTuple>, Bound<'py, PyDict>)> {
        let arguments = PyDict::new(slf.py());
        for name in [
            "horizon",
            "samples",
            "elites",
            "iterations",
            "min_variance",
            "action_repeat",
            "initial",
            "initial_low",
            "initial_high",
            "initial_mean",
            "initial_std",
            "keep_elites",
            "warm_start_std",
            "clip",
            "best",
            "momentum",
            "samples_decay",
            "temperature",
            "min_std",
            "covariance",
            "shrinkage",
            "noise_beta",
            "shift_elites",
        ] {
            arguments.set_item(name, slf.getattr(name)?)?;
        }
        Ok((PyTuple::empty(slf.py()), arguments))
    }

    fn __repr__(slf: &Bound<'_, Self>) -> PyResult<String> {
        let (_, arguments) = Self::__getnewargs_ex__(slf)?;
        Ok(format!("VisualMPC({})", keywords(&arguments)?))
    }
}

budget_getters!(PyVisualMpc);

impl PyVisualMpc {
    /// Plans without the GIL; the model takes it where it needs it.
    fn solve<B: Border>(
        &self,
        py: Python<'_>,
        border: &B,
        starts: &FramesOf<B>,
        goals: &FramesOf<B>,
        seeds: &[u64],
        last: Option<LastPlans>,
    ) -> PyResult<Vec<Plan>>
    where
        FramesOf<B>: Sync,
    {
        let streams: Vec<Stream> = seeds
            .iter()
            .map(|&seed| Stream { seed, purpose: Purpose::Actions, problem: 0 })
            .collect();
        let warm_start = last
            .as_ref()
            .map(|LastPlans { actions, elites }| WarmStart { actions, elites: elites.as_ref() });
        let solved = detached(py, || {
            let problems = Problems {
                starts,
                goals,
                streams: &streams,
                warm_start,
                share_rollouts: true,
                describe: &|problem| format!("problem {problem}"),
            };
            plan(&self.config, border.world(), &problems, &signals())
        })?;
        solved.map_err(|error| border.error(py, error))
    }
}
