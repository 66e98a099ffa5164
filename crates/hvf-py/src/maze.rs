//! The maze in batches: `maze_*` functions over NumPy arrays.

use std::sync::Arc;

use hvf_core_rs::maze::episodes::SUCCESS_DISTANCE;
use hvf_core_rs::maze::geometry::{
    AGENT_HALF, ARENA, GAP_HALF, GAP_LIMIT, GAP_RANGE, REACH, WALL_X,
};
use hvf_core_rs::maze::ground::Ground;
use hvf_core_rs::maze::render::VIEW;
use hvf_core_rs::maze::{
    self, Difficulty, Episode, MazeFrames, Renderer, State, States, ACTION_LIMIT, IMAGE_SIZE,
};
use ndarray::{Ix2, Ix4};
use numpy::{PyArray1, PyArrayDyn, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arguments::{array, new_array, numbers, unfit, Text, Whole};
use crate::error::to_py;
use crate::maze_layout::{layout_of, other_than_paper, states_in, write_row, Kept};
use crate::threads::detached;

/// Frames between two looks at whether Ctrl-C was pressed.
const FRAMES_PER_CHUNK: usize = 20_000;
/// Episodes between two such looks.
const EPISODES_PER_CHUNK: usize = 1 << 16;

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

/// States as rows of a new array of this shape, `[.., columns]`.
fn to_rows<'py, S: Ground>(
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
fn given(layout: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Arc<Kept>>> {
    Ok(other_than_paper(layout_of(layout)?))
}

/// Numbers of a state's row.
fn columns(layout: Option<&Kept>) -> usize {
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

/// States after one step of `actions[N, 2]`.
///
/// `states` are float64 `[N, 4]`, rows `(x, y, w1, w2)` in metres: centre of the agent and of the
/// gaps of the left and right wall. Actions are float32 `[N, 2]` in units of 0.05 N, clipped to
/// `[-3, 3]`. Returns float64 `[N, 4]`. With a `layout` rows are `(x, y, gap, ..)`, here and in
/// the other functions of the maze.
///
/// Raises ValueError for shapes that do not match, states outside the arena and actions that are
/// not finite; TypeError for what is no array.
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

/// Frames of `states[N, 4]`: uint8 `[N, size, size, 3]`, RGB, row 0 at the top.
///
/// Raises ValueError for a size outside 8..2048 or states that `maze_step` refuses.
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

/// The states that `images` show: uint8 `[N, S, S, 3]` to float64 `[N, 4]`.
///
/// Right to about 0.1 mm on rendered frames of 64 pixels or more; a best guess, and always a legal
/// state, on others.
///
/// Raises TypeError for what is not uint8, ValueError for other shapes.
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

/// Episodes `first..first + count` of a seed: `(starts [N, 4], targets [N, 2])`, float64.
///
/// `difficulty` is 'easy', 'medium' or 'hard' (none, one or two gaps to pass); in its place a
/// `layout` may be given, from whose regions start and target are drawn. Episode `i` is keyed by
/// `(seed, i)`, so it is the same whatever range it is drawn in. The goal state is
/// `(target_x, target_y, w1, w2)`, its image the goal image.
///
/// Raises ValueError for another difficulty, both or neither of the two, or negative numbers.
#[pyfunction]
#[pyo3(
    signature = (seed, first, count, difficulty = None, layout = None),
    text_signature = "(seed, first, count, difficulty=None, layout=None)"
)]
fn maze_episodes<'py>(
    py: Python<'py>,
    seed: Whole,
    first: Whole,
    count: Whole,
    difficulty: Option<Text>,
    layout: Option<&Bound<'py, PyAny>>,
) -> PyResult<(Floats<'py>, Floats<'py>)> {
    let (seed, first) = (seed.seed("seed")?, first.seed("first")?);
    let count = count.amount("count")?;
    let layout = layout_of(layout)?;
    let difficulty = match (difficulty, &layout) {
        (Some(difficulty), None) => {
            Some(difficulty.get("difficulty")?.parse::<Difficulty>().map_err(to_py)?)
        }
        (None, Some(kept)) => kept.layout.difficulty(),
        _ => {
            let problem = "difficulty: give either a difficulty or a layout";
            return Err(PyValueError::new_err(problem));
        }
    };
    let layout = other_than_paper(layout);
    let columns = columns(layout.as_deref());
    let starts = new_array::<f64>(py, "count", &[count, columns])?;
    let targets = new_array::<f64>(py, "count", &[count, 2])?;
    {
        let (mut starts, mut targets) = (starts.readwrite(), targets.readwrite());
        let rows = starts.as_slice_mut()?.chunks_exact_mut(columns);
        let rows = rows.zip(targets.as_slice_mut()?.chunks_exact_mut(2)).enumerate();
        for (index, (start, target)) in rows {
            if index % EPISODES_PER_CHUNK == 0 {
                py.check_signals()?;
            }
            let number = first.wrapping_add(index as u64);
            match (&layout, difficulty) {
                (None, Some(difficulty)) => {
                    let episode = Episode::new(seed, number, difficulty);
                    write_row(&episode.start, start);
                    target.copy_from_slice(&episode.target);
                }
                (Some(kept), _) => {
                    let episode = kept.layout.episode(seed, number);
                    write_row(&episode.start, start);
                    target.copy_from_slice(&episode.target);
                }
                (None, None) => {}
            }
        }
    }
    Ok((starts, targets))
}

