//! `HVF`, the search for subgoal images, for Python.

use std::sync::{Mutex, PoisonError};

use hvf_core_rs::planner::{
    search, search_batch, Frames, HvfConfig, Progress, Reduction, SearchResult, SegmentCost, Watch,
};
use pyo3::exceptions::PyValueError;
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use super::arguments::{keywords, one_frame, seeds};
use super::border::{with_border, Axes, Border, FramesOf, Generator};
use super::budget::{budget_doc, budget_getters, Budget, SHRINKAGE};
use super::results::{PyPlans, PySearchResult};
use super::visual_mpc::PyVisualMpc;
use super::{raised, signals};
use crate::arguments::{
    check_problems, instance, text, wrong_type, Flag, Given, Real, Text, Whole,
};
use crate::error::to_py;
use crate::threads::detached;

/// Hierarchical visual foresight: the search for subgoal images.
///
/// The cross-entropy method over the latents of `subgoals` images, from a standard normal, or from
/// what the generator proposes (`hvf.protocols.Proposing`). A sample costs what the hardest of its
/// `subgoals + 1` segments costs to plan with `mpc` (paper, section 4 and algorithm 2). Subgoals,
/// latents, cost and plans of the answer are of one sample; how segments are planned is for the
/// options of `mpc` to say. Objects are immutable, compare and hash by value, and can be
/// copied and pickled.
///
/// Args:
///     mpc: How a segment is planned; None for `VisualMPC()`.
///     subgoals: Number of subgoals (`K`); 0 plans to the goal directly.
///     reduction: Cost of a sample from those of its segments: 'max', the hardest (the paper's),
///         'mean', or 'max-sum', the hardest and a tenth of the sum of all, so that of samples
///         whose hardest segments are about as hard the one with the least to do in all counts as
///         the best.
///     prune: Plan the segment of a sample first that a few candidates take for its hardest, drop
///         samples whose worst segment exceeds the `elites`-th best complete sample, and plan
///         other segments only until they are known to be no harder. Changes nothing but the time,
///         and what `population_mean` is over. Only with 'max'.
///     share_rollouts: Share the first iteration's rollouts of all first segments where the model
///         can (`shared_rollout_costs`). Changes nothing but the time.
///     chunk: Samples that pruning completes at a time, before it looks what is still worth
///         completing; None for as many as `elites`. Larger ones make fewer, fuller calls. Changes
///         nothing but the time.
///     segment_cost: Who says what a segment costs: 'planned', the planner, by the predicted cost
///         of its best plan (the paper's), or 'likelihood', the generator, by its `segment_costs`
///         and without a plan.
#[doc = budget_doc!()]
///
/// Raises:
///     ValueError: An argument is out of range; the message names it.
///     TypeError: An argument has the wrong type.
#[pyclass(name = "HVF", module = "hvf_core", frozen, eq, hash)]
#[derive(Clone, PartialEq, Hash)]
pub struct PyHvf {
    /// The settings, validated.
    pub config: HvfConfig,
}

