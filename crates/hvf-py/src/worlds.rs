//! What the native worlds have in common at the border: actions in, costs out.

use hvf_core_rs::planner::WorldModel;
use hvf_core_rs::Error;
use ndarray::{Array, Array3, Array4, Dimension};
use numpy::{IntoPyArray, PyArray2, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arguments::{array, numbers};
use crate::error::to_py;
use crate::threads::detached;

/// The most numbers that one call takes of actions, or gives.
const MOST_NUMBERS: usize = 1 << 28;

/// Planning costs, float32 `[B, D]`.
pub type Costs<'py> = Bound<'py, PyArray2<f32>>;

/// What the arguments of `rollout_costs` are, for worlds that take their own frames only.
macro_rules! rollout_costs_doc {
    () => {
        "Planning costs of candidates, float32 `[B, D]`.

One whose actions are not numbers costs NaN.

Args:
    starts: Frames of this world that candidates start from, `[B]`.
    goals: Frames that they are compared with, `[B]`.
    actions: float32 `[B, D, H, A]`, at most 2**28 numbers.

Raises:
    ValueError: Frames or actions do not fit the world or each other.
    TypeError: An argument of another kind or dtype."
    };
}
pub(crate) use rollout_costs_doc;

/// The same of `shared_rollout_costs`.
macro_rules! shared_rollout_costs_doc {
    () => {
        "Planning costs of the same candidates from one start to every goal, float32 `[B, D]`.

Those of `rollout_costs`, to the last bit.

Args:
    start: The frame that all candidates start from, `[1]`.
    goals: Frames that they are compared with, `[B]`.
    actions: float32 `[D, H, A]`, at most 2**28 numbers.

Raises:
    As `rollout_costs`."
    };
}
pub(crate) use shared_rollout_costs_doc;

/// The corners of the box that a world's actions are drawn from, as attributes.
macro_rules! action_box {
    ($class:ident) => {
        #[pymethods]
        impl $class {
            /// Lowest action, float32 `[A]`.
            #[getter]
            fn action_low<'py>(&self, py: Python<'py>) -> Bound<'py, numpy::PyArray1<f32>> {
                let space = hvf_core_rs::planner::WorldModel::action_space(&self.inner);
                numpy::PyArray1::from_slice(py, space.low())
            }

            /// Highest action, float32 `[A]`.
            #[getter]
            fn action_high<'py>(&self, py: Python<'py>) -> Bound<'py, numpy::PyArray1<f32>> {
                let space = hvf_core_rs::planner::WorldModel::action_space(&self.inner);
                numpy::PyArray1::from_slice(py, space.high())
            }
        }
    };
}
pub(crate) use action_box;

/// A copy of float32 actions.
pub fn actions<D: Dimension>(object: &Bound<'_, PyAny>, expected: &str) -> PyResult<Array<f32, D>> {
    let actions = array::<f32, D>("actions", object, expected)?;
    let actions = actions.as_array();
    few("actions", actions.shape())?;
    Ok(actions.to_owned())
}

/// A copy of actions of any dtype.
pub fn any_actions<D: Dimension>(
    object: &Bound<'_, PyAny>,
    expected: &str,
) -> PyResult<Array<f32, D>> {
    if let Ok(array) = object.cast::<PyUntypedArray>() {
        few("actions", array.shape())?;
    }
    numbers("actions", object, expected)
}

/// Refuses more numbers than a call should take or give: arrays that repeat themselves, and
/// answers, can be larger than any memory.
pub fn few(argument: &str, shape: &[usize]) -> PyResult<()> {
    let count = shape.iter().fold(1_usize, |count, &axis| count.saturating_mul(axis));
    if count > MOST_NUMBERS {
        return Err(PyValueError::new_err(format!(
            "{argument}: must be at most {MOST_NUMBERS} numbers, and lead to no more, got {shape:?}"
        )));
    }
    Ok(())
}

/// Costs of candidates `[B, D, H, A]` without the GIL.
pub fn rollout_costs<'py, W: WorldModel<Frames: Sync> + Sync>(
    py: Python<'py>,
    world: &W,
    [starts, goals]: [&W::Frames; 2],
    actions: Array4<f32>,
) -> PyResult<Costs<'py>> {
    let costs = detached(py, || world.rollout_costs(starts, goals, actions.into()))?;
    Ok(costs.map_err(to_py)?.into_pyarray(py))
}

/// Costs of candidates `[D, H, A]` that all goals share, without the GIL.
pub fn shared_rollout_costs<'py, W: WorldModel<Frames: Sync> + Sync>(
    py: Python<'py>,
    world: &W,
    [start, goals]: [&W::Frames; 2],
    actions: Array3<f32>,
) -> PyResult<Costs<'py>> {
    let costs = detached(py, || {
        world
            .shared_rollout_costs(start, goals, actions.into())
            .unwrap_or_else(|| Err(Error::Model("cannot share rollouts".into())))
    })?;
    Ok(costs.map_err(to_py)?.into_pyarray(py))
}
