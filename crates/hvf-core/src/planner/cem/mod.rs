//! The cross-entropy method over a batch of problems: the one implementation, used for actions
//! (visual MPC) and for subgoal latents (the search).
//!
//! Each iteration draws `D` candidates of `N` dimensions per problem, asks the objective for
//! their costs, keeps the `E` best and refits a diagonal Gaussian to them, until the largest
//! variance falls below a threshold or the iterations are used up (paper, section 4.1 and
//! appendix).
//!
//! Options of [`CemConfig`] and [`Space`], all off unless asked for, make of it what else the field
//! uses: iCEM (kept elites, momentum, a decaying number of samples, [coloured noise](noise)), MPPI
//! (elites weighted by a temperature), a full covariance, a least deviation.
//!
//! A problem's result depends on its own stream, distribution and costs only: not on the other
//! problems of the batch, their order, the number of threads, or how the batch is cut into calls.

mod config;
pub mod distribution;
mod elites;
pub mod noise;
mod problem;

use ndarray::{Array2, Array3, Axis};
use rayon::prelude::*;

use crate::planner::sampler::Stream;
use crate::{Error, Result};
use distribution::{Space, Start};
use problem::{Problem, Sampling};

pub(super) use config::MAX_VALUES;
pub use config::{BestOf, CemConfig, Covariance, MAX_CORRELATED};
pub(super) use elites::elites;
pub use problem::{IterationStats, Solution};

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

    /// Told after every iteration how the problems stand that took part in it: their numbers,
    /// ascending, and what was found for each.
    ///
    /// # Errors
    /// Any ends the optimisation.
    fn iterated(&mut self, _problems: &[usize], _solutions: &[&Solution]) -> Result<()> {
        Ok(())
    }

    /// A cost that is low enough: the search for this problem ends after the first iteration that
    /// has found as much.
    fn enough(&self, _problem: usize) -> Option<f32> {
        None
    }

    /// What to call a problem in an error.
    fn describe(&self, problem: usize) -> String {
        format!("problem {problem}")
    }
}
/// Minimises `objective` for one problem per stream.
///
/// `starts` holds one for all problems or one for each. All problems of iteration
/// 0 under one seed draw the same random numbers (their stream's `problem` counts from iteration
/// 1 on), so that problems can share their first candidates.
///
/// # Errors
/// An error of the objective; costs of the wrong shape; a problem whose costs are all NaN; more
/// samples than memory could hold, or more dimensions than correlations are kept of.
///
/// # Panics
/// If lengths in `starts`, `space` and `streams` disagree, which callers check.
pub fn minimise<O: Objective>(
    config: &CemConfig,
    space: &Space,
    starts: &[Start],
    streams: &[Stream],
    objective: &mut O,
) -> Result<Vec<Solution>> {
    assert!(
        starts.len() == 1 || starts.len() == streams.len(),
        "one start for all problems or one each"
    );
    let dimensions = space.bounds.low.len();
    if dimensions == 0 {
        return Err(Error::invalid("bounds", "must have at least one dimension"));
    }
    let full = config.covariance != Covariance::Diagonal;
    if full && (dimensions > MAX_CORRELATED || space.noise.is_some()) {
        return Err(Error::invalid(
            "covariance",
            match space.noise {
                Some(_) => "'full' learns what depends on what, so noise_beta must be 0".into(),
                None => format!(
                    "'full' is for at most {MAX_CORRELATED} dimensions, and a candidate has \
                     {dimensions}"
                ),
            },
        ));
    }
    let most = MAX_VALUES / dimensions;
    if config.samples > most {
        return Err(Error::invalid(
            "samples",
            format!("must be at most {most} of {dimensions} dimensions, got {}", config.samples),
        ));
    }
    let sampling = Sampling { config, space, dimensions };
    let mut states: Vec<Problem<'_>> = (0..streams.len())
        .map(|problem| {
            Problem::new(problem, streams[problem], &starts[problem.min(starts.len() - 1)])
        })
        .collect();
    let mut active: Vec<&mut Problem<'_>> = states.iter_mut().collect();
    let per_call = objective.problems_per_call().max(1);

    for iteration in 0..config.iterations {
        let one_seed = streams.windows(2).all(|pair| pair[0].seed == pair[1].seed);
        let mut share = iteration == 0 && starts.len() == 1 && streams.len() > 1 && one_seed;
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
            check_costs(&costs, states, config.samples_in(iteration), objective)?;
            states
                .par_iter_mut()
                .zip(costs.axis_iter(Axis(0)).into_par_iter())
                .with_min_len(sampling.problems_per_task())
                .for_each(|(state, costs)| state.update(&sampling, iteration, costs));
        }
        let solutions: Vec<&Solution> = active.iter().map(|state| &state.solution).collect();
        let problems: Vec<usize> = active.iter().map(|state| state.number).collect();
        objective.iterated(&problems, &solutions)?;
        active.retain(|state| {
            let enough = objective.enough(state.number);
            !state.converged(config) && enough.is_none_or(|cost| state.solution.cost > cost)
        });
        if active.is_empty() {
            break;
        }
    }
    Ok(states.into_iter().map(|state| state.solution).collect())
}

fn check_costs<O: Objective>(
    costs: &Array2<f32>,
    states: &[&mut Problem<'_>],
    samples: usize,
    objective: &O,
) -> Result<()> {
    let expected = (states.len(), samples);
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
#[cfg(test)]
mod options_tests;
#[cfg(test)]
mod tests;
