//! A world whose frames are vectors: latents of any encoder, moved by a network and compared by
//! what another network, or a matrix, reads out of them.
//!
//! Training and perception happen elsewhere (in Python, with torch or anything else); this module
//! predicts and compares for the planner. Nothing is assumed of a scene.
//!
//! Letters in shapes: `N` frames, `Z` length of a latent, `A` action dimensions, `P` numbers of a
//! read-out; `B`, `D` and `H` as in [`planner`](crate::planner::model).

mod cost;
mod frames;
mod gram;
mod network;
mod world;

pub use cost::{LatentCost, Readout};
pub use frames::{KeptImages, Known, LatentFrames};
pub use network::Dynamics;
pub use world::LatentWorld;

#[cfg(test)]
mod toys;
