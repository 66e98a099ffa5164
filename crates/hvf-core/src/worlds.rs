//! Worlds that come with the planner, each a [`WorldModel`](crate::planner::WorldModel).

pub use crate::keypoint;
pub use crate::latent;
pub use crate::layers;
pub use crate::maze;
