//! Settings of the search for subgoals.

use super::{search, SearchResult, Watch};
use crate::planner::cem::CemConfig;
use crate::planner::model::{SubgoalModel, WorldModel};
use crate::planner::mpc::MpcConfig;
use crate::{Error, Result};

/// How the costs of the segments make the cost of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Reduction {
    /// The hardest segment (paper, equation 4).
    Max,
    /// The mean segment.
    Mean,
    /// The hardest segment, and [`Reduction::TIE`] of the sum of all. Of samples whose hardest
    /// segments are about as hard the one with the least to do in all is the cheapest.
    MaxSum,
}

impl Reduction {
    /// Share of the sum in [`Reduction::MaxSum`].
    ///
    /// Where two segments are about as hard, the maximum hardly tells finishing one thing in each
    /// from doing half of both in each; the sum says which is less work in all. It is a share, and
    /// not the second key of an order, since maxima are never quite equal as floats; and a small
    /// one, so that the hardest segment decides where samples differ in it.
    pub const TIE: f64 = 0.1;

    /// The cost of a sample from those of its segments; NaN if one is.
    pub(super) fn of(self, costs: impl ExactSizeIterator<Item = f32> + Clone) -> f32 {
        let count = costs.len() as f64;
        let sum: f64 = costs.clone().map(f64::from).sum();
        let hardest = costs.fold(f32::NEG_INFINITY, |most, cost| {
            if most.is_nan() || cost.is_nan() {
                f32::NAN
            } else {
                most.max(cost)
            }
        });
        match self {
            Self::Max => hardest,
            Self::Mean => (sum / count) as f32,
            Self::MaxSum => (f64::from(hardest) + Self::TIE * sum) as f32,
        }
    }
}

/// Who says what a segment costs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum SegmentCost {
    /// The planner: the predicted cost of its best plan (paper, equation 4).
    #[default]
    Planned,
    /// The generator, without a plan: how unlikely the segment is
    /// ([`SubgoalModel::segment_costs`]).
    Likelihood,
}

/// Settings of the search.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct HvfConfig {
    /// How a segment is planned.
    pub mpc: MpcConfig,
    /// Number of subgoals, `K`; 0 plans to the goal directly.
    pub subgoals: usize,
    /// Budget over latents (`M`, `M*`, iterations).
    pub cem: CemConfig,
    /// Cost of a sample from the costs of its segments.
    pub reduction: Reduction,
    /// Who says what a segment costs.
    pub segment_cost: SegmentCost,
    /// Leave out planning that cannot change which samples are elites (only with
    /// [`Reduction::Max`]).
    pub prune: bool,
    /// Samples that pruning completes between two looks at what is still worth completing; as many
    /// as there are elites if `None`. Fewer plan less, more make larger calls.
    pub chunk: Option<usize>,
    /// Share the first iteration's rollouts of segments with one start.
    pub share_rollouts: bool,
}

impl Default for HvfConfig {
    /// The paper's maze with two subgoals; both savings on.
    fn default() -> Self {
        Self {
            mpc: MpcConfig::default(),
            subgoals: 2,
            cem: CemConfig::default(),
            reduction: Reduction::Max,
            segment_cost: SegmentCost::Planned,
            prune: true,
            chunk: None,
            share_rollouts: true,
        }
    }
}

impl HvfConfig {
    /// Checks the ranges of all fields that do not depend on the models.
    ///
    /// # Errors
    /// Names the field that is out of range.
    pub fn validate(&self) -> Result<()> {
        self.cem.validate()?;
        // The counters of a search keep 16 bits for the segment.
        if self.subgoals > usize::from(u16::MAX) {
            return Err(Error::invalid(
                "subgoals",
                format!("must be at most {}, got {}", u16::MAX, self.subgoals),
            ));
        }
        if self.chunk == Some(0) {
            return Err(Error::invalid("chunk", "must be at least 1, got 0"));
        }
        self.mpc.validate()
    }

    /// Subgoals between `start[1]` and `goal[1]`: [`search`](super::search) with nobody watching.
    ///
    /// # Errors
    /// As [`search`](super::search).
    pub fn search<W: WorldModel, G: SubgoalModel<W::Frames>>(
        &self,
        world: &W,
        generator: &G,
        start: &W::Frames,
        goal: &W::Frames,
        seed: u64,
    ) -> Result<SearchResult<W::Frames>> {
        search(self, world, generator, start, goal, seed, Watch::nobody())
    }
}

#[cfg(test)]
#[path = "config_tests.rs"]
mod tests;
