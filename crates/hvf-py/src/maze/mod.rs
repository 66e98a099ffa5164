//! The maze: functions in batches over NumPy arrays, layouts, frames, the world.

mod batch;
mod episodes;
pub mod frames;
pub mod layout;
pub mod world;

use std::sync::Arc;

use hvf_core_rs::maze::episodes::SUCCESS_DISTANCE;
use hvf_core_rs::maze::geometry::{
    AGENT_HALF, ARENA, GAP_HALF, GAP_LIMIT, GAP_RANGE, REACH, WALL_X,
};
use hvf_core_rs::maze::ground::Ground;
use hvf_core_rs::maze::render::VIEW;
use hvf_core_rs::maze::{Renderer, State, ACTION_LIMIT, IMAGE_SIZE};
use ndarray::Ix2;
use numpy::{PyArrayDyn, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arguments::{new_array, numbers, Whole};
use crate::error::to_py;
use layout::{layout_of, other_than_paper, write_row, Kept};

/// A float array `[N, columns]` as rows; anything `numpy.asarray` takes.
pub fn rows<const C: usize>(argument: &str, array: &Bound<'_, PyAny>) -> PyResult<Vec<[f64; C]>> {
    let expected = format!("a float array [N, {C}]");
    let found = numbers::<f64, Ix2>(argument, array, &expected)?;
    if found.ncols() != C {
        return Err(PyValueError::new_err(format!(
            "{argument}: expected {expected}, got shape {:?}",
            found.shape()
        )));
    }
    Ok(found.rows().into_iter().map(|row| std::array::from_fn(|i| row[i])).collect())
}

/// States `[N, 4]`, rows `(x, y, w1, w2)`.
pub fn states(argument: &str, array: &Bound<'_, PyAny>) -> PyResult<Vec<State>> {
    let rows = rows::<4>(argument, array)?;
    rows.into_iter()
        .enumerate()
        .map(|(index, row)| {
            State::from_row(row)
                .map_err(|error| PyValueError::new_err(format!("{argument}[{index}]: {error}")))
        })
        .collect()
}

/// Positions `[N, 2]` that must be as many as `count` states.
pub(super) fn targets(array: &Bound<'_, PyAny>, count: usize) -> PyResult<Vec<[f64; 2]>> {
    let targets = rows::<2>("targets", array)?;
    if targets.len() != count {
        let problem =
            format!("targets: must be as many as states ({count}), got {}", targets.len());
        return Err(PyValueError::new_err(problem));
    }
    if let Some(index) = targets.iter().position(|t| !(t[0].is_finite() && t[1].is_finite())) {
        let problem = format!("targets[{index}]: must be finite, got {:?}", targets[index]);
        return Err(PyValueError::new_err(problem));
    }
    Ok(targets)
}

pub(super) fn renderer(size: Option<Whole>) -> PyResult<Arc<Renderer>> {
    let size = size.map_or(Ok(IMAGE_SIZE), |size| size.count("size"))?;
    Renderer::shared(size).map_err(to_py)
}

pub(super) type Floats<'py> = Bound<'py, PyArrayDyn<f64>>;

/// States as rows of a new array of this shape, `[.., columns]`.
pub(super) fn to_rows<'py, S: Ground>(
    py: Python<'py>,
    argument: &str,
    shape: &[usize],
    states: impl Iterator<Item = State<S>>,
) -> PyResult<Floats<'py>> {
    let array = new_array::<f64>(py, argument, shape)?;
    let mut writable = array.readwrite();
    let columns = shape.last().copied().unwrap_or(1);
    for (row, state) in writable.as_slice_mut()?.chunks_exact_mut(columns).zip(states) {
        write_row(&state, row);
    }
    drop(writable);
    Ok(array)
}

/// The layout of a call, if its states are not the paper's.
pub(super) fn given(layout: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Arc<Kept>>> {
    Ok(other_than_paper(layout_of(layout)?))
}

/// Numbers of a state's row.
pub(super) fn columns(layout: Option<&Kept>) -> usize {
    layout.map_or(4, |kept| kept.layout.columns())
}

/// Does the same with states of either kind.
macro_rules! with_states {
    ($states:expr, $bound:ident => $body:expr) => {
        match $states {
            States::Paper($bound) => $body,
            States::Laid($bound) => $body,
        }
    };
}
use with_states;

/// Adds what the maze has to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    batch::register(module)?;
    episodes::register(module)?;
    frames::register(module)?;
    layout::register(module)?;
    world::register(module)?;
    module.add("MAZE_ACTION_LIMIT", ACTION_LIMIT)?;
    module.add("MAZE_AGENT_HALF", AGENT_HALF)?;
    module.add("MAZE_ARENA", ARENA)?;
    module.add("MAZE_GAP_HALF", GAP_HALF)?;
    module.add("MAZE_GAP_LIMIT", GAP_LIMIT)?;
    module.add("MAZE_GAP_RANGE", GAP_RANGE)?;
    module.add("MAZE_IMAGE_SIZE", IMAGE_SIZE)?;
    module.add("MAZE_REACH", REACH)?;
    module.add("MAZE_SUCCESS_DISTANCE", SUCCESS_DISTANCE)?;
    module.add("MAZE_VIEW", VIEW)?;
    module.add("MAZE_WALL_X", (WALL_X[0], WALL_X[1]))?;
    Ok(())
}
