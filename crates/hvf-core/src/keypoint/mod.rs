//! The compact learned dynamics model: a keypoint, a sprite and a small network that sees what is near.
//!
//! Training happens elsewhere (in Python, with torch); this module evaluates the trained model
//! for the planner.

pub mod cell;
mod cost;
pub mod field;
pub mod frames;
pub mod sprite;
pub mod world;

pub use cell::{Cell, CellWeights};
pub use frames::KeypointFrames;
pub use sprite::Sprite;
pub use world::KeypointWorld;

#[cfg(test)]
mod tests;
