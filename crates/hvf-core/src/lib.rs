//! Hierarchical visual foresight in Rust: the maze, image costs, the cross-entropy method,
//! visual model-predictive control and the search for subgoal images.
//!
//! This crate knows nothing of Python. See Nair & Finn, "Hierarchical Foresight", ICLR 2020.
#![deny(missing_docs)]
#![warn(clippy::unwrap_used)]

pub mod error;
pub mod image;
pub mod keypoint;
pub mod lanes;
pub mod latent;
pub mod layers;
pub mod maze;
pub mod nn;
pub mod planner;
mod rows;

pub use error::{Error, Result};
