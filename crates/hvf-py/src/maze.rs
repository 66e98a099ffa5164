//! The maze in batches: `maze_*` functions over NumPy arrays.

use std::sync::Arc;

use hvf_core_rs::maze::episodes::SUCCESS_DISTANCE;
use hvf_core_rs::maze::geometry::{
    AGENT_HALF, ARENA, GAP_HALF, GAP_LIMIT, GAP_RANGE, REACH, WALL_X,
};
use hvf_core_rs::maze::render::VIEW;
use hvf_core_rs::maze::{self, Difficulty, Episode, Renderer, State, ACTION_LIMIT, IMAGE_SIZE};
use ndarray::Ix2;
use numpy::{
    AllowTypeChange, Element, PyArray1, PyArrayDyn, PyArrayLikeDyn, PyArrayMethods,
    PyReadonlyArrayDyn, PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyInt;

use crate::error::to_py;

/// Frames between two looks at whether Ctrl-C was pressed.
const FRAMES_PER_CHUNK: usize = 20_000;
/// Episodes between two such looks.
const EPISODES_PER_CHUNK: usize = 1 << 16;

/// A float array `[N, columns]` as rows; anything `numpy.asarray` takes.
fn rows<const C: usize>(argument: &str, array: &Bound<'_, PyAny>) -> PyResult<Vec<[f64; C]>> {
    let complaint =
        |found: String| format!("{argument}: expected a float array [N, {C}], got {found}");
    let array: PyArrayLikeDyn<'_, f64, AllowTypeChange> = array.extract().map_err(|_| {
        let kind = array.get_type();
        PyTypeError::new_err(complaint(format!("something else ({kind})")))
    })?;
    let view = array.as_array();
    match view.into_dimensionality::<Ix2>() {
        Ok(view) if view.ncols() == C => {
            Ok(view.rows().into_iter().map(|row| std::array::from_fn(|i| row[i])).collect())
        }
        _ => Err(PyValueError::new_err(complaint(format!("shape {:?}", array.shape())))),
    }
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
fn targets(array: &Bound<'_, PyAny>, count: usize) -> PyResult<Vec<[f64; 2]>> {
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

/// An integer of 0 or more.
fn natural(argument: &str, value: &Bound<'_, PyAny>) -> PyResult<u64> {
    let index = value.call_method0("__index__").map_err(|_| {
        PyTypeError::new_err(format!("{argument}: expected an integer, got {value}"))
    })?;
    index.cast::<PyInt>()?.extract().map_err(|_| {
        PyValueError::new_err(format!("{argument}: must be from 0 to 2**64 - 1, got {index}"))
    })
}

fn count(argument: &str, value: &Bound<'_, PyAny>) -> PyResult<usize> {
    let count = natural(argument, value)?;
    usize::try_from(count)
        .ok()
        .filter(|&count| count <= (1 << 40))
        .ok_or_else(|| PyValueError::new_err(format!("{argument}: {count} is too many")))
}

fn renderer(size: Option<&Bound<'_, PyAny>>) -> PyResult<Arc<Renderer>> {
    let size = size.map_or(Ok(IMAGE_SIZE), |size| count("size", size))?;
    Renderer::shared(size).map_err(to_py)
}

/// A new array with undefined content; NumPy raises `MemoryError` where there is no room.
fn new_array<'py, T: Element>(
    py: Python<'py>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    let array = py.import("numpy")?.call_method1("empty", (shape, T::get_dtype(py)))?;
    Ok(array.cast_into::<PyArrayDyn<T>>()?)
}

type Floats<'py> = Bound<'py, PyArrayDyn<f64>>;

/// States as rows of a new array of this shape, `[.., 4]`.
fn to_rows<'py>(
    py: Python<'py>,
    shape: &[usize],
    states: impl Iterator<Item = State>,
) -> PyResult<Floats<'py>> {
    let array = new_array::<f64>(py, shape)?;
    let mut writable = array.readwrite();
    for (row, state) in writable.as_slice_mut()?.chunks_exact_mut(4).zip(states) {
        row.copy_from_slice(&state.to_row());
    }
    drop(writable);
    Ok(array)
}

/// States after one step of `actions[N, 2]`.
///
/// `states` are float64 `[N, 4]`, rows `(x, y, w1, w2)` in metres: centre of the agent and of the
/// gaps of the left and right wall. Actions are float32 `[N, 2]` in units of 0.05 N, clipped to
/// `[-3, 3]`. Returns float64 `[N, 4]`.
///
/// Raises ValueError for shapes that do not match, states outside the arena and actions that are
/// not finite; TypeError for what is no array.
#[pyfunction]
fn maze_step<'py>(
    py: Python<'py>,
    states: &Bound<'py, PyAny>,
    actions: &Bound<'py, PyAny>,
) -> PyResult<Floats<'py>> {
    let states = self::states("states", states)?;
    let actions = rows::<2>("actions", actions)?;
    // What is finite is clipped before it loses its range.
    let clip = |a: f64| if a.is_finite() { a.clamp(-ACTION_LIMIT, ACTION_LIMIT) } else { a };
    let actions: Vec<[f32; 2]> = actions.into_iter().map(|a| a.map(|a| clip(a) as f32)).collect();
    let next = py.detach(|| maze::step_batch(&states, &actions)).map_err(to_py)?;
    to_rows(py, &[next.len(), 4], next.into_iter())
}

