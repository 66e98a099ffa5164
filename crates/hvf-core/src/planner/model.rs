//! What the planner asks of a world: two traits, always over whole batches.
//!
//! Letters in shapes: `B` problems, `M` subgoal samples, `K` subgoals, `L` latent dimensions,
//! `D` candidates per problem, `H` time steps, `A` action dimensions.

use ndarray::{Array1, Array2, Array3, Array4};

use crate::{Error, Result};

/// The box `[low, high]` of one action, `A` dimensions.
#[derive(Clone, Debug, PartialEq)]
pub struct ActionSpace {
    low: Vec<f32>,
    high: Vec<f32>,
}

impl ActionSpace {
    /// A box from its corners.
    ///
    /// # Errors
    /// `low` empty, of another length than `high`, not finite, not below `high`, or so far below
    /// that the difference is not finite.
    pub fn new(low: Vec<f32>, high: Vec<f32>) -> Result<Self> {
        if low.is_empty() {
            return Err(Error::invalid("action_low", "must hold at least one dimension"));
        }
        if low.len() != high.len() {
            return Err(Error::invalid(
                "action_high",
                format!(
                    "must have as many dimensions as action_low ({}), got {}",
                    low.len(),
                    high.len()
                ),
            ));
        }
        for (dimension, (l, h)) in low.iter().zip(&high).enumerate() {
            if !(l.is_finite() && h.is_finite() && l < h) {
                return Err(Error::invalid(
                    "action_low",
                    format!("must be finite and below action_high, got [{l}, {h}] in dimension {dimension}"),
                ));
            }
            // Uniform candidates are drawn as a share of it.
            if !(h - l).is_finite() {
                return Err(Error::invalid(
                    "action_low",
                    format!("must be less than 3.4e38 below action_high, got [{l}, {h}] in dimension {dimension}"),
                ));
            }
        }
        Ok(Self { low, high })
    }

    /// Lowest action, `[A]`.
    pub fn low(&self) -> &[f32] {
        &self.low
    }

    /// Highest action, `[A]`.
    pub fn high(&self) -> &[f32] {
        &self.high
    }

    /// Number of action dimensions, `A`.
    pub fn dim(&self) -> usize {
        self.low.len()
    }
}

/// A batch of frames in a model's own memory: host bytes, simulator states, a tensor on a GPU.
pub trait Frames: Clone {
    /// Number of frames.
    fn len(&self) -> usize;

    /// Whether there is no frame.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The frames at `index`, in that order; an index may repeat.
    ///
    /// # Errors
    /// An index beyond the batch, or a failure of the model's memory.
    fn select(&self, index: &[usize]) -> Result<Self>;

    /// The frames of all `parts`, at least one, one after another; `None` where this memory does
    /// not put batches together, and the model is then called once for each. Worth having where a
    /// few large calls cost less than more of them: on a GPU.
    fn join(_parts: &[&Self]) -> Option<Result<Self>> {
        None
    }
}

/// What [`Frames::select`] leaves of `places` in a pool that frames share.
///
/// # Errors
/// An index beyond the batch.
pub(crate) fn picked(places: &[usize], index: &[usize]) -> Result<Vec<usize>> {
    index
        .iter()
        .map(|&i| {
            places.get(i).copied().ok_or_else(|| {
                Error::invalid("index", format!("{i} is beyond {} frames", places.len()))
            })
        })
        .collect()
}

/// What the planner wants the costs of, one set of candidates per problem.
///
/// The memory is the model's own: it may keep it or overwrite it, since the planner draws its
/// elites again from their counters.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidates {
    /// Actions, `[B, D, H, A]`, in standard layout. Within the action box, unless
    /// [`MpcConfig::clip`](super::MpcConfig::clip) is off; what a larger one does is the model's
    /// to say.
    pub actions: Array4<f32>,
    /// A seed for the noise of every candidate's rollout, `[B, D]`, none negative, where the
    /// model [asked for them](WorldModel::uses_seeds).
    pub seeds: Option<Array2<i64>>,
}

/// What the planner wants the costs of, where all problems share the candidates.
#[derive(Clone, Debug, PartialEq)]
pub struct SharedCandidates {
    /// Actions, `[D, H, A]`, in standard layout.
    pub actions: Array3<f32>,
    /// Seeds, `[D]`, where the model asked for them.
    pub seeds: Option<Array1<i64>>,
}

impl From<Array4<f32>> for Candidates {
    fn from(actions: Array4<f32>) -> Self {
        Self { actions, seeds: None }
    }
}

impl From<Array3<f32>> for SharedCandidates {
    fn from(actions: Array3<f32>) -> Self {
        Self { actions, seeds: None }
    }
}

