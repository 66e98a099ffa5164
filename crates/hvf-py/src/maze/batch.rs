//! Steps, images and success of states in batches: `maze_*` functions over NumPy arrays.

use hvf_core_rs::maze::{self, MazeFrames, Renderer, States, ACTION_LIMIT};
use ndarray::Ix4;
use numpy::{PyArray1, PyArrayDyn, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use super::layout::states_in;
use super::{columns, given, renderer, rows, to_rows, with_states, Floats};
use crate::arguments::{array, new_array, unfit, Whole};
use crate::error::to_py;
use crate::threads::detached;

/// States after one step, float64 `[N, 4]`.
///
/// Args:
///     states: float `[N, 4]`, rows `(x, y, w1, w2)` in metres: centre of the agent and of the gaps
///         of the left and right wall.
///     actions: float `[N, 2]` in units of 0.05 N, clipped to `[-3, 3]`.
///     layout: The layout that states are of, whose rows are `(x, y, gap, ..)`, here and in the
///         other functions of the maze; None for the paper's maze.
///
/// Raises:
///     ValueError: Shapes that do not match, states outside the arena or in a wall, actions that
///         are not finite.
///     TypeError: What is no array of numbers.
#[pyfunction]
#[pyo3(
    signature = (states, actions, layout = None),
    text_signature = "(states, actions, layout=None)"
)]
fn maze_step<'py>(
    py: Python<'py>,
    states: &Bound<'py, PyAny>,
    actions: &Bound<'py, PyAny>,
    layout: Option<&Bound<'py, PyAny>>,
) -> PyResult<Floats<'py>> {
    let layout = given(layout)?;
    let states = states_in("states", states, layout.as_deref())?;
    let actions = rows::<2>("actions", actions)?;
    // What is finite is clipped before it loses its range.
    let clip = |a: f64| if a.is_finite() { a.clamp(-ACTION_LIMIT, ACTION_LIMIT) } else { a };
    let actions: Vec<[f32; 2]> = actions.into_iter().map(|a| a.map(|a| clip(a) as f32)).collect();
    let columns = columns(layout.as_deref());
    with_states!(states, states => {
        let next = detached(py, || maze::step_batch(&states, &actions))?.map_err(to_py)?;
        to_rows(py, "states", &[next.len(), columns], next.into_iter())
    })
}

/// Images of states: uint8 `[N, size, size, 3]`, RGB, row 0 at the top.
///
/// Args:
///     states: float `[N, 4]`, as for `maze_step`.
///     size: Height and width, pixels, from 8 to 2048; None for 64.
///     layout: As for `maze_step`.
///
/// Raises:
///     ValueError: A size out of range, or states that `maze_step` refuses.
///     TypeError: An argument of another kind.
///     MemoryError: The images do not fit into memory.
#[pyfunction]
#[pyo3(
    signature = (states, size = None, layout = None),
    text_signature = "(states, size=64, layout=None)"
)]
fn maze_render<'py>(
    py: Python<'py>,
    states: &Bound<'py, PyAny>,
    size: Option<Whole>,
    layout: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArrayDyn<u8>>> {
    let states = states_in("states", states, given(layout)?.as_deref())?;
    let renderer = renderer(size)?;
    let size = renderer.size();
    let frames = new_array::<u8>(py, "size", &[states.len(), size, size, 3])?;
    {
        let mut writable = frames.readwrite();
        let bytes = writable.as_slice_mut()?;
        with_states!(&states, states => {
            detached(py, || maze::render_batch(&renderer, states, bytes))?.map_err(to_py)?;
        });
    }
    Ok(frames)
}

/// The states that images show, float64 `[N, 4]`.
///
/// Right to about 0.1 mm on rendered frames of 64 pixels or more; a best guess, and always a legal
/// state, on others.
///
/// Args:
///     images: uint8 `[N, S, S, 3]`.
///     layout: The layout that they show; None for the paper's maze.
///
/// Raises:
///     ValueError: Another shape.
///     TypeError: Another dtype, or what is no array.
#[pyfunction]
#[pyo3(signature = (images, layout = None), text_signature = "(images, layout=None)")]
fn maze_locate<'py>(
    py: Python<'py>,
    images: &Bound<'py, PyAny>,
    layout: Option<&Bound<'py, PyAny>>,
) -> PyResult<Floats<'py>> {
    const EXPECTED: &str = "uint8 [N, S, S, 3]";
    let object = images;
    let complaint = || PyValueError::new_err(unfit("images", EXPECTED, object));
    let images = array::<u8, Ix4>("images", object, EXPECTED)?;
    let size = match images.as_array().dim() {
        (_, height, width, 3) if height == width => height,
        _ => return Err(complaint()),
    };
    let renderer = Renderer::shared(size).map_err(|_| complaint())?;
    let view = images.as_array();
    let standard = view.as_standard_layout();
    let bytes = standard.as_slice().unwrap_or_default();
    let Some(kept) = given(layout)? else {
        let found = detached(py, || maze::locate_batch(&renderer, bytes))?.map_err(to_py)?;
        return to_rows(py, "images", &[found.len(), 4], found.into_iter());
    };
    let found = detached(py, || MazeFrames::from_images_in(&kept.layout, &renderer, bytes))?;
    with_states!(found.map_err(to_py)?.states(), found => {
        to_rows(py, "images", &[found.len(), kept.layout.columns()], found.into_iter())
    })
}

/// Whether agents are within 0.05 m of their targets: bool `[N]`.
///
/// Args:
///     states: float `[N, 4]`, as for `maze_step`.
///     targets: float `[N, 2]`, metres.
///     layout: As for `maze_step`.
///
/// Raises:
///     ValueError: Shapes that do not match, or numbers that are not finite.
///     TypeError: What is no array of numbers.
#[pyfunction]
#[pyo3(
    signature = (states, targets, layout = None),
    text_signature = "(states, targets, layout=None)"
)]
fn maze_success<'py>(
    py: Python<'py>,
    states: &Bound<'py, PyAny>,
    targets: &Bound<'py, PyAny>,
    layout: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArray1<bool>>> {
    let states = states_in("states", states, given(layout)?.as_deref())?;
    let targets = super::targets(targets, states.len())?;
    with_states!(&states, states => {
        let pairs = states.iter().zip(&targets);
        let reached = pairs.map(|(state, &target)| maze::success(state, target));
        Ok(PyArray1::from_iter(py, reached))
    })
}

/// Adds this file's functions to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(maze_step, module)?)?;
    module.add_function(wrap_pyfunction!(maze_render, module)?)?;
    module.add_function(wrap_pyfunction!(maze_locate, module)?)?;
    module.add_function(wrap_pyfunction!(maze_success, module)?)
}
