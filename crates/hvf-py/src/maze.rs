//! The maze in batches: `maze_*` functions over NumPy arrays.

use std::sync::Arc;

use hvf_core_rs::maze::episodes::SUCCESS_DISTANCE;
use hvf_core_rs::maze::geometry::{
    AGENT_HALF, ARENA, GAP_HALF, GAP_LIMIT, GAP_RANGE, REACH, WALL_X,
};
use hvf_core_rs::maze::render::VIEW;
use hvf_core_rs::maze::{self, Difficulty, Episode, Renderer, State, ACTION_LIMIT, IMAGE_SIZE};
use ndarray::{Ix2, Ix4};
use numpy::{PyArray1, PyArrayDyn, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arguments::{array, new_array, numbers, unfit, Text, Whole};
use crate::error::to_py;
use crate::threads::detached;

/// Frames between two looks at whether Ctrl-C was pressed.
const FRAMES_PER_CHUNK: usize = 20_000;
/// Episodes between two such looks.
const EPISODES_PER_CHUNK: usize = 1 << 16;

/// A float array `[N, columns]` as rows; anything `numpy.asarray` takes.
fn rows<const C: usize>(argument: &str, array: &Bound<'_, PyAny>) -> PyResult<Vec<[f64; C]>> {
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

fn renderer(size: Option<Whole>) -> PyResult<Arc<Renderer>> {
    let size = size.map_or(Ok(IMAGE_SIZE), |size| size.count("size"))?;
    Renderer::shared(size).map_err(to_py)
}

type Floats<'py> = Bound<'py, PyArrayDyn<f64>>;

/// States as rows of a new array of this shape, `[.., 4]`.
fn to_rows<'py>(
    py: Python<'py>,
    argument: &str,
    shape: &[usize],
    states: impl Iterator<Item = State>,
) -> PyResult<Floats<'py>> {
    let array = new_array::<f64>(py, argument, shape)?;
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
    let next = detached(py, || maze::step_batch(&states, &actions))?.map_err(to_py)?;
    to_rows(py, "states", &[next.len(), 4], next.into_iter())
}

/// Frames of `states[N, 4]`: uint8 `[N, size, size, 3]`, RGB, row 0 at the top.
///
/// Raises ValueError for a size outside 8..2048 or states that `maze_step` refuses.
#[pyfunction]
#[pyo3(signature = (states, size = None), text_signature = "(states, size=64)")]
fn maze_render<'py>(
    py: Python<'py>,
    states: &Bound<'py, PyAny>,
    size: Option<Whole>,
) -> PyResult<Bound<'py, PyArrayDyn<u8>>> {
    let states = self::states("states", states)?;
    let renderer = renderer(size)?;
    let size = renderer.size();
    let frames = new_array::<u8>(py, "size", &[states.len(), size, size, 3])?;
    {
        let mut writable = frames.readwrite();
        let bytes = writable.as_slice_mut()?;
        detached(py, || maze::render_batch(&renderer, &states, bytes))?.map_err(to_py)?;
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
#[pyo3(signature = (images), text_signature = "(images)")]
fn maze_locate<'py>(py: Python<'py>, images: &Bound<'py, PyAny>) -> PyResult<Floats<'py>> {
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
    let found = detached(py, || maze::locate_batch(&renderer, bytes))?.map_err(to_py)?;
    to_rows(py, "images", &[found.len(), 4], found.into_iter())
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
    seed: Whole,
    first: Whole,
    count: Whole,
    difficulty: Text,
) -> PyResult<(Floats<'py>, Floats<'py>)> {
    let (seed, first) = (seed.seed("seed")?, first.seed("first")?);
    let count = count.amount("count")?;
    let difficulty: Difficulty = difficulty.get("difficulty")?.parse().map_err(to_py)?;
    let starts = new_array::<f64>(py, "count", &[count, 4])?;
    let targets = new_array::<f64>(py, "count", &[count, 2])?;
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
    subgoals: Whole,
) -> PyResult<Floats<'py>> {
    let starts = states("starts", starts)?;
    let targets = self::targets(targets, starts.len())?;
    let subgoals = subgoals.amount("subgoals")?;
    let shape = [starts.len(), subgoals, 4];
    let episodes = starts.into_iter().zip(targets).map(|(start, target)| Episode { start, target });
    to_rows(py, "subgoals", &shape, episodes.flat_map(|episode| episode.subgoals(subgoals)))
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
    seed: Whole,
    first: Whole,
    count: Whole,
    steps: Whole,
    size: Option<Whole>,
) -> PyResult<Interaction<'py>> {
    let (seed, first) = (seed.seed("seed")?, first.seed("first")?);
    let (count, steps) = (count.amount("count")?, steps.amount("steps")?);
    let renderer = renderer(size)?;
    let size = renderer.size();
    if steps == 0 {
        return Err(PyValueError::new_err("steps: must be at least 1"));
    }
    let frames = new_array::<u8>(py, "count", &[count, steps + 1, size, size, 3])?;
    let actions = new_array::<f32>(py, "count", &[count, steps, 2])?;
    let states = new_array::<f64>(py, "count", &[count, steps + 1, 4])?;
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
            let part =
                detached(py, || maze::collect(&renderer, seed, begin, episodes, steps, frames))?
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