/// Frames of `states[N, 4]`: uint8 `[N, size, size, 3]`, RGB, row 0 at the top.
///
/// Raises ValueError for a size outside 8..2048 or states that `maze_step` refuses.
#[pyfunction]
#[pyo3(signature = (states, size = None), text_signature = "(states, size=64)")]
fn maze_render<'py>(
    py: Python<'py>,
    states: &Bound<'py, PyAny>,
    size: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArrayDyn<u8>>> {
    let states = self::states("states", states)?;
    let renderer = renderer(size)?;
    let size = renderer.size();
    let frames = new_array::<u8>(py, &[states.len(), size, size, 3])?;
    {
        let mut writable = frames.readwrite();
        let bytes = writable.as_slice_mut()?;
        py.detach(|| maze::render_batch(&renderer, &states, bytes)).map_err(to_py)?;
    }
    Ok(frames)
}

/// The states that `images` show: uint8 `[N, S, S, 3]` to float64 `[N, 4]`.
///
/// Right to about 0.1 mm on rendered frames of 64 pixels or more; a best guess, and always a legal
/// state, on others.
///
/// Raises TypeError for what is not uint8, ValueError for other shapes.
#[pyfunction]
fn maze_locate<'py>(py: Python<'py>, images: &Bound<'py, PyAny>) -> PyResult<Floats<'py>> {
    let complaint = |found: String| format!("images: expected uint8 [N, S, S, 3], got {found}");
    let images: PyReadonlyArrayDyn<'_, u8> = images.extract().map_err(|_| {
        let found = images.getattr("dtype").unwrap_or_else(|_| images.get_type().into_any());
        PyTypeError::new_err(complaint(found.to_string()))
    })?;
    let (size, shape) = match *images.shape() {
        [_, height, width, 3] if height == width => (height, images.shape()),
        ref other => return Err(PyValueError::new_err(complaint(format!("shape {other:?}")))),
    };
    let renderer = Renderer::shared(size)
        .map_err(|_| PyValueError::new_err(complaint(format!("shape {shape:?}"))))?;
    let view = images.as_array();
    let standard = view.as_standard_layout();
    let bytes = standard.as_slice().unwrap_or_default();
    let found = py.detach(|| maze::locate_batch(&renderer, bytes)).map_err(to_py)?;
    to_rows(py, &[found.len(), 4], found.into_iter())
}

/// Episodes `first..first + count` of a seed: `(starts [N, 4], targets [N, 2])`, float64.
///
/// `difficulty` is 'easy', 'medium' or 'hard' (none, one or two gaps to pass). Episode `i` is
/// keyed by `(seed, i)`, so it is the same whatever range it is drawn in. The goal state is
/// `(target_x, target_y, w1, w2)`, its image the goal image.
///
/// Raises ValueError for another difficulty or negative numbers.
#[pyfunction]
fn maze_episodes<'py>(
    py: Python<'py>,
    seed: &Bound<'py, PyAny>,
    first: &Bound<'py, PyAny>,
    count: &Bound<'py, PyAny>,
    difficulty: &str,
) -> PyResult<(Floats<'py>, Floats<'py>)> {
    let (seed, first) = (natural("seed", seed)?, natural("first", first)?);
    let count = self::count("count", count)?;
    let difficulty: Difficulty = difficulty.parse().map_err(to_py)?;
    let (starts, targets) =
        (new_array::<f64>(py, &[count, 4])?, new_array::<f64>(py, &[count, 2])?);
    {
        let (mut starts, mut targets) = (starts.readwrite(), targets.readwrite());
        let rows = starts.as_slice_mut()?.chunks_exact_mut(4);
        let rows = rows.zip(targets.as_slice_mut()?.chunks_exact_mut(2)).enumerate();
        for (index, (start, target)) in rows {
            if index % EPISODES_PER_CHUNK == 0 {
                py.check_signals()?;
            }
            let episode = Episode::new(seed, first.wrapping_add(index as u64), difficulty);
            start.copy_from_slice(&episode.start.to_row());
            target.copy_from_slice(&episode.target);
        }
    }
    Ok((starts, targets))
}

