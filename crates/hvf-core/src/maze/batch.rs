//! Many mazes at once, over all cores. Results do not depend on the number of threads.
//!
//! `N` is the number of mazes, `S` the size of a frame, `T` the steps of an episode.

use std::mem::replace;
use std::sync::Arc;

use rayon::prelude::*;

use super::episodes::{random_interaction, Episode};
use super::geometry::{Scene, State};
use super::ground::Ground;
use super::layout::{Layout, LayoutScene};
use super::render::Renderer;
use crate::{Error, Result};

/// Steps are so short that a thread takes this many at a time, and fewer are not worth waking
/// other threads for.
const STEPS_PER_TASK: usize = 512;
/// The same for frames.
const FRAMES_PER_TASK: usize = 16;

/// One step ([`step`](super::step)) for `states[N]` and `actions[N]`.
///
/// # Errors
/// Lengths that differ, or an action that is not finite.
pub fn step_batch<S: Ground>(states: &[State<S>], actions: &[[f32; 2]]) -> Result<Vec<State<S>>> {
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
    let step = |(state, action): (&State<S>, &[f32; 2])| stepped(state, *action);
    if states.len() <= STEPS_PER_TASK {
        return Ok(states.iter().zip(actions).map(step).collect());
    }
    Ok(states.par_iter().zip(actions).with_min_len(STEPS_PER_TASK).map(step).collect())
}

fn stepped<S: Ground>(state: &State<S>, action: [f32; 2]) -> State<S> {
    let space = state.scene.space();
    let position = S::step_from(&space, state.position, action.map(f64::from));
    State { scene: state.scene.clone(), position }
}

/// [`Renderer::render`] for `states[N]` into `frames`, `[N, S, S, 3]`.
///
/// # Errors
/// `frames` of another length than `N` frames.
pub fn render_batch<S: Ground>(
    renderer: &Renderer,
    states: &[State<S>],
    frames: &mut [u8],
) -> Result<()> {
    check_frames(renderer, states.len(), frames.len())?;
    let render = |(frame, state): (&mut [u8], &State<S>)| renderer.render(state, frame);
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

/// `count` ground-truth subgoals for each of `episodes[N]`: states `[N, count]`.
pub fn subgoals_batch<S: Ground>(episodes: &[Episode<S>], count: usize) -> Vec<State<S>> {
    episodes.par_iter().flat_map_iter(|episode| S::true_subgoals(episode, count)).collect()
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
pub struct Interaction<S = Scene> {
    /// States `[N, T + 1]`.
    pub states: Vec<State<S>>,
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
    interact(renderer, (first, count, steps), frames, |episode| {
        random_interaction(seed, episode, steps)
    })
}

/// [`collect`] in a layout; episodes draw its gaps.
///
/// # Errors
/// As [`collect`].
pub fn collect_in(
    layout: &Arc<Layout>,
    renderer: &Renderer,
    seed: u64,
    first: u64,
    count: usize,
    steps: usize,
    frames: &mut [u8],
) -> Result<Interaction<Arc<LayoutScene>>> {
    interact(renderer, (first, count, steps), frames, |episode| {
        layout.random_interaction(seed, episode, steps)
    })
}

/// Actions of an episode.
type Actions = Vec<[f32; 2]>;

fn interact<S: Ground>(
    renderer: &Renderer,
    (first, count, steps): (u64, usize, usize),
    frames: &mut [u8],
    draw: impl Fn(u64) -> (State<S>, Actions) + Sync,
) -> Result<Interaction<S>> {
    if steps == 0 {
        return Err(Error::invalid("steps", "must be at least 1"));
    }
    check_frames(renderer, count * (steps + 1), frames.len())?;
    let episodes: Vec<(Vec<State<S>>, Actions)> = frames
        .par_chunks_exact_mut(renderer.frame_len() * (steps + 1))
        .enumerate()
        .map(|(index, frames)| {
            let episode = first.wrapping_add(index as u64);
            let (mut state, actions) = draw(episode);
            let mut states = Vec::with_capacity(steps + 1);
            for (time, frame) in frames.chunks_exact_mut(renderer.frame_len()).enumerate() {
                renderer.render(&state, frame);
                let next = actions.get(time).map_or(state.clone(), |&a| stepped(&state, a));
                states.push(replace(&mut state, next));
            }
            (states, actions)
        })
        .collect();
    let (states, actions): (Vec<_>, Vec<_>) = episodes.into_iter().unzip();
    Ok(Interaction { states: states.concat(), actions: actions.concat() })
}
