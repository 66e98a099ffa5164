//! Planning: the cross-entropy method, visual MPC and the subgoal search, generic over two traits.

pub mod model;

pub use model::{ActionSpace, Frames, SubgoalModel, WorldModel};
