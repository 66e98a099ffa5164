//! The search without planning: a sample costs what its generator says of its segments.
//!
//! A generator that was trained on pairs of frames, one a few seconds after the other, knows how
//! likely it is that one comes of the other. Asking it costs thousands of times less than a plan,
//! and it sees what pixels do not: that two things rarely change within one segment, however small
//! they are.

use ndarray::{Array2, Array3, Axis};

use super::{decoded, latents_in, latents_of, Ends, HvfConfig, SearchResult, SearchStats, Watch};
use crate::planner::cem::{Call, Objective, Solution};
use crate::planner::model::{Frames, SubgoalModel};
use crate::{Error, Result};

/// Samples of subgoals as an objective: latents to what the generator says of their segments, one
/// problem for each search of a batch.
pub(super) struct Likelihoods<'a, F, G> {
    config: &'a HvfConfig,
    generator: &'a G,
    ends: &'a [Ends<F>],
    watch: Watch<'a, F>,
    latent_dim: usize,
    /// How the optimisation of each search stood after its last iteration.
    latest: Vec<Option<Solution>>,
}

impl<'a, F: Frames, G: SubgoalModel<F>> Likelihoods<'a, F, G> {
    pub fn new(
        config: &'a HvfConfig,
        generator: &'a G,
        ends: &'a [Ends<F>],
        watch: Watch<'a, F>,
    ) -> Self {
        let latest = vec![None; ends.len()];
        let latent_dim = generator.latent_dim();
        Self { config, generator, ends, watch, latent_dim, latest }
    }

    /// What each search answers with as it stands, but for the plans; nothing before the first
    /// iteration is done.
    ///
    /// # Errors
    /// Whatever keeps the generator from drawing.
    pub fn found(self) -> Result<Option<Vec<SearchResult<F>>>> {
        let answer = |(ends, latest): (&Ends<F>, Option<Solution>)| {
            let Some(solution) = latest else {
                return Ok(None);
            };
            let latents = latents_of(&solution, self.config.subgoals);
            let subgoals =
                decoded(self.generator, &ends.start, latents.clone().insert_axis(Axis(0)))?;
            let none = |&costs| SearchStats { costs, evaluated: 0, skipped: 0 };
            let history = solution.history.iter().map(none).collect();
            let cost = solution.cost;
            Ok(Some(SearchResult { subgoals, latents, cost, plans: Vec::new(), history }))
        };
        self.ends.iter().zip(self.latest).map(answer).collect()
    }
}

impl<F: Frames, G: SubgoalModel<F>> Objective for Likelihoods<'_, F, G> {
    fn costs(&mut self, call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>> {
        let (problems, count, _) = candidates.dim();
        let (subgoals, reduction) = (self.config.subgoals, self.config.reduction);
        let mut costs = Vec::with_capacity(problems * count);
        for (latents, &episode) in candidates.axis_iter(Axis(0)).zip(call.problems) {
            (self.watch.interrupt)()?;
            let Ends { start, goal, .. } = &self.ends[episode];
            let latents = latents_in(latents, subgoals, self.latent_dim);
            let segments = self.generator.segment_costs(start, goal, latents)?;
            if segments.dim() != (count, subgoals + 1) {
                return Err(Error::Model(format!(
                    "segment_costs must give shape [{count}, {}], got {:?}",
                    subgoals + 1,
                    segments.shape()
                )));
            }
            costs.extend(segments.outer_iter().map(|costs| reduction.of(costs.iter().copied())));
        }
        Ok(Array2::from_shape_vec((problems, count), costs).expect("one cost per sample"))
    }

    fn iterated(&mut self, searches: &[usize], solutions: &[&Solution]) -> Result<()> {
        for (&search, &solution) in searches.iter().zip(solutions) {
            self.latest[search] = Some(solution.clone());
        }
        self.watch.iterated(solutions, self.config.cem.iterations)
    }
}

#[cfg(test)]
#[path = "likelihood_tests.rs"]
mod tests;