/// Ground-truth subgoals of `starts[N, 4]` and `targets[N, 2]`: states, float64
/// `[N, subgoals, 4]`.
///
/// The agent centred in the gaps that it has to pass, in order; on the straight line to the
/// target if there are none.
///
/// Raises ValueError for shapes that do not match.
#[pyfunction]
fn maze_subgoals<'py>(
    py: Python<'py>,
    starts: &Bound<'py, PyAny>,
    targets: &Bound<'py, PyAny>,
    subgoals: &Bound<'py, PyAny>,
) -> PyResult<Floats<'py>> {
    let starts = states("starts", starts)?;
    let targets = self::targets(targets, starts.len())?;
    let subgoals = count("subgoals", subgoals)?;
    let shape = [starts.len(), subgoals, 4];
    let episodes = starts.into_iter().zip(targets).map(|(start, target)| Episode { start, target });
    to_rows(py, &shape, episodes.flat_map(|episode| episode.subgoals(subgoals)))
}

type Interaction<'py> = (Bound<'py, PyArrayDyn<u8>>, Bound<'py, PyArrayDyn<f32>>, Floats<'py>);

/// Random interaction, episodes `first..first + count` of a seed, `steps` steps each:
/// `(images uint8 [N, T + 1, size, size, 3], actions float32 [N, T, 2], states float64
/// [N, T + 1, 4])`.
///
/// Starts are uniform over free space in random scenes, actions uniform over the box. Episode
/// `i` is keyed by `(seed, i)`: ranges can be collected in any order and chunking. Ctrl-C stops
/// it.
///
/// Raises ValueError for negative or zero sizes, MemoryError where the frames do not fit.
#[pyfunction]
#[pyo3(
    signature = (seed, first, count, steps, size = None),
    text_signature = "(seed, first, count, steps, size=64)"
)]
fn maze_collect<'py>(
    py: Python<'py>,
    seed: &Bound<'py, PyAny>,
    first: &Bound<'py, PyAny>,
    count: &Bound<'py, PyAny>,
    steps: &Bound<'py, PyAny>,
    size: Option<&Bound<'py, PyAny>>,
) -> PyResult<Interaction<'py>> {
    let (seed, first) = (natural("seed", seed)?, natural("first", first)?);
    let (count, steps) = (self::count("count", count)?, self::count("steps", steps)?);
    let renderer = renderer(size)?;
    let size = renderer.size();
    if steps == 0 {
        return Err(PyValueError::new_err("steps: must be at least 1"));
    }
    let frames = new_array::<u8>(py, &[count, steps + 1, size, size, 3])?;
    let actions = new_array::<f32>(py, &[count, steps, 2])?;
    let states = new_array::<f64>(py, &[count, steps + 1, 4])?;
    let per_chunk = (FRAMES_PER_CHUNK / (steps + 1)).max(1);
    {
        let (mut frames, mut actions) = (frames.readwrite(), actions.readwrite());
        let mut states = states.readwrite();
        let chunks =
            frames.as_slice_mut()?.chunks_mut(per_chunk * (steps + 1) * renderer.frame_len());
        let chunks = chunks
            .zip(actions.as_slice_mut()?.chunks_mut(per_chunk * steps * 2))
            .zip(states.as_slice_mut()?.chunks_mut(per_chunk * (steps + 1) * 4));
        for (chunk, ((frames, actions), states)) in chunks.enumerate() {
            py.check_signals()?;
            let begin = first.wrapping_add((chunk * per_chunk) as u64);
            let episodes = actions.len() / (steps * 2);
            let part = py
                .detach(|| maze::collect(&renderer, seed, begin, episodes, steps, frames))
                .map_err(to_py)?;
            for (row, action) in actions.chunks_exact_mut(2).zip(&part.actions) {
                row.copy_from_slice(action);
            }
            for (row, state) in states.chunks_exact_mut(4).zip(&part.states) {
                row.copy_from_slice(&state.to_row());
            }
        }
    }
    Ok((frames, actions, states))
}

/// Whether the agent is within 0.05 m of its target: `states[N, 4]`, `targets[N, 2]` to bool
/// `[N]`.
///
/// Raises ValueError for shapes that do not match.
#[pyfunction]
fn maze_success<'py>(
    py: Python<'py>,
    states: &Bound<'py, PyAny>,
    targets: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray1<bool>>> {
    let states = self::states("states", states)?;
    let targets = self::targets(targets, states.len())?;
    let reached = states.iter().zip(&targets).map(|(state, &target)| maze::success(state, target));
    Ok(PyArray1::from_iter(py, reached))
}

/// Adds the functions and constants of the maze to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(maze_step, module)?)?;
    module.add_function(wrap_pyfunction!(maze_render, module)?)?;
    module.add_function(wrap_pyfunction!(maze_locate, module)?)?;
    module.add_function(wrap_pyfunction!(maze_episodes, module)?)?;
    module.add_function(wrap_pyfunction!(maze_subgoals, module)?)?;
    module.add_function(wrap_pyfunction!(maze_collect, module)?)?;
    module.add_function(wrap_pyfunction!(maze_success, module)?)?;
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
