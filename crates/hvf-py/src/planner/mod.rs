//! Visual MPC and the subgoal search for Python.
//!
//! [`border`] takes frames in and out, [`native`] finds the world behind a Python object and
//! [`pace`] lets Ctrl-C end its calls, [`model`] makes any Python object a world model and
//! [`returned_costs`] reads its costs, [`visual_mpc`] and [`hvf`] are the planners, [`budget`] what
//! their arguments have in common, [`results`] what they return.

pub(crate) mod arguments;
mod border;
mod budget;
mod hvf;
mod model;
mod native;
mod pace;
mod results;
mod returned_costs;
mod visual_mpc;

use hvf_core_rs::{Error, Result};
use pyo3::prelude::*;

use std::cell::Cell;
use std::time::{Duration, Instant};

/// Least time between two looks at whether Ctrl-C was pressed: each needs the GIL.
const BETWEEN_LOOKS: Duration = Duration::from_millis(50);

/// Adds the planners and their results to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<visual_mpc::PyVisualMpc>()?;
    module.add_class::<hvf::PyHvf>()?;
    module.add_class::<results::PyPlan>()?;
    module.add_class::<results::PyPlans>()?;
    module.add_class::<results::PySearchResult>()
}

/// A check for the planner that raises what Python's signal handlers raise (`KeyboardInterrupt`).
fn signals() -> impl Fn() -> Result<()> {
    let last = Cell::new(Instant::now());
    move || {
        if last.get().elapsed() < BETWEEN_LOOKS {
            return Ok(());
        }
        last.set(Instant::now());
        Python::attach(|py| py.check_signals()).map_err(raised)
    }
}

/// A Python exception on its way through the planner.
fn raised(exception: PyErr) -> Error {
    Error::External(Box::new(exception))
}
