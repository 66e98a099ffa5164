//! The compact learned dynamics model: a keypoint, a sprite and a small residual network.
//!
//! Training happens elsewhere (in Python, with torch); this module evaluates the trained model
//! for the planner.

pub mod cell;
pub mod sprite;
pub mod world;

pub use cell::{Cell, CellWeights};
pub use sprite::Sprite;
pub use world::{KeypointFrames, KeypointWorld};
