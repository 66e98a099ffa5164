//! The cross-entropy method over a batch of problems: the one implementation, used for actions
//! (visual MPC) and for subgoal latents (the search).
//!
//! Each iteration draws `D` candidates of `N` dimensions per problem, asks the objective for
//! their costs, keeps the `E` best and refits a diagonal Gaussian to them, until the largest
//! variance falls below a threshold or the iterations are used up (paper, section 4.1 and
//! appendix).
//!
//! A problem's result depends on its own stream, distribution and costs only: not on the other
//! problems of the batch, their order, the number of threads, or how the batch is cut into calls.

use ndarray::{Array2, Array3, ArrayView1, Axis};
use rayon::prelude::*;

use super::distribution::{Bounds, DiagonalGaussian, Initial};
use super::elites::elites;
use super::sampler::{self, draw, Draw, Stream};
use crate::{Error, Result};

/// Most values of one problem's candidates: 1 GiB.
pub(super) const MAX_VALUES: usize = 1 << 28;

/// Which iterations the answer may come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum BestOf {
    /// All: the candidate with the lowest cost that was ever seen.
    #[default]
    All,
    /// The last that was run, kept elites included: what the authors' released code answers.
    Last,
}

/// Budget of one optimisation.
#[derive(Clone, Debug, PartialEq)]
pub struct CemConfig {
    /// Candidates per iteration and problem, `D` (subgoal search: `M`).
    pub samples: usize,
    /// Candidates that the distribution is refitted to, `E` (`D*`, `M*`).
    pub elites: usize,
    /// Most iterations.
    pub iterations: usize,
    /// A problem is done when no variance is left above this (squared units of a candidate).
    pub min_variance: f64,
    /// Best candidates that compete again in the next iteration, with the cost they had.
    pub keep_elites: usize,
    /// Which iterations the answer may come from.
    pub best: BestOf,
}

impl Default for CemConfig {
    /// The paper's maze: 200 samples, 40 elites, 5 iterations, variance 1e-3.
    fn default() -> Self {
        Self {
            samples: 200,
            elites: 40,
            iterations: 5,
            min_variance: 1e-3,
            keep_elites: 0,
            best: BestOf::All,
        }
    }
}

impl CemConfig {
    /// Checks the ranges of all fields.
    ///
    /// # Errors
    /// Names the field that is out of range.
    pub fn validate(&self) -> Result<()> {
        if self.samples == 0 || self.samples > MAX_VALUES {
            return Err(Error::invalid(
                "samples",
                format!("must be between 1 and {MAX_VALUES}, got {}", self.samples),
            ));
        }
        if self.elites == 0 || self.elites > self.samples {
            return Err(Error::invalid(
                "elites",
                format!("must be between 1 and samples ({}), got {}", self.samples, self.elites),
            ));
        }
        if self.iterations == 0 || self.iterations > sampler::MAX_ITERATIONS {
            let most = sampler::MAX_ITERATIONS;
            return Err(Error::invalid(
                "iterations",
                format!("must be between 1 and {most}, got {}", self.iterations),
            ));
        }
        if !(self.min_variance >= 0.0 && self.min_variance.is_finite()) {
            return Err(Error::invalid(
                "min_variance",
                format!("must be finite and not negative, got {}", self.min_variance),
            ));
        }
        if self.keep_elites > self.elites {
            return Err(Error::invalid(
                "keep_elites",
                format!("must be at most elites ({}), got {}", self.elites, self.keep_elites),
            ));
        }
        Ok(())
    }
}

/// What one call of the objective is about: the problems still active, or some of them.
#[derive(Clone, Copy, Debug)]
pub struct Call<'a> {
    /// Iteration, from 0.
    pub iteration: usize,
    /// Numbers of the problems whose candidates these are, `[B']`, ascending.
    pub problems: &'a [usize],
    /// Costs of the elites that these problems kept, best first; empty in iteration 0.
    pub kept_costs: &'a [&'a [f32]],
}

/// What is minimised.
pub trait Objective {
    /// Most problems that it wants in one call.
    fn problems_per_call(&self) -> usize {
        usize::MAX
    }

    /// Costs `[B', D]` of `candidates`, `[B', D, N]`, which are the objective's to keep.
    ///
    /// # Errors
    /// Whatever keeps the objective from answering; ends the optimisation.
    fn costs(&mut self, call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>>;

    /// The same where all problems share the candidates `[D, N]`, if there is a cheaper way.
    /// Asked in iteration 0 of problems with one seed and one initial distribution.
    fn shared_costs(
        &mut self,
        _call: Call<'_>,
        _candidates: &Array2<f32>,
    ) -> Option<Result<Array2<f32>>> {
        None
    }

    /// What to call a problem in an error.
    fn describe(&self, problem: usize) -> String {
        format!("problem {problem}")
    }
}

/// How one problem stood after one iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IterationStats {
    /// Lowest cost among the elites.
    pub best: f32,
    /// Mean cost of the elites.
    pub elite_mean: f32,
    /// Highest cost among the elites.
    pub elite_worst: f32,
    /// Mean of the finite costs among this iteration's new candidates; NaN if there is none.
    pub population_mean: f32,
    /// Largest standard deviation of the refitted distribution.
    pub max_std: f32,
}

