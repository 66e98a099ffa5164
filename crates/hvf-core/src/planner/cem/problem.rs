//! One problem of the batch: what it draws from, what it keeps, and how the elites change that.

use ndarray::{Array2, Array3, ArrayView1};
use rayon::prelude::*;

use super::distribution::{Gaussian, Space, Start};
use super::elites::elites;
use super::noise::{draw, Mixing};
use super::{BestOf, CemConfig};
use crate::planner::sampler::Stream;

/// How one problem stood after one iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
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
#[non_exhaustive]
pub struct Solution {
    /// Best candidate of the iterations that [`CemConfig::best`] says, `[N]`; among equals, the
    /// earliest.
    pub candidate: Vec<f32>,
    /// Its cost.
    pub cost: f32,
    /// Elites of the last iteration that was run, `[E, N]`, best first; fewer where costs are NaN.
    pub elites: Vec<f32>,
    /// One entry per iteration that was run.
    pub history: Vec<IterationStats>,
}

/// What all problems have in common.
pub(super) struct Sampling<'a> {
    pub config: &'a CemConfig,
    pub space: &'a Space,
    pub dimensions: usize,
}

impl Sampling<'_> {
    /// New candidates of every problem, `[B', D, N]`.
    pub fn candidates(&self, iteration: usize, states: &[&mut Problem<'_>]) -> Array3<f32> {
        let numbers: Vec<u32> = (0..self.config.samples_in(iteration) as u32).collect();
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
    pub fn shared_candidates(&self, state: &Problem<'_>) -> Array2<f32> {
        let numbers: Vec<u32> = (0..self.config.samples as u32).collect();
        let mut candidates = Array2::zeros((numbers.len(), self.dimensions));
        state.draw(self, 0, &numbers, candidates.as_slice_mut().expect("standard layout"));
        candidates
    }

    /// Enough problems that a task is worth handing to another thread (about 50 microseconds).
    pub fn problems_per_task(&self) -> usize {
        (10_000 / (self.config.samples * self.dimensions)).max(1)
    }
}

/// State of one problem.
pub(super) struct Problem<'a> {
    pub number: usize,
    stream: Stream,
    start: &'a Start,
    refitted: Gaussian,
    /// Elites carried over from the last iteration, `[keep, N]`, best first, and their costs.
    kept: Vec<f32>,
    pub kept_costs: Vec<f32>,
    pub solution: Solution,
}

impl<'a> Problem<'a> {
    pub fn new(number: usize, stream: Stream, start: &'a Start) -> Self {
        Self {
            number,
            stream,
            start,
            refitted: Gaussian::default(),
            kept: Vec::new(),
            kept_costs: Vec::new(),
            solution: Solution {
                candidate: Vec::new(),
                cost: f32::INFINITY,
                elites: Vec::new(),
                history: Vec::new(),
            },
        }
    }

    fn draw(&self, sampling: &Sampling<'_>, iteration: usize, samples: &[u32], rows: &mut [f32]) {
        let Space { bounds, noise } = sampling.space;
        let from = match iteration {
            0 => self.start.initial.draw(bounds),
            _ => self.refitted.draw(bounds),
        };
        let mixing = match (noise, &self.refitted.correlation) {
            (Some(coloured), _) => Mixing::Coloured(coloured),
            (None, Some(correlation)) => Mixing::Correlated(correlation),
            (None, None) => Mixing::None,
        };
        draw(self.stream.in_iteration(iteration), iteration, samples, mixing, from, rows);
        if iteration == 0 && !self.start.candidates.is_empty() {
            self.place_given(sampling.dimensions, samples, rows);
        }
    }

    /// The candidates that the search begins with, in place of those with the first numbers.
    fn place_given(&self, dimensions: usize, samples: &[u32], rows: &mut [f32]) {
        let given = &self.start.candidates;
        for (&sample, row) in samples.iter().zip(rows.chunks_exact_mut(dimensions)) {
            let first = sample as usize * dimensions;
            if let Some(candidate) = given.get(first..first + dimensions) {
                row.copy_from_slice(candidate);
            }
        }
    }

    /// Elites, best so far, refit: the part of an iteration after the costs are known.
    pub fn update(
        &mut self,
        sampling: &Sampling<'_>,
        iteration: usize,
        costs: ArrayView1<'_, f32>,
    ) {
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
        if iteration == 0 && sampling.config.momentum > 0.0 {
            self.refitted = self.start.initial.moments();
        }
        self.refitted = self.refitted.refitted(sampling.config, &elites, &elite_costs);
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
        self.solution.elites = elites;
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

    pub fn converged(&self, config: &CemConfig) -> bool {
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
