//! The 2D maze: geometry, physics, renderer and episodes.

mod agent_cost;
mod agent_kernels;
pub mod batch;
pub mod episodes;
pub mod frames;
pub mod geometry;
pub mod ground;
pub mod layout;
pub mod motion;
pub mod physics;
mod pixels;
pub mod render;
pub mod subgoals;
pub mod world;

pub use batch::{
    collect, collect_in, locate_batch, render_batch, step_batch, subgoals_batch, Interaction,
};
pub use episodes::{success, Difficulty, Episode};
pub use frames::{MazeFrames, States};
pub use geometry::{FreeSpace, Scene, State};
pub use layout::{Layout, LayoutScene, LayoutState};
pub use physics::{step, step_within, ACTION_LIMIT};
pub use render::{Renderer, IMAGE_SIZE};
pub use subgoals::MazeSubgoals;
pub use world::{MazeWorld, MazeWorldConfig};
