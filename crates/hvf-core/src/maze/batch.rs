//! Many mazes at once, over all cores. Results do not depend on the number of threads.
//!
//! `N` is the number of mazes, `S` the size of a frame, `T` the steps of an episode.

use rayon::prelude::*;

use super::episodes::random_interaction;
use super::geometry::State;
use super::physics::step;
use super::render::Renderer;
use crate::{Error, Result};

/// Steps are so short that a thread takes this many at a time, and fewer are not worth waking
/// other threads for.
const STEPS_PER_TASK: usize = 512;
/// The same for frames.
const FRAMES_PER_TASK: usize = 16;

/// [`step`] for `states[N]` and `actions[N]`.
///
/// # Errors
/// Lengths that differ, or an action that is not finite.
pub fn step_batch(states: &[State], actions: &[[f32; 2]]) -> Result<Vec<State>> {
    if states.len() != actions.len() {
        return Err(Error::invalid(
            "actions",
            format!("must be as many as states ({}), got {}", states.len(), actions.len()),
        ));
    }
    if let Some(index) = actions.iter().position(|a| !(a[0].is_finite() && a[1].is_finite())) {
        return Err(Error::invalid(
            "actions",
            format!("must be finite, got {:?} at index {index}", actions[index]),
        ));
    }
    let step = |(state, action): (&State, &[f32; 2])| step(state, action.map(f64::from));
    if states.len() <= STEPS_PER_TASK {
        return Ok(states.iter().zip(actions).map(step).collect());
    }
    Ok(states.par_iter().zip(actions).with_min_len(STEPS_PER_TASK).map(step).collect())
}

/// [`Renderer::render`] for `states[N]` into `frames`, `[N, S, S, 3]`.
///
/// # Errors
/// `frames` of another length than `N` frames.
pub fn render_batch(renderer: &Renderer, states: &[State], frames: &mut [u8]) -> Result<()> {
    check_frames(renderer, states.len(), frames.len())?;
    let render = |(frame, state): (&mut [u8], &State)| renderer.render(state, frame);
    let len = renderer.frame_len();
    if states.len() <= FRAMES_PER_TASK {
        frames.chunks_exact_mut(len).zip(states).for_each(render);
    } else {
        let frames = frames.par_chunks_exact_mut(len).zip(states);
        frames.with_min_len(FRAMES_PER_TASK).for_each(render);
    }
    Ok(())
}

/// [`Renderer::locate`] for `frames`, `[N, S, S, 3]`.
///
/// # Errors
/// `frames` that are not a whole number of frames.
pub fn locate_batch(renderer: &Renderer, frames: &[u8]) -> Result<Vec<State>> {
    check_frames(renderer, frames.len() / renderer.frame_len(), frames.len())?;
    Ok(frames
        .par_chunks_exact(renderer.frame_len())
        .with_min_len(FRAMES_PER_TASK)
        .map(|frame| renderer.locate(frame))
        .collect())
}

fn check_frames(renderer: &Renderer, count: usize, bytes: usize) -> Result<()> {
    if bytes == count * renderer.frame_len() {
        return Ok(());
    }
    let size = renderer.size();
    Err(Error::invalid(
        "frames",
        format!("must be [{count}, {size}, {size}, 3], got {bytes} bytes"),
    ))
}

/// Random interaction of `N` episodes of `T` steps.
pub struct Interaction {
    /// States `[N, T + 1]`.
    pub states: Vec<State>,
    /// Actions `[N, T]`.
    pub actions: Vec<[f32; 2]>,
}

/// Episodes `first..first + count` of a seed under the random policy, `steps` steps each, with
/// their frames in `frames`, `[N, T + 1, S, S, 3]`. Episode `i` is the same whatever range it is
/// part of.
///
/// # Errors
/// `steps` of 0, or `frames` of another length.
pub fn collect(
    renderer: &Renderer,
    seed: u64,
    first: u64,
    count: usize,
    steps: usize,
    frames: &mut [u8],
) -> Result<Interaction> {
    if steps == 0 {
        return Err(Error::invalid("steps", "must be at least 1"));
    }
    check_frames(renderer, count * (steps + 1), frames.len())?;
    let episodes: Vec<(Vec<State>, Vec<[f32; 2]>)> = frames
        .par_chunks_exact_mut(renderer.frame_len() * (steps + 1))
        .enumerate()
        .map(|(index, frames)| {
            let episode = first.wrapping_add(index as u64);
            let (mut state, actions) = random_interaction(seed, episode, steps);
            let mut states = Vec::with_capacity(steps + 1);
            for (time, frame) in frames.chunks_exact_mut(renderer.frame_len()).enumerate() {
                renderer.render(&state, frame);
                states.push(state);
                if let Some(action) = actions.get(time) {
                    state = step(&state, action.map(f64::from));
                }
            }
            (states, actions)
        })
        .collect();
    let (states, actions): (Vec<_>, Vec<_>) = episodes.into_iter().unzip();
    Ok(Interaction { states: states.concat(), actions: actions.concat() })
}
