//! The search without planning: a sample costs what its generator says of its segments.
//!
//! A generator that was trained on pairs of frames, one a few seconds after the other, knows how
//! likely it is that one comes of the other. Asking it costs thousands of times less than a plan,
//! and it sees what pixels do not: that two things rarely change within one segment, however small
//! they are.

use ndarray::{Array2, Array3};

use super::Reduction;
use crate::planner::cem::{Call, Objective};
use crate::planner::model::{Frames, SubgoalModel};
use crate::planner::mpc::Interrupt;
use crate::{Error, Result};

/// Samples of subgoals as an objective: latents to what the generator says of their segments.
pub(super) struct Likelihoods<'a, F, G> {
    pub generator: &'a G,
    pub start: &'a F,
    pub goal: &'a F,
    pub subgoals: usize,
    pub latent_dim: usize,
    pub reduction: Reduction,
    pub interrupt: Interrupt<'a>,
}

impl<F: Frames, G: SubgoalModel<F>> Objective for Likelihoods<'_, F, G> {
    fn costs(&mut self, _call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>> {
        (self.interrupt)()?;
        let (_, count, _) = candidates.dim();
        let latents = candidates
            .into_shape_with_order((count, self.subgoals, self.latent_dim))
            .expect("a candidate has K x L values");
        let segments = self.generator.segment_costs(self.start, self.goal, latents)?;
        if segments.dim() != (count, self.subgoals + 1) {
            return Err(Error::Model(format!(
                "segment_costs must give shape [{count}, {}], got {:?}",
                self.subgoals + 1,
                segments.shape()
            )));
        }
        let costs = segments.outer_iter().map(|costs| self.reduction.of(costs.iter().copied()));
        Ok(Array2::from_shape_vec((1, count), costs.collect()).expect("one cost per sample"))
    }
}

#[cfg(test)]
#[path = "likelihood_tests.rs"]
mod tests;
