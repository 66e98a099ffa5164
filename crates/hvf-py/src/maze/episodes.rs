//! Episodes, their true subgoals, and random interaction: `maze_*` functions over NumPy arrays.

use hvf_core_rs::maze::ground::Ground;
use hvf_core_rs::maze::{self, Difficulty, Episode, States};
use numpy::{PyArrayDyn, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use super::layout::{layout_of, other_than_paper, states_in, write_row};
use super::{columns, given, renderer, to_rows, with_states, Floats};
use crate::arguments::{new_array, Text, Whole};
use crate::error::to_py;
use crate::threads::detached;

/// Frames between two looks at whether Ctrl-C was pressed.
const FRAMES_PER_CHUNK: usize = 20_000;
/// Episodes between two such looks.
const EPISODES_PER_CHUNK: usize = 1 << 16;

/// Episodes of a seed: `(starts [N, 4], targets [N, 2])`, float64, metres.
///
/// Episode `i` is keyed by `(seed, i)`, so it is the same whatever range it is drawn in. The goal
/// state is `(target_x, target_y, w1, w2)`, its image the goal image.
///
/// Args:
///     seed: From 0 to 2**64 - 1.
///     first: Number of the first episode.
///     count: How many, `N`.
///     difficulty: 'easy', 'medium' or 'hard' (none, one or two gaps to pass).
///     layout: In place of a difficulty: starts and targets are drawn from the layout's regions,
///         and starts are its states, `(x, y, gap, ..)`.
///
/// Raises:
///     ValueError: Another difficulty, both or neither of the two, or negative numbers.
///     TypeError: An argument of another kind.
///     MemoryError: The episodes do not fit into memory.
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

/// Ground-truth subgoals: states, float64 `[N, subgoals, 4]`.
///
/// The agent centred in the gaps that it has to pass, in order; on the straight line to the
/// target if there are none. In a `layout` at turns of the shortest way to the target, or between
/// them if there are fewer, moved a little towards the middle of free space.
///
/// Args:
///     starts: States that episodes start from, float `[N, 4]`, as for `maze_step`.
///     targets: Where they aim, float `[N, 2]`, metres.
///     subgoals: How many for each, `K`.
///     layout: As for `maze_step`.
///
/// Raises:
///     ValueError: Shapes that do not match, or numbers out of range.
///     TypeError: An argument of another kind.
///     MemoryError: The subgoals do not fit into memory.
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
    let targets = super::targets(targets, starts.len())?;
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

/// Random interaction: `(images, actions, states)`.
///
/// `images` are uint8 `[N, T + 1, size, size, 3]`, `actions` float32 `[N, T, 2]`, `states` float64
/// `[N, T + 1, 4]`. Starts are uniform over free space in random scenes, actions uniform over the
/// box. Episode `i` is keyed by `(seed, i)`: ranges can be collected in any order and chunking.
/// Ctrl-C stops it.
///
/// Args:
///     seed: From 0 to 2**64 - 1.
///     first: Number of the first episode.
///     count: How many, `N`.
///     steps: Steps of each, `T`, at least 1.
///     size: Height and width of the images, pixels, from 8 to 2048; None for 64.
///     layout: As for `maze_step`.
///
/// Raises:
///     ValueError: Negative or zero sizes.
///     TypeError: An argument of another kind.
///     MemoryError: The frames do not fit into memory.
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

/// Adds this file's functions to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(maze_episodes, module)?)?;
    module.add_function(wrap_pyfunction!(maze_subgoals, module)?)?;
    module.add_function(wrap_pyfunction!(maze_collect, module)?)
}
