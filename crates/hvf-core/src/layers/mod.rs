//! The desk's learned dynamics model: a backdrop, parts that roam, an arm; each moved on its own.
//!
//! Training and perception happen elsewhere (in Python, with torch); this module predicts, draws
//! and compares for the planner.
//!
//! Letters in shapes: `N` frames, `S` image size, `A` = 3 action dimensions, `G` = 2 sliders, `R`
//! parts that roam, `X` = A + G + 3 R length of a state (the hand's code; coordinates of sliders, 0
//! to 1; row, column in pixels and presence of each part), `W` size of a sprite, `T` size of a tile.

pub mod backdrop;
pub mod cell;
pub mod frames;
pub mod gallery;
pub mod goals;
pub mod painter;
pub mod scenery;
pub mod smoother;
pub mod sprites;
pub mod tiles;
pub mod world;

pub use backdrop::Backdrop;
pub use cell::{Cell, CellWeights};
pub use frames::LayerFrames;
pub use gallery::{Gallery, GalleryImages};
pub use painter::Painter;
pub use sprites::Sprites;
pub use world::LayerWorld;

#[cfg(test)]
mod toys;
