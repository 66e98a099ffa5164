//! A native world in pieces, so that Ctrl-C ends a call of any size.

use std::cell::Cell;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use hvf_core_rs::planner::{ActionSpace, Candidates, Frames, SharedCandidates, WorldModel};
use hvf_core_rs::{Error, Result};
use ndarray::{concatenate, Array, Array2, Axis, Dimension, RemoveAxis, Slice};
use pyo3::prelude::*;

use super::border::NativeClass;
use super::raised;

/// About how long a piece takes: well below a second, and far above what it costs to begin one.
const PIECE: Duration = Duration::from_millis(200);
/// Steps of the first piece, before it is known how long one takes.
const FIRST: usize = 1 << 14;

/// A world whose calls are cut into pieces of candidates, with a look for Ctrl-C before each.
///
/// What a candidate costs does not depend on the others of its call, so plans are the same to the
/// last bit however calls are cut. Only calls of more than [`PIECE`] are.
pub struct Paced<N> {
    native: Py<N>,
    /// Steps that a piece should have, by what earlier ones took.
    steps: AtomicUsize,
}

impl<N: NativeClass> Paced<N> {
    /// The world of `native` in pieces.
    pub fn new(native: Py<N>) -> Self {
        Self { native, steps: AtomicUsize::new(FIRST) }
    }

    fn world(&self) -> &N::World {
        self.native.get().world()
    }

    fn steps(&self) -> usize {
        self.steps.load(Ordering::Relaxed)
    }

    /// One piece of `steps` steps, which says how large the next should be.
    fn piece(
        &self,
        steps: usize,
        costs: impl FnOnce() -> Result<Array2<f32>>,
    ) -> Result<Array2<f32>> {
        let begun = Instant::now();
        let costs = costs()?;
        let share = PIECE.as_secs_f64() / begun.elapsed().as_secs_f64().max(1e-6);
        let fitting = (steps as f64 * share.min(4.0)) as usize;
        // That a small piece was fast is no reason to make pieces smaller.
        let next = if share >= 1.0 { fitting.max(self.steps()) } else { fitting };
        self.steps.store(next.max(1), Ordering::Relaxed);
        Ok(costs)
    }

    /// Costs of `count` problems or candidates of `steps` steps each, a part of them at a time, side
    /// by side along `axis`.
    fn in_parts(
        &self,
        axis: Axis,
        count: usize,
        steps: usize,
        costs: impl Fn(Slice) -> Result<Array2<f32>>,
    ) -> Result<Array2<f32>> {
        let mut parts = Vec::new();
        let mut first = 0;
        while first < count {
            Python::attach(|py| py.check_signals()).map_err(raised)?;
            let end = first.saturating_add((self.steps() / steps).max(1)).min(count);
            parts.push(costs(Slice::from(first..end))?);
            first = end;
        }
        let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
        concatenate(axis, &views).map_err(|error| Error::Model(error.to_string()))
    }
}

/// Frames of a native class's world.
type FramesIn<N> = <<N as NativeClass>::World as WorldModel>::Frames;

/// A part of an array along an axis, in memory of its own.
fn part<T: Clone, D: Dimension + RemoveAxis>(
    array: &Array<T, D>,
    axis: usize,
    which: Slice,
) -> Array<T, D> {
    array.slice_axis(Axis(axis), which).to_owned()
}

impl<N: NativeClass> WorldModel for Paced<N> {
    type Frames = FramesIn<N>;

    fn action_space(&self) -> &ActionSpace {
        self.world().action_space()
    }

    fn max_candidates(&self) -> usize {
        self.world().max_candidates()
    }

    fn uses_seeds(&self) -> bool {
        self.world().uses_seeds()
    }

    fn pads(&self) -> bool {
        self.world().pads()
    }

    fn prepare(
        &self,
        starts: &FramesIn<N>,
        goals: &FramesIn<N>,
    ) -> Result<Option<(FramesIn<N>, FramesIn<N>)>> {
        self.world().prepare(starts, goals)
    }

    fn rollout_costs(
        &self,
        starts: &FramesIn<N>,
        goals: &FramesIn<N>,
        candidates: Candidates,
    ) -> Result<Array2<f32>> {
        let (problems, samples, horizon, _) = candidates.actions.dim();
        let of_one = samples * horizon;
        if problems * of_one <= self.steps() || samples * problems <= 1 {
            return self.piece(problems * of_one, || {
                self.world().rollout_costs(starts, goals, candidates)
            });
        }
        let of_part = |axis, which| Candidates {
            actions: part(&candidates.actions, axis, which),
            seeds: candidates.seeds.as_ref().map(|seeds| part(seeds, axis, which)),
        };
        if problems == 1 {
            return self.in_parts(Axis(1), samples, horizon, |which| {
                let candidates = of_part(1, which);
                let steps = candidates.actions.len_of(Axis(1)) * horizon;
                self.piece(steps, || self.world().rollout_costs(starts, goals, candidates))
            });
        }
        self.in_parts(Axis(0), problems, of_one, |which| {
            let candidates = of_part(0, which);
            let first = which.start as usize;
            let index: Vec<usize> = (first..first + candidates.actions.len_of(Axis(0))).collect();
            self.rollout_costs(&starts.select(&index)?, &goals.select(&index)?, candidates)
        })
    }

    fn shared_rollout_costs(
        &self,
        start: &FramesIn<N>,
        goals: &FramesIn<N>,
        candidates: SharedCandidates,
    ) -> Option<Result<Array2<f32>>> {
        let (samples, horizon, _) = candidates.actions.dim();
        let of_one = horizon * goals.len();
        if samples * of_one <= self.steps() || samples <= 1 {
            return self.world().shared_rollout_costs(start, goals, candidates);
        }
        let refused = Cell::new(false);
        let costs = self.in_parts(Axis(1), samples, of_one, |which| {
            let actions = part(&candidates.actions, 0, which);
            let seeds = candidates.seeds.as_ref().map(|seeds| part(seeds, 0, which));
            let steps = actions.len_of(Axis(0)) * of_one;
            let candidates = SharedCandidates { actions, seeds };
            self.piece(steps, || {
                self.world().shared_rollout_costs(start, goals, candidates).unwrap_or_else(|| {
                    refused.set(true);
                    Err(Error::Model("cannot share rollouts".into()))
                })
            })
        });
        (!refused.get()).then_some(costs)
    }
}
