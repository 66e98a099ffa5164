#![doc = include_str!("../README.md")]
#![deny(missing_docs)]
#![warn(clippy::unwrap_used)]

pub mod error;
pub mod image;
pub mod keypoint;
mod lanes;
pub mod latent;
pub mod layers;
pub mod maze;
pub mod nn;
pub mod planner;
mod rows;
pub mod worlds;

pub use ndarray;

pub use error::{Error, Result};
pub use planner::{
    search, ActionInitial, ActionSpace, BestOf, Candidates, CemConfig, Covariance, Frames,
    HvfConfig, MpcConfig, Plan, Reduction, SearchResult, SegmentCost, SharedCandidates,
    SubgoalModel, Watch, WorldModel,
};