/// Ground-truth subgoals of `starts[N, 4]` and `targets[N, 2]`: states, float64
/// `[N, subgoals, 4]`.
///
/// The agent centred in the gaps that it has to pass, in order; on the straight line to the
/// target if there are none. In a `layout` at turns of the shortest way to the target, or between
/// them if there are fewer, moved a little towards the middle of free space.
///
/// Raises ValueError for shapes that do not match.
#[pyfunction]
#[pyo3(
    signature = (starts, targets, subgoals, layout = None),
    text_signature = "(starts, targets, subgoals, layout=None)"
)]
fn maze_subgoals<'py>(
    py: Python<'py>,
    starts: &Bound<'py, PyAny>,
    targets: &Bound<'py, PyAny>,
    subgoals: Whole,
    layout: Option<&Bound<'py, PyAny>>,
) -> PyResult<Floats<'py>> {
    let layout = given(layout)?;
    let starts = states_in("starts", starts, layout.as_deref())?;
    let targets = self::targets(targets, starts.len())?;
    let subgoals = subgoals.amount("subgoals")?;
    let shape = [starts.len(), subgoals, columns(layout.as_deref())];
    with_states!(starts, starts => {
        let pairs = starts.into_iter().zip(targets);
        let episodes: Vec<_> = pairs.map(|(start, target)| Episode { start, target }).collect();
        let found = detached(py, || maze::subgoals_batch(&episodes, subgoals))?;
        to_rows(py, "subgoals", &shape, found.into_iter())
    })
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
    signature = (seed, first, count, steps, size = None, layout = None),
    text_signature = "(seed, first, count, steps, size=64, layout=None)"
)]
fn maze_collect<'py>(
    py: Python<'py>,
    seed: Whole,
    first: Whole,
    count: Whole,
    steps: Whole,
    size: Option<Whole>,
    layout: Option<&Bound<'py, PyAny>>,
) -> PyResult<Interaction<'py>> {
    let layout = given(layout)?;
    let columns = columns(layout.as_deref());
    let (seed, first) = (seed.seed("seed")?, first.seed("first")?);
    let (count, steps) = (count.amount("count")?, steps.amount("steps")?);
    let renderer = renderer(size)?;
    let size = renderer.size();
    if steps == 0 {
        return Err(PyValueError::new_err("steps: must be at least 1"));
    }
    let frames = new_array::<u8>(py, "count", &[count, steps + 1, size, size, 3])?;
    let actions = new_array::<f32>(py, "count", &[count, steps, 2])?;
    let states = new_array::<f64>(py, "count", &[count, steps + 1, columns])?;
    let per_chunk = (FRAMES_PER_CHUNK / (steps + 1)).max(1);
    {
        let (mut frames, mut actions) = (frames.readwrite(), actions.readwrite());
        let mut states = states.readwrite();
        let chunks =
            frames.as_slice_mut()?.chunks_mut(per_chunk * (steps + 1) * renderer.frame_len());
        let chunks = chunks
            .zip(actions.as_slice_mut()?.chunks_mut(per_chunk * steps * 2))
            .zip(states.as_slice_mut()?.chunks_mut(per_chunk * (steps + 1) * columns));
        for (chunk, ((frames, actions), states)) in chunks.enumerate() {
            py.check_signals()?;
            let begin = first.wrapping_add((chunk * per_chunk) as u64);
            let episodes = actions.len() / (steps * 2);
            match &layout {
                None => {
                    let part = detached(py, || {
                        maze::collect(&renderer, seed, begin, episodes, steps, frames)
                    })?;
                    record(part.map_err(to_py)?, columns, states, actions);
                }
                Some(kept) => {
                    let layout = &kept.layout;
                    let part = detached(py, || {
                        maze::collect_in(layout, &renderer, seed, begin, episodes, steps, frames)
                    })?;
                    record(part.map_err(to_py)?, columns, states, actions);
                }
            }
        }
    }
    Ok((frames, actions, states))
}

/// Writes what was collected into arrays.
fn record<S: Ground>(
    part: maze::Interaction<S>,
    columns: usize,
    states: &mut [f64],
    actions: &mut [f32],
) {
    for (row, action) in actions.chunks_exact_mut(2).zip(&part.actions) {
        row.copy_from_slice(action);
    }
    for (row, state) in states.chunks_exact_mut(columns).zip(&part.states) {
        write_row(state, row);
    }
}

/// Whether the agent is within 0.05 m of its target: `states[N, 4]`, `targets[N, 2]` to bool
/// `[N]`.
///
/// Raises ValueError for shapes that do not match.
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
    let targets = self::targets(targets, states.len())?;
    with_states!(&states, states => {
        let pairs = states.iter().zip(&targets);
        let reached = pairs.map(|(state, &target)| maze::success(state, target));
        Ok(PyArray1::from_iter(py, reached))
    })
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