/// What the optimisation found for one problem.
#[derive(Clone, Debug, PartialEq)]
pub struct Solution {
    /// Best candidate of the iterations that [`CemConfig::best`] says, `[N]`; among equals, the
    /// earliest.
    pub candidate: Vec<f32>,
    /// Its cost.
    pub cost: f32,
    /// One entry per iteration that was run.
    pub history: Vec<IterationStats>,
}

/// Minimises `objective` for one problem per stream.
///
/// `initial` holds one distribution for all problems or one for each. All problems of iteration
/// 0 under one seed draw the same random numbers (their stream's `problem` counts from iteration
/// 1 on), so that problems can share their first candidates.
///
/// # Errors
/// An error of the objective; costs of the wrong shape; a problem whose costs are all NaN; more
/// samples than memory could hold.
///
/// # Panics
/// If lengths in `initial`, `bounds` and `streams` disagree, which callers check.
pub fn minimise<O: Objective>(
    config: &CemConfig,
    bounds: &Bounds,
    initial: &[Initial],
    streams: &[Stream],
    objective: &mut O,
) -> Result<Vec<Solution>> {
    assert!(
        initial.len() == 1 || initial.len() == streams.len(),
        "one initial distribution or one each"
    );
    if bounds.low.is_empty() {
        return Err(Error::invalid("bounds", "must have at least one dimension"));
    }
    let most = MAX_VALUES / bounds.low.len();
    if config.samples > most {
        return Err(Error::invalid(
            "samples",
            format!(
                "must be at most {most} of {} dimensions, got {}",
                bounds.low.len(),
                config.samples
            ),
        ));
    }
    let sampling = Sampling { config, bounds, dimensions: bounds.low.len() };
    let mut states: Vec<Problem<'_>> = (0..streams.len())
        .map(|problem| {
            Problem::new(problem, streams[problem], &initial[problem.min(initial.len() - 1)])
        })
        .collect();
    let mut active: Vec<&mut Problem<'_>> = states.iter_mut().collect();
    let per_call = objective.problems_per_call().max(1);

    for iteration in 0..config.iterations {
        let one_seed = streams.windows(2).all(|pair| pair[0].seed == pair[1].seed);
        let mut share = iteration == 0 && initial.len() == 1 && streams.len() > 1 && one_seed;
        for states in active.chunks_mut(per_call) {
            let problems: Vec<usize> = states.iter().map(|state| state.number).collect();
            let kept: Vec<Vec<f32>> = states.iter().map(|state| state.kept_costs.clone()).collect();
            let kept_costs: Vec<&[f32]> = kept.iter().map(Vec::as_slice).collect();
            let call = Call { iteration, problems: &problems, kept_costs: &kept_costs };
            let shared = if share {
                objective.shared_costs(call, &sampling.shared_candidates(states[0]))
            } else {
                None
            };
            share = shared.is_some();
            let costs = match shared {
                Some(costs) => costs?,
                None => objective.costs(call, sampling.candidates(iteration, states))?,
            };
            check_costs(&costs, states, config, objective)?;
            states
                .par_iter_mut()
                .zip(costs.axis_iter(Axis(0)).into_par_iter())
                .with_min_len(sampling.problems_per_task())
                .for_each(|(state, costs)| state.update(&sampling, iteration, costs));
        }
        active.retain(|state| !state.converged(config));
        if active.is_empty() {
            break;
        }
    }
    Ok(states.into_iter().map(|state| state.solution).collect())
}

fn check_costs<O: Objective>(
    costs: &Array2<f32>,
    states: &[&mut Problem<'_>],
    config: &CemConfig,
    objective: &O,
) -> Result<()> {
    let expected = (states.len(), config.samples);
    if costs.dim() != expected {
        return Err(Error::Model(format!(
            "costs must have shape {expected:?}, got {:?}",
            costs.dim()
        )));
    }
    for (row, state) in costs.outer_iter().zip(states) {
        if state.kept_costs.is_empty() && row.iter().all(|cost| cost.is_nan()) {
            let problem = objective.describe(state.number);
            return Err(Error::Model(format!(
                "every cost of {problem} is NaN, expected at least one number"
            )));
        }
    }
    Ok(())
}

/// What all problems have in common.
struct Sampling<'a> {
    config: &'a CemConfig,
    bounds: &'a Bounds,
    dimensions: usize,
}