#[pymethods]
impl PyHvf {
    #[new]
    #[pyo3(
        signature = (
            *, mpc=None, subgoals=Given::of(2), samples=Given::of(200), elites=Given::of(40),
            iterations=Given::of(5), min_variance=Given::of(1e-3), reduction=text("max"),
            keep_elites=Given::of(0), prune=Given::of(true), share_rollouts=Given::of(true), chunk=None,
            best=text("all"), segment_cost=text("planned"), momentum=Given::of(0.0),
            samples_decay=Given::of(1.0), temperature=None, min_std=Given::of(0.0),
            covariance=text("diagonal"), shrinkage=Given::of(SHRINKAGE)
        ),
        text_signature = "(*, mpc=None, subgoals=2, samples=200, elites=40, iterations=5, \
                          min_variance=0.001, reduction='max', keep_elites=0, prune=True, \
                          share_rollouts=True, chunk=None, best='all', segment_cost='planned', \
                          momentum=0.0, samples_decay=1.0, \
                          temperature=None, min_std=0.0, covariance='diagonal', \
                          shrinkage=0.1)"
    )]
    #[allow(clippy::too_many_arguments)]
    fn new(
        mpc: Option<&Bound<'_, PyAny>>,
        subgoals: Whole,
        samples: Whole,
        elites: Whole,
        iterations: Whole,
        min_variance: Real,
        reduction: Text,
        keep_elites: Whole,
        prune: Flag,
        share_rollouts: Flag,
        chunk: Option<&Bound<'_, PyAny>>,
        best: Text,
        segment_cost: Text,
        momentum: Real,
        samples_decay: Real,
        temperature: Option<&Bound<'_, PyAny>>,
        min_std: Real,
        covariance: Text,
        shrinkage: Real,
    ) -> PyResult<Self> {
        let reduction = match &*reduction.get("reduction")? {
            "max" => Reduction::Max,
            "mean" => Reduction::Mean,
            "max-sum" => Reduction::MaxSum,
            other => {
                return Err(PyValueError::new_err(format!(
                    "reduction: must be 'max', 'mean' or 'max-sum', got '{other}'"
                )))
            }
        };
        let segment_cost = match &*segment_cost.get("segment_cost")? {
            "planned" => SegmentCost::Planned,
            "likelihood" => SegmentCost::Likelihood,
            other => {
                return Err(PyValueError::new_err(format!(
                    "segment_cost: must be 'planned' or 'likelihood', got '{other}'"
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
        let mut config = HvfConfig::default();
        if let Some(mpc) = mpc {
            config.mpc = instance::<PyVisualMpc>("mpc", mpc)?.get().config.clone();
        }
        config.subgoals = subgoals.count("subgoals")?;
        config.cem = budget.config()?;
        config.reduction = reduction;
        config.segment_cost = segment_cost;
        config.prune = prune.get("prune")?;
        config.share_rollouts = share_rollouts.get("share_rollouts")?;
        config.chunk = match chunk.filter(|chunk| !chunk.is_none()) {
            Some(chunk) => Some(chunk.extract::<Whole>()?.count("chunk")?),
            None => None,
        };
        config.validate().map_err(to_py)?;
        Ok(Self { config })
    }

    /// Search for subgoals between `start` and `goal`.
    ///
    /// Args:
    ///     model: The world, as for `VisualMPC.plan`.
    ///     generator: An object with the methods of `hvf.protocols.SubgoalModel`; may be None for
    ///         `subgoals=0`.
    ///     start: One uint8 image `[height, width, 3]` or one frame of the model, `[1]`.
    ///     goal: The same for the goal.
    ///     seed: From 0 to 2**64 - 1. The same seed gives the same result to the last bit, with any
    ///         number of threads, and with `prune` and `share_rollouts` on or off.
    ///     progress: Called as `progress(iteration, iterations, cost)` after every iteration, the
    ///         first being 1, of at most `iterations`, with the lowest cost so far (of the last
    ///         iteration for `best='last'`). What it raises ends the search.
    ///
    /// Raises:
    ///     As `VisualMPC.plan`. An exception that ends a search after its first iteration
    ///     (KeyboardInterrupt by Ctrl-C, or any of `progress` or a model) has an attribute
    ///     `partial`: the `SearchResult` that the search would have given after its last finished
    ///     iteration (by 'likelihood', without plans).
    #[pyo3(
        signature = (model, generator, start, goal, seed=Given::of(0), progress=None),
        text_signature = "($self, model, generator, start, goal, seed=0, progress=None)"
    )]
    fn search(
        &self,
        model: &Bound<'_, PyAny>,
        generator: &Bound<'_, PyAny>,
        start: &Bound<'_, PyAny>,
        goal: &Bound<'_, PyAny>,
        seed: Whole,
        progress: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<PySearchResult> {
        let seed = seed.seed("seed")?;
        with_border!(model, |border| {
            let start = one_frame(&border, "start", start)?;
            let goal = one_frame(&border, "goal", goal)?;
            let generator = Generator::new(generator, &border, self.config.subgoals)?;
            self.solve(model.py(), &border, &generator, [&start, &goal], seed, progress)
        })
    }

    /// Search for `B` pairs of start and goal: each result is what `search` finds alone.
    ///
    /// The searches go on side by side: a model whose frames can be joined (`hvf.protocols.Frames`)
    /// plans the segments of all of them in the same calls.
    ///
    /// Args:
    ///     model: As for `search`.
    ///     generator: As for `search`.
    ///     starts: Uint8 images `[B, height, width, 3]` or frames of the model, `[B]`; or one,
    ///         `[1, ...]`, for all goals.
    ///     goals: Images or frames, `[B]`.
    ///     seeds: One seed for all, one for each `[B]`, or None for 0.
    ///
    /// Raises:
    ///     As `search`.
    #[pyo3(signature = (model, generator, starts, goals, seeds=None))]
    fn search_batch(
        &self,
        model: &Bound<'_, PyAny>,
        generator: &Bound<'_, PyAny>,
        starts: &Bound<'_, PyAny>,
        goals: &Bound<'_, PyAny>,
        seeds: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Vec<PySearchResult>> {
        with_border!(model, |border| {
            let starts = border.read("starts", starts, Axes::Batch)?;
            let goals = border.read("goals", goals, Axes::Batch)?;
            check_problems("starts", starts.len())?;
            let count = check_problems("goals", goals.len())?;
            if starts.len() != count && starts.len() != 1 {
                return Err(PyValueError::new_err(format!(
                    "starts: must hold one frame or as many as goals ({count}), got {}",
                    starts.len()
                )));
            }
            let seeds = self::seeds(seeds, count)?;
            let generator = Generator::new(generator, &border, self.config.subgoals)?;
            let py = model.py();
            let found = detached(py, || {
                let watch = Watch { interrupt: &signals(), ..Watch::nobody() };
                let ends = [&starts, &goals];
                search_batch(&self.config, border.world(), &generator, ends, &seeds, watch)
            })?;
            let found = found.map_err(|error| border.error(py, error))?;
            found.into_iter().map(|found| written(py, &border, found)).collect()
        })
    }

    /// Share of the sum of segments in `reduction='max-sum'`.
    #[classattr]
    const TIE: f64 = Reduction::TIE;

    /// The argument of this name.
    #[getter]
    fn mpc(&self) -> PyVisualMpc {
        PyVisualMpc { config: self.config.mpc.clone() }
    }
    /// The argument of this name.
    #[getter]
    fn subgoals(&self) -> usize {
        self.config.subgoals
    }
    /// The argument of this name.
    #[getter]
    fn reduction(&self) -> &'static str {
        match self.config.reduction {
            Reduction::Max => "max",
            Reduction::Mean => "mean",
            Reduction::MaxSum => "max-sum",
        }
    }
    /// The argument of this name.
    #[getter]
    fn prune(&self) -> bool {
        self.config.prune
    }
    /// The argument of this name.
    #[getter]
    fn share_rollouts(&self) -> bool {
        self.config.share_rollouts
    }
    /// The argument of this name.
    #[getter]
    fn chunk(&self) -> Option<usize> {
        self.config.chunk
    }
    /// The argument of this name.
    #[getter]
    fn segment_cost(&self) -> &'static str {
        match self.config.segment_cost {
            SegmentCost::Planned => "planned",
            SegmentCost::Likelihood => "likelihood",
        }
    }
    /// The arguments that make an equal object, for copies and pickles.
    fn __getnewargs_ex__<'py>(
        slf: &Bound<'py, Self>,
    ) -> PyResult<(Bound<'py, PyTuple>, Bound<'py, PyDict>)> {
        let arguments = PyDict::new(slf.py());
        for name in [
            "mpc",
            "subgoals",
            "samples",
            "elites",
            "iterations",
            "min_variance",
            "reduction",
            "keep_elites",
            "prune",
            "share_rollouts",
            "chunk",
            "best",
            "segment_cost",
            "momentum",
            "samples_decay",
            "temperature",
            "min_std",
            "covariance",
            "shrinkage",
        ] {
            arguments.set_item(name, slf.getattr(name)?)?;
        }
        Ok((PyTuple::empty(slf.py()), arguments))
    }

    fn __repr__(slf: &Bound<'_, Self>) -> PyResult<String> {
        let (_, arguments) = Self::__getnewargs_ex__(slf)?;
        Ok(format!("HVF({})", keywords(&arguments)?))
    }
}

budget_getters!(PyHvf);

impl PyHvf {
    /// Searches without the GIL; the models take it where they need it.
    fn solve<B: Border>(
        &self,
        py: Python<'_>,
        border: &B,
        generator: &Generator<'_, B>,
        [start, goal]: [&FramesOf<B>; 2],
        seed: u64,
        progress: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<PySearchResult>
    where
        FramesOf<B>: Sync,
    {
        let progress = progress.filter(|progress| !progress.is_none());
        if let Some(progress) = progress.filter(|progress| !progress.is_callable()) {
            return Err(wrong_type(
                "progress",
                "None or progress(iteration, iterations, cost)",
                progress,
            ));
        }
        let told = progress.map(|progress| progress.clone().unbind());
        let tell = |Progress { iteration, iterations, cost, .. }| match &told {
            None => Ok(()),
            Some(told) => Python::attach(|py| told.call1(py, (iteration, iterations, cost)))
                .map(drop)
                .map_err(raised),
        };
        let partial = Mutex::new(None);
        let keep = |found| {
            *partial.lock().unwrap_or_else(PoisonError::into_inner) = Some(found);
        };
        let found = detached(py, || {
            let watch = Watch { interrupt: &signals(), progress: &tell, partial: &keep };
            search(&self.config, border.world(), generator, start, goal, seed, watch)
        })?;
        let partial = partial.into_inner().unwrap_or_else(PoisonError::into_inner);
        match found {
            Ok(found) => written(py, border, found),
            Err(error) => {
                let exception = border.error(py, error);
                if let Some(partial) = partial {
                    let partial = Bound::new(py, written(py, border, partial)?)?;
                    exception.value(py).setattr(intern!(py, "partial"), partial)?;
                }
                Err(exception)
            }
        }
    }
}

/// What a search found, as Python sees it.
fn written<B: Border>(
    py: Python<'_>,
    border: &B,
    found: SearchResult<FramesOf<B>>,
) -> PyResult<PySearchResult> {
    Ok(PySearchResult {
        subgoals: border.write(py, found.subgoals)?.unbind(),
        cost: found.cost,
        plans: Py::new(py, PyPlans { inner: found.plans })?,
        latents: found.latents,
        history: found.history,
    })
}
