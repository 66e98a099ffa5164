//! Python bindings of `hvf-core`: convert, check, release the GIL; nothing else.
#![deny(missing_docs)]

mod arguments;
mod costs;
mod error;
mod keypoint;
mod latent;
mod latent_weights;
mod layers;
mod maze;
mod planner;
mod threads;
mod worlds;

use pyo3::prelude::*;

/// Maze, image costs, CEM, visual MPC and subgoal search, in Rust.
#[pymodule]
fn hvf_core(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    costs::register(module)?;
    keypoint::register(module)?;
    latent::register(module)?;
    layers::register(module)?;
    maze::register(module)?;
    planner::register(module)?;
    Ok(())
}
