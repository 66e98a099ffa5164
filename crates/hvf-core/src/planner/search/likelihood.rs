//! The search without planning: a sample costs what its generator says of its segments.
//!
//! A generator that was trained on pairs of frames, one a few seconds after the other, knows how
//! likely it is that one comes of the other. Asking it costs thousands of times less than a plan,
//! and it sees what pixels do not: that two things rarely change within one segment, however small
//! they are.

use ndarray::{Array2, Array3, Axis};

use super::{decoded, latents_of, HvfConfig, SearchResult, SearchStats, Watch};
use crate::planner::cem::{Call, Objective, Solution};
use crate::planner::model::{Frames, SubgoalModel};
use crate::{Error, Result};

/// Samples of subgoals as an objective: latents to what the generator says of their segments.
pub(super) struct Likelihoods<'a, F, G> {
    pub generator: &'a G,
    pub start: &'a F,
    pub goal: &'a F,
    pub config: &'a HvfConfig,
    pub latent_dim: usize,
    pub watch: Watch<'a, F>,
    /// How the optimisation stood after its last iteration.
    pub latest: Option<Solution>,
}

impl<F: Frames, G: SubgoalModel<F>> Likelihoods<'_, F, G> {
    /// What the search answers with, but for the plans, if `solution` is what the optimisation
    /// does.
    ///
    /// # Errors
    /// Whatever keeps the generator from drawing.
    pub fn found(&self, solution: &Solution) -> Result<SearchResult<F>> {
        let latents = latents_of(solution, self.config.subgoals);
        let subgoals = decoded(self.generator, self.start, latents.clone().insert_axis(Axis(0)))?;
        let none = |&costs| SearchStats { costs, evaluated: 0, skipped: 0 };
        let history = solution.history.iter().map(none).collect();
        Ok(SearchResult { subgoals, latents, cost: solution.cost, plans: Vec::new(), history })
    }
}

impl<F: Frames, G: SubgoalModel<F>> Objective for Likelihoods<'_, F, G> {
    fn costs(&mut self, _call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>> {
        (self.watch.interrupt)()?;
        let (_, count, _) = candidates.dim();
        let latents = candidates
            .into_shape_with_order((count, self.config.subgoals, self.latent_dim))
            .expect("a candidate has K x L values");
        let segments = self.generator.segment_costs(self.start, self.goal, latents)?;
        if segments.dim() != (count, self.config.subgoals + 1) {
            return Err(Error::Model(format!(
                "segment_costs must give shape [{count}, {}], got {:?}",
                self.config.subgoals + 1,
                segments.shape()
            )));
        }
        let reduction = self.config.reduction;
        let costs = segments.outer_iter().map(|costs| reduction.of(costs.iter().copied()));
        Ok(Array2::from_shape_vec((1, count), costs.collect()).expect("one cost per sample"))
    }

    fn iterated(&mut self, solutions: &[&Solution]) -> Result<()> {
        let solution = solutions[0];
        self.latest = Some(solution.clone());
        self.watch.iterated(solution, self.config.cem.iterations)
    }
}

#[cfg(test)]
#[path = "likelihood_tests.rs"]
mod tests;
