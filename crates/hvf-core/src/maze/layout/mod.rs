//! Mazes of any layout: walls as turned boxes, with gaps that an episode draws.
//!
//! A [`Layout`] says what a kind of maze is; its [`LayoutScene`] has the gaps of one episode cut.
//! Steps go from contact to contact in closed form ([`step_in`]), frames are covered by exact area
//! ([`Backdrop`]), and true subgoals lie on the shortest way ([`Way`]). The paper's maze is one
//! of these layouts; its own two walls have a faster path of their own in the parent module.

mod backdrop;
mod contacts;
mod coverage;
mod description;
mod episodes;
mod locate;
mod obstacles;
mod polygon;
mod presets;
mod scene;
mod step;
mod way;

pub use backdrop::Backdrop;
pub use description::{Gap, Layout, Region, Wall, MOST_WALLS, SMALLEST_ARENA};
pub use locate::locate_in;
pub use obstacles::{Obstacles, SLACK};
pub use presets::{preset, MOST_CORRIDOR_WALLS, PRESETS};
pub use scene::{LayoutScene, LayoutState};
pub use step::step_in;
pub use way::Way;
