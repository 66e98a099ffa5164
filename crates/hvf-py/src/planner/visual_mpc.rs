//! `VisualMPC` for Python.

use hvf_core_rs::planner::mpc::plan;
use hvf_core_rs::planner::sampler::{Purpose, Stream};
use hvf_core_rs::planner::{ActionInitial, Frames, MpcConfig, Plan, Problems, WarmStart};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use super::arguments::{corner, one_warm_start, seeds, warm_starts, LastPlans};
use super::border::{with_border, Axes, Border, FramesOf};
use super::budget::{best_name, covariance_name, shrinkage, Budget, SHRINKAGE};
use super::results::{PyPlan, PyPlans};
use super::signals;
use crate::arguments::{check_problems, text, Flag, Given, Real, Text, Whole};
use crate::error::to_py;
use crate::threads::detached;

/// Visual model-predictive control: the cross-entropy method over actions.
///
/// Draws `samples` candidates of `horizon` steps, keeps the `elites` with the lowest predicted
/// cost and refits a diagonal Gaussian to them, until its largest variance falls below
/// `min_variance` or `iterations` are used up (paper, section 3). Options make it iCEM, MPPI or a
/// search with full covariance. Immutable; arguments out of
/// range raise a ValueError that names them. The stub file describes every argument.
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

    /// Actions that lead from `start` to `goal`: a `Plan`.
    ///
    /// `model` is a native world, an object whose `native` is one, or any object with the methods of
    /// `hvf.protocols.WorldModel`. `start` and `goal` are each one uint8 image [H, W, 3] or one frame of
    /// the model. The same seed gives the same plan to the last bit. `warm_start` is the last plan
    /// (a `Plan` or actions [H, A]), as it was before its first action was taken, and `warm_elites` its
    /// best candidates [S, H, A], unless it brings them.
    ///
    /// Raises ValueError or TypeError naming the argument, or the model's method, that does not fit;
    /// what the model raises comes back as it is.
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

    /// `B` problems solved together, to the last bit as by `plan` one by one: `Plans`.
    ///
    /// `starts` and `goals` are uint8 images [B, H, W, 3] or frames of the model; one start serves all
    /// goals. `seeds` is one for all, one for each, or None for 0.
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

    #[getter]
    fn horizon(&self) -> usize {
        self.config.horizon
    }
    #[getter]
    fn action_repeat(&self) -> usize {
        self.config.action_repeat
    }
    #[getter]
    fn warm_start_std(&self) -> f64 {
        self.config.warm_start_std
    }
    #[getter]
    fn clip(&self) -> bool {
        self.config.clip
    }
    #[getter]
    fn noise_beta(&self) -> f64 {
        self.config.noise_beta
    }
    #[getter]
    fn shift_elites(&self) -> usize {
        self.config.shift_elites
    }
    #[getter]
    fn initial(&self) -> &'static str {
        match self.config.initial {
            ActionInitial::Uniform { .. } => "uniform",
            ActionInitial::Normal { .. } => "normal",
        }
    }
    #[getter]
    fn initial_low(&self) -> Option<Vec<f64>> {
        match &self.config.initial {
            ActionInitial::Uniform { low, .. } => low.clone(),
            ActionInitial::Normal { .. } => None,
        }
    }
    #[getter]
    fn initial_high(&self) -> Option<Vec<f64>> {
        match &self.config.initial {
            ActionInitial::Uniform { high, .. } => high.clone(),
            ActionInitial::Normal { .. } => None,
        }
    }
    #[getter]
    fn initial_mean(&self) -> f64 {
        match self.config.initial {
            ActionInitial::Uniform { .. } => 0.0,
            ActionInitial::Normal { mean, .. } => mean,
        }
    }
    #[getter]
    fn initial_std(&self) -> f64 {
        match self.config.initial {
            ActionInitial::Uniform { .. } => 1.0,
            ActionInitial::Normal { std, .. } => std,
        }
    }
    #[getter]
    fn samples(&self) -> usize {
        self.config.cem.samples
    }
    #[getter]
    fn elites(&self) -> usize {
        self.config.cem.elites
    }
    #[getter]
    fn iterations(&self) -> usize {
        self.config.cem.iterations
    }
    #[getter]
    fn min_variance(&self) -> f64 {
        self.config.cem.min_variance
    }
    #[getter]
    fn keep_elites(&self) -> usize {
        self.config.cem.keep_elites
    }
    #[getter]
    fn best(&self) -> &'static str {
        best_name(&self.config.cem)
    }
    #[getter]
    fn momentum(&self) -> f64 {
        self.config.cem.momentum
    }
    #[getter]
    fn samples_decay(&self) -> f64 {
        self.config.cem.samples_decay
    }
    #[getter]
    fn temperature(&self) -> Option<f64> {
        self.config.cem.temperature
    }
    #[getter]
    fn min_std(&self) -> f64 {
        self.config.cem.min_std
    }
    #[getter]
    fn covariance(&self) -> &'static str {
        covariance_name(&self.config.cem)
    }
    #[getter]
    fn shrinkage(&self) -> f64 {
        shrinkage(&self.config.cem)
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

/// One frame, named in the error if it is more or fewer.
pub fn one_frame<B: Border>(
    border: &B,
    argument: &str,
    object: &Bound<'_, PyAny>,
) -> PyResult<FramesOf<B>> {
    let frames = border.read(argument, object, Axes::OneOrBatch)?;
    match frames.len() {
        1 => Ok(frames),
        count => Err(PyValueError::new_err(format!(
            "{argument}: must be one uint8 image [H, W, 3] or one frame of the model, got {count} \
             frames"
        ))),
    }
}

/// `name=value, ..` of a dictionary.
pub fn keywords(arguments: &Bound<'_, PyDict>) -> PyResult<String> {
    let parts: Vec<String> = arguments
        .iter()
        .map(|(name, value)| Ok(format!("{name}={}", value.repr()?)))
        .collect::<PyResult<_>>()?;
    Ok(parts.join(", "))
}
