//! Planning: the cross-entropy method, visual MPC and the subgoal search, generic over two traits.
//!
//! Bottom up: [`philox`] and [`sampler`] draw candidates from counters, [`cem`] optimises a batch
//! of problems with them, [`mpc`] lets it choose actions for a [`WorldModel`], and [`mod@search`] lets
//! it choose the latents of a [`SubgoalModel`]'s images by what it costs to plan between them.

pub mod cem;
mod hashing;
pub mod model;
pub mod mpc;
pub mod philox;
#[cfg(test)]
mod point_mass;
#[cfg(test)]
mod protocol_tests;
pub mod sampler;
pub mod search;

pub use cem::{BestOf, CemConfig, Covariance, IterationStats};
pub use model::{
    ActionSpace, Candidates, Frames, Proposals, SharedCandidates, SubgoalModel, WorldModel,
};
pub use mpc::{ActionInitial, Interrupt, MpcConfig, Plan, Problems, WarmStart};
pub use search::{
    search, search_batch, HvfConfig, Progress, Reduction, SearchResult, SearchStats, SegmentCost,
    Watch,
};