/// Predicts what actions lead to, and says how far that is from a goal.
pub trait WorldModel {
    /// The frames that this model starts from and is scored against.
    type Frames: Frames;

    /// The box that actions are drawn from.
    fn action_space(&self) -> &ActionSpace;

    /// The most candidates, `B * D`, that this model wants in one call. The planner asks for at
    /// least one problem whatever this says. Results must not depend on it; between two calls the
    /// planner looks whether the user wants to stop, so a call should take well under a second.
    fn max_candidates(&self) -> usize {
        1 << 16
    }

    /// Whether calls should come in few sizes, for a model that is compiled for each: the number of
    /// problems is then filled up to a power of two (or the most for one call) with copies of the
    /// last one, whose costs nobody reads.
    fn pads(&self) -> bool {
        false
    }

    /// Whether [`Candidates`] should come with seeds. A stochastic model draws the noise of
    /// candidate `d` of problem `b` from seed `[b, d]` and nothing else, so that its plans are as
    /// reproducible as those of a deterministic one.
    fn uses_seeds(&self) -> bool {
        false
    }

    /// Frames that stand for `starts` (`[B]`, or `[1]` for all) and `goals[B]` in all further
    /// calls for this plan; `None` to go on with those. Called once per
    /// [`plan`](super::mpc::plan), before its first rollouts: the place for what depends on
    /// start and goal only, such as an encoded goal, and would be done anew in every iteration.
    /// Must give as many starts and as many goals as it got; goal `b` may hold what depends on
    /// the pair `b`.
    ///
    /// # Errors
    /// Whatever keeps the model from answering.
    fn prepare(
        &self,
        _starts: &Self::Frames,
        _goals: &Self::Frames,
    ) -> Result<Option<(Self::Frames, Self::Frames)>> {
        Ok(None)
    }

    /// Planning cost of every candidate: `starts[B]`, `goals[B]`, `actions[B, D, H, A]` to
    /// `costs[B, D]`. A cost of NaN ranks last.
    ///
    /// # Errors
    /// Whatever keeps the model from answering.
    fn rollout_costs(
        &self,
        starts: &Self::Frames,
        goals: &Self::Frames,
        candidates: Candidates,
    ) -> Result<Array2<f32>>;

    /// The same costs where all problems share one start and one set of candidates:
    /// `start[1]`, `goals[B]`, `actions[D, H, A]` to `costs[B, D]`, with `D` rollouts instead of
    /// `B * D`. `None` if the model has no such shortcut. Must equal what
    /// [`rollout_costs`](Self::rollout_costs) gives.
    fn shared_rollout_costs(
        &self,
        _start: &Self::Frames,
        _goals: &Self::Frames,
        _candidates: SharedCandidates,
    ) -> Option<Result<Array2<f32>>> {
        None
    }
}

/// Where subgoals on the way to a goal are likely: a diagonal Gaussian over the latents of all.
#[derive(Clone, Debug, PartialEq)]
pub struct Proposals {
    /// Means, `[K, L]`.
    pub mean: Array2<f32>,
    /// Standard deviations, `[K, L]`.
    pub std: Array2<f32>,
}

/// Draws images that are possible in a scene, from latents.
pub trait SubgoalModel<F: Frames> {
    /// Latent dimensions of one image, `L`.
    fn latent_dim(&self) -> usize;

    /// Images for `latents[M, K, L]` in the scene of `scene[1]`: `M * K` frames, sample-major
    /// (frame `m * K + k` is subgoal `k` of sample `m`).
    ///
    /// # Errors
    /// Whatever keeps the model from answering.
    fn decode(&self, scene: &F, latents: Array3<f32>) -> Result<F>;

    /// How unlikely the segments of `M` samples are, as far as this model knows: from `start[1]`
    /// over the `K` subgoals of `latents[M, K, L]` to `goal[1]`, `[M, K + 1]`. Negative
    /// log-likelihoods (nats), or anything that grows with the time that a segment takes. Asked
    /// only for [`SegmentCost::Likelihood`](super::search::SegmentCost::Likelihood).
    ///
    /// # Errors
    /// A model that does not know, or whatever keeps it from answering.
    fn segment_costs(&self, _start: &F, _goal: &F, _latents: Array3<f32>) -> Result<Array2<f32>> {
        Err(Error::invalid(
            "segment_cost",
            "'likelihood' asks the generator's segment_costs, and this one has none",
        ))
    }

    /// Where a search for `subgoals` subgoals between `start[1]` and `goal[1]` begins, in place of
    /// the standard normal prior; `None` for that. Asked once a search.
    ///
    /// # Errors
    /// Whatever keeps the model from answering.
    fn proposals(&self, _start: &F, _goal: &F, _subgoals: usize) -> Result<Option<Proposals>> {
        Ok(None)
    }
}
