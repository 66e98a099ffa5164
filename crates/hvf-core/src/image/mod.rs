//! Costs between images: squared L2 between batches of frames, optionally after a Gaussian blur.

mod all_pairs;
mod blur;
mod l2;
pub mod over_horizon;

pub use all_pairs::all_pairs_costs;
pub use blur::{BlurScratch, GaussianBlur};
pub use l2::{paired_costs, Pixel};
pub use over_horizon::OverHorizon;

pub(crate) use l2::{squared_distance_u8, squared_norm_f32};
