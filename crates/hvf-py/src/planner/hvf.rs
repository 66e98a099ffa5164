//! `HVF`, the search for subgoal images, for Python.

use hvf_core_rs::planner::{
    search, CemConfig, Frames, HvfConfig, MpcConfig, Reduction, SegmentCost,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use super::arguments::{best_name, best_of, seeds};
use super::border::{with_border, Axes, Border, FramesOf, Generator};
use super::results::{PyPlans, PySearchResult};
use super::signals;
use super::visual_mpc::{keywords, one_frame, PyVisualMpc};
use crate::arguments::{check_problems, instance, text, Flag, Given, Real, Text, Whole};
use crate::error::to_py;
use crate::threads::detached;

/// Hierarchical visual foresight: the search for subgoal images.
///
/// The cross-entropy method over the latents of `subgoals` images, where a sample costs what the
/// hardest of its `subgoals + 1` segments costs to plan with `mpc` (paper, section 4). Immutable;
/// arguments out of range raise a ValueError that names them. The stub file describes every
/// argument.
#[pyclass(name = "HVF", module = "hvf_core", frozen, eq, hash)]
#[derive(Clone, PartialEq)]
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
            keep_elites=Given::of(0), prune=Given::of(true), share_rollouts=Given::of(true),
            best=text("all"), segment_cost=text("planned")
        ),
        text_signature = "(*, mpc=None, subgoals=2, samples=200, elites=40, iterations=5, \
                          min_variance=0.001, reduction='max', keep_elites=0, prune=True, \
                          share_rollouts=True, best='all', segment_cost='planned')"
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
        best: Text,
        segment_cost: Text,
    ) -> PyResult<Self> {
        let reduction = match &*reduction.get("reduction")? {
            "max" => Reduction::Max,
            "mean" => Reduction::Mean,
            other => {
                return Err(PyValueError::new_err(format!(
                    "reduction: must be 'max' or 'mean', got '{other}'"
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
        let config = HvfConfig {
            mpc: match mpc {
                None => MpcConfig::default(),
                Some(mpc) => instance::<PyVisualMpc>("mpc", mpc)?.get().config.clone(),
            },
            subgoals: subgoals.count("subgoals")?,
            cem: CemConfig {
                samples: samples.count("samples")?,
                elites: elites.count("elites")?,
                iterations: iterations.count("iterations")?,
                min_variance: min_variance.get("min_variance")?,
                keep_elites: keep_elites.count("keep_elites")?,
                best: best_of(best)?,
            },
            reduction,
            segment_cost,
            prune: prune.get("prune")?,
            share_rollouts: share_rollouts.get("share_rollouts")?,
        };
        config.validate().map_err(to_py)?;
        Ok(Self { config })
    }

    /// Subgoals between `start` and `goal`: a `SearchResult`.
    ///
    /// `model`, `start`, `goal` and `seed` are as for `VisualMPC.plan`; `generator` is any object with
    /// the methods of `hvf.protocols.SubgoalModel` (None will do for `subgoals=0`). The result does not
    /// depend on the number of threads, nor on `prune` and `share_rollouts`. With
    /// `segment_cost='likelihood'` only the segments of the answer are planned.
    #[pyo3(
        signature = (model, generator, start, goal, seed=Given::of(0)),
        text_signature = "($self, model, generator, start, goal, seed=0)"
    )]
    fn search(
        &self,
        model: &Bound<'_, PyAny>,
        generator: &Bound<'_, PyAny>,
        start: &Bound<'_, PyAny>,
        goal: &Bound<'_, PyAny>,
        seed: Whole,
    ) -> PyResult<PySearchResult> {
        let seed = seed.seed("seed")?;
        with_border!(model, |border| {
            let start = one_frame(&border, "start", start)?;
            let goal = one_frame(&border, "goal", goal)?;
            let generator = Generator::new(generator, &border, self.config.subgoals)?;
            self.solve(model.py(), &border, &generator, &start, &goal, seed)
        })
    }

    /// A list of `B` results, as by `search` one by one. `starts`, `goals` and `seeds` are as for
    /// `VisualMPC.plan_batch`.
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
            seeds
                .into_iter()
                .enumerate()
                .map(|(episode, seed)| {
                    let start = frame_of(&starts, episode)?;
                    let goal = frame_of(&goals, episode)?;
                    self.solve(model.py(), &border, &generator, &start, &goal, seed)
                })
                .collect()
        })
    }

    #[getter]
    fn mpc(&self) -> PyVisualMpc {
        PyVisualMpc { config: self.config.mpc.clone() }
    }
    #[getter]
    fn subgoals(&self) -> usize {
        self.config.subgoals
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
    fn reduction(&self) -> &'static str {
        match self.config.reduction {
            Reduction::Max => "max",
            Reduction::Mean => "mean",
        }
    }
    #[getter]
    fn keep_elites(&self) -> usize {
        self.config.cem.keep_elites
    }
    #[getter]
    fn prune(&self) -> bool {
        self.config.prune
    }
    #[getter]
    fn share_rollouts(&self) -> bool {
        self.config.share_rollouts
    }
    #[getter]
    fn best(&self) -> &'static str {
        best_name(self.config.cem.best)
    }
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
            "best",
            "segment_cost",
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

/// The frame of one episode; a single frame stands for all.
fn frame_of<F: Frames>(frames: &F, episode: usize) -> PyResult<F> {
    let place = if frames.len() == 1 { 0 } else { episode };
    frames.select(&[place]).map_err(to_py)
}

impl PyHvf {
    /// Searches without the GIL; the models take it where they need it.
    fn solve<B: Border>(
        &self,
        py: Python<'_>,
        border: &B,
        generator: &Generator<'_, B>,
        start: &FramesOf<B>,
        goal: &FramesOf<B>,
        seed: u64,
    ) -> PyResult<PySearchResult>
    where
        FramesOf<B>: Sync,
    {
        let found = detached(py, || {
            search(&self.config, border.world(), generator, start, goal, seed, &signals())
        })?
        .map_err(|error| border.error(py, error))?;
        Ok(PySearchResult {
            subgoals: border.write(py, found.subgoals)?.unbind(),
            cost: found.cost,
            plans: Py::new(py, PyPlans { inner: found.plans })?,
            latents: found.latents,
            history: found.history,
        })
    }
}
