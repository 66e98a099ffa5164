//! The 2D maze: geometry, physics, renderer and episodes.

mod agent_cost;
mod agent_kernels;
pub mod batch;
pub mod episodes;
pub mod frames;
pub mod geometry;
pub mod motion;
pub mod physics;
pub mod render;
pub mod subgoals;
pub mod world;

pub use batch::{collect, locate_batch, render_batch, step_batch, Interaction};
pub use episodes::{success, Difficulty, Episode};
pub use frames::MazeFrames;
pub use geometry::{FreeSpace, Scene, State};
pub use physics::{step, step_within, ACTION_LIMIT};
pub use render::{Renderer, IMAGE_SIZE};
pub use subgoals::MazeSubgoals;
pub use world::{MazeWorld, MazeWorldConfig};