impl Sampling<'_> {
    /// New candidates of every problem, `[B', D, N]`.
    fn candidates(&self, iteration: usize, states: &[&mut Problem<'_>]) -> Array3<f32> {
        let numbers: Vec<u32> = (0..self.config.samples as u32).collect();
        let shape = (states.len(), numbers.len(), self.dimensions);
        let mut candidates = vec![0.0_f32; shape.0 * shape.1 * shape.2];
        candidates
            .par_chunks_mut(shape.1 * shape.2)
            .zip(states.par_iter())
            .with_min_len(self.problems_per_task())
            .for_each(|(rows, state)| state.draw(self, iteration, &numbers, rows));
        Array3::from_shape_vec(shape, candidates).expect("length is the product of the shape")
    }

    /// The candidates that all problems share in iteration 0, `[D, N]`.
    fn shared_candidates(&self, state: &Problem<'_>) -> Array2<f32> {
        let numbers: Vec<u32> = (0..self.config.samples as u32).collect();
        let mut candidates = Array2::zeros((numbers.len(), self.dimensions));
        state.draw(self, 0, &numbers, candidates.as_slice_mut().expect("standard layout"));
        candidates
    }

    /// Enough problems that a task is worth handing to another thread (about 50 microseconds).
    fn problems_per_task(&self) -> usize {
        (10_000 / (self.config.samples * self.dimensions)).max(1)
    }
}

/// State of one problem.
struct Problem<'a> {
    number: usize,
    stream: Stream,
    initial: &'a Initial,
    refitted: DiagonalGaussian,
    /// Elites carried over from the last iteration, `[keep, N]`, best first, and their costs.
    kept: Vec<f32>,
    kept_costs: Vec<f32>,
    solution: Solution,
}

impl<'a> Problem<'a> {
    fn new(number: usize, stream: Stream, initial: &'a Initial) -> Self {
        Self {
            number,
            stream,
            initial,
            refitted: DiagonalGaussian::default(),
            kept: Vec::new(),
            kept_costs: Vec::new(),
            solution: Solution { candidate: Vec::new(), cost: f32::INFINITY, history: Vec::new() },
        }
    }

    fn draw(&self, sampling: &Sampling<'_>, iteration: usize, samples: &[u32], rows: &mut [f32]) {
        let from: Draw<'_> = match iteration {
            0 => self.initial.draw(sampling.bounds),
            _ => self.refitted.draw(sampling.bounds),
        };
        draw(self.stream.in_iteration(iteration), iteration, samples, from, rows);
    }

    /// Elites, best so far, refit: the part of an iteration after the costs are known.
    fn update(&mut self, sampling: &Sampling<'_>, iteration: usize, costs: ArrayView1<'_, f32>) {
        let kept = self.kept_costs.len();
        let ranked = elites(&self.kept_costs, costs, sampling.config.elites);
        let elite_costs: Vec<f32> = ranked
            .iter()
            .map(|&index| if index < kept { self.kept_costs[index] } else { costs[index - kept] })
            .collect();
        let elites = self.elite_candidates(sampling, iteration, &ranked);

        let replaces = match sampling.config.best {
            BestOf::All => elite_costs[0] < self.solution.cost,
            BestOf::Last => true,
        };
        if replaces || self.solution.candidate.is_empty() {
            self.solution.candidate = elites[..sampling.dimensions].to_vec();
            self.solution.cost = elite_costs[0];
        }
        self.refitted = DiagonalGaussian::fit(&elites, sampling.dimensions);
        let keep = sampling.config.keep_elites.min(ranked.len());
        self.kept = elites[..keep * sampling.dimensions].to_vec();
        self.kept_costs = elite_costs[..keep].to_vec();
        self.solution.history.push(IterationStats {
            best: elite_costs[0],
            elite_mean: mean(&elite_costs),
            elite_worst: elite_costs[elite_costs.len() - 1],
            population_mean: mean(costs.iter().filter(|cost| cost.is_finite())),
            max_std: self.refitted.max_std(),
        });
    }

    /// The candidates of rank `ranked` (kept ones first, then new ones), `[E, N]`. The new ones
    /// are drawn again, since the objective has taken theirs.
    fn elite_candidates(
        &self,
        sampling: &Sampling<'_>,
        iteration: usize,
        ranked: &[usize],
    ) -> Vec<f32> {
        let kept = self.kept_costs.len();
        let dimensions = sampling.dimensions;
        let new: Vec<u32> = ranked
            .iter()
            .filter(|&&index| index >= kept)
            .map(|&index| (index - kept) as u32)
            .collect();
        let mut drawn = vec![0.0; new.len() * dimensions];
        self.draw(sampling, iteration, &new, &mut drawn);
        if kept == 0 {
            return drawn;
        }
        let mut drawn_rows = drawn.chunks_exact(dimensions);
        let mut elites = Vec::with_capacity(ranked.len() * dimensions);
        for &index in ranked {
            let row = if index < kept {
                &self.kept[index * dimensions..(index + 1) * dimensions]
            } else {
                drawn_rows.next().expect("one row per new elite")
            };
            elites.extend_from_slice(row);
        }
        elites
    }

    fn converged(&self, config: &CemConfig) -> bool {
        let std = f64::from(self.refitted.max_std());
        std * std < config.min_variance
    }
}

fn mean<'c>(costs: impl IntoIterator<Item = &'c f32>) -> f32 {
    let (sum, count) = costs
        .into_iter()
        .fold((0.0_f64, 0_u32), |(sum, count), &cost| (sum + f64::from(cost), count + 1));
    (sum / f64::from(count)) as f32
}

#[cfg(test)]
#[path = "cem_tests.rs"]
mod tests;
