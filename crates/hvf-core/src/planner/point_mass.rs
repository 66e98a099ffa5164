//! An analytic world for the planner's tests: a point that moves by its actions, scored by the
//! squared distance to the goal; and a generator whose latents are positions.
#![allow(clippy::unwrap_used)]

use std::cell::{Cell, RefCell};

use ndarray::{Array2, Array3, ArrayView2};

use super::model::{ActionSpace, Candidates, Frames, SharedCandidates, SubgoalModel, WorldModel};
use crate::{Error, Result};

/// Positions in the plane.
#[derive(Clone, Debug, PartialEq)]
pub struct Points(pub Vec<[f32; 2]>);

impl Frames for Points {
    fn len(&self) -> usize {
        self.0.len()
    }

    fn select(&self, index: &[usize]) -> Result<Self> {
        let point = |&i: &usize| {
            self.0
                .get(i)
                .copied()
                .ok_or_else(|| Error::invalid("index", format!("{i} is too large")))
        };
        index.iter().map(point).collect::<Result<_>>().map(Points)
    }

    fn join(parts: &[&Self]) -> Option<Result<Self>> {
        Some(Ok(Points(parts.iter().flat_map(|part| part.0.iter().copied()).collect())))
    }
}

/// Each action moves the point by itself; actions are within `[-1, 1]`.
pub struct PointMass {
    pub actions: ActionSpace,
    pub max_candidates: usize,
    pub shares: bool,
    /// Cost wherever the goal has this first coordinate.
    pub nan_at: Option<f32>,
    /// Adds a number drawn from its seed to every candidate's cost.
    pub noisy: bool,
    /// Mirrors goals in `prepare`, and again in every cost.
    pub prepares: bool,
    /// Frames that `prepare` gives beyond those it got.
    pub prepares_too_many: usize,
    /// Starts and goals of every `prepare`.
    pub prepared: RefCell<Vec<(usize, usize)>>,
    /// Wants few sizes of calls.
    pub pads: bool,
    /// Problems of every call.
    pub sizes: RefCell<Vec<usize>>,
    /// Rollouts (candidates) and calls so far.
    pub rollouts: Cell<usize>,
    pub calls: Cell<usize>,
}

impl PointMass {
    pub fn new() -> Self {
        Self {
            actions: ActionSpace::new(vec![-1.0; 2], vec![1.0; 2]).unwrap(),
            max_candidates: 1 << 16,
            shares: true,
            nan_at: None,
            noisy: false,
            prepares: false,
            prepares_too_many: 0,
            prepared: RefCell::new(Vec::new()),
            pads: false,
            sizes: RefCell::new(Vec::new()),
            rollouts: Cell::new(0),
            calls: Cell::new(0),
        }
    }

    pub fn cost(&self, start: [f32; 2], goal: [f32; 2], actions: ArrayView2<'_, f32>) -> f32 {
        if self.nan_at == Some(goal[0]) {
            return f32::NAN;
        }
        let mut position = start;
        for action in actions.outer_iter() {
            position[0] += action[0];
            position[1] += action[1];
        }
        (position[0] - goal[0]).powi(2) + (position[1] - goal[1]).powi(2)
    }

    /// Cost of the candidate with `seed` towards a goal as `prepare` left it.
    fn rolled(
        &self,
        start: [f32; 2],
        goal: [f32; 2],
        actions: ArrayView2<'_, f32>,
        seed: Option<i64>,
    ) -> f32 {
        assert_eq!(seed.is_some(), self.noisy);
        let goal = if self.prepares { mirrored(goal) } else { goal };
        self.cost(start, goal, actions) + seed.map_or(0.0, noise)
    }

    fn count(&self, rollouts: usize) {
        self.calls.set(self.calls.get() + 1);
        self.rollouts.set(self.rollouts.get() + rollouts);
    }
}

/// The noise that belongs to a seed, in `[0, 1)`: its highest bits.
pub fn noise(seed: i64) -> f32 {
    assert!(seed >= 0);
    (seed >> 39) as f32 / (1 << 24) as f32
}

fn mirrored(point: [f32; 2]) -> [f32; 2] {
    point.map(|x| -x)
}

impl WorldModel for PointMass {
    type Frames = Points;

    fn action_space(&self) -> &ActionSpace {
        &self.actions
    }

    fn max_candidates(&self) -> usize {
        self.max_candidates
    }

    fn uses_seeds(&self) -> bool {
        self.noisy
    }

    fn pads(&self) -> bool {
        self.pads
    }

    fn prepare(&self, starts: &Points, goals: &Points) -> Result<Option<(Points, Points)>> {
        if !self.prepares {
            return Ok(None);
        }
        self.prepared.borrow_mut().push((starts.len(), goals.len()));
        let mut prepared: Vec<[f32; 2]> = goals.0.iter().copied().map(mirrored).collect();
        prepared.extend(vec![[0.0; 2]; self.prepares_too_many]);
        Ok(Some((starts.clone(), Points(prepared))))
    }

    fn rollout_costs(
        &self,
        starts: &Points,
        goals: &Points,
        Candidates { actions, seeds }: Candidates,
    ) -> Result<Array2<f32>> {
        let (problems, samples, _, _) = actions.dim();
        assert_eq!((starts.len(), goals.len()), (problems, problems));
        assert!(actions.is_standard_layout());
        self.count(problems * samples);
        self.sizes.borrow_mut().push(problems);
        Ok(Array2::from_shape_fn((problems, samples), |(b, d)| {
            let candidate = actions.slice(ndarray::s![b, d, .., ..]);
            let seed = seeds.as_ref().map(|seeds| seeds[[b, d]]);
            self.rolled(starts.0[b], goals.0[b], candidate, seed)
        }))
    }

    fn shared_rollout_costs(
        &self,
        start: &Points,
        goals: &Points,
        SharedCandidates { actions, seeds }: SharedCandidates,
    ) -> Option<Result<Array2<f32>>> {
        if !self.shares {
            return None;
        }
        let samples = actions.dim().0;
        self.count(samples);
        self.sizes.borrow_mut().push(goals.len());
        Some(Ok(Array2::from_shape_fn((goals.len(), samples), |(b, d)| {
            let candidate = actions.slice(ndarray::s![d, .., ..]);
            let seed = seeds.as_ref().map(|seeds| seeds[d]);
            self.rolled(start.0[0], goals.0[b], candidate, seed)
        })))
    }
}

/// Decodes the first two of three latents, doubled, to a position. Remembers its latents.
pub struct Positions {
    pub seen: RefCell<Vec<Array3<f32>>>,
    pub frames_missing: usize,
    pub costs_missing: usize,
}

impl Positions {
    pub fn new() -> Self {
        Self { seen: RefCell::new(Vec::new()), frames_missing: 0, costs_missing: 0 }
    }

    pub fn position(latents: &[f32]) -> [f32; 2] {
        [2.0 * latents[0], 2.0 * latents[1]]
    }
}

impl SubgoalModel<Points> for Positions {
    fn latent_dim(&self) -> usize {
        3
    }

    fn decode(&self, scene: &Points, latents: Array3<f32>) -> Result<Points> {
        assert_eq!(scene.len(), 1);
        let mut positions: Vec<[f32; 2]> =
            latents.as_slice().unwrap().chunks(3).map(Self::position).collect();
        positions.truncate(positions.len() - self.frames_missing);
        self.seen.borrow_mut().push(latents);
        Ok(Points(positions))
    }

    /// The squared length of each segment; NaN where a latent's third number is above 1.
    fn segment_costs(
        &self,
        start: &Points,
        goal: &Points,
        latents: Array3<f32>,
    ) -> Result<Array2<f32>> {
        let (samples, subgoals, _) = latents.dim();
        let costs =
            Array2::from_shape_fn((samples - self.costs_missing, subgoals + 1), |(m, k)| {
                let at = |number: usize| {
                    Self::position(&latents.slice(ndarray::s![m, number, ..]).to_vec())
                };
                let from = if k == 0 { start.0[0] } else { at(k - 1) };
                let to = if k == subgoals { goal.0[0] } else { at(k) };
                match k < subgoals && latents[[m, k, 2]] > 1.0 {
                    true => f32::NAN,
                    false => (from[0] - to[0]).powi(2) + (from[1] - to[1]).powi(2),
                }
            });
        self.seen.borrow_mut().push(latents);
        Ok(costs)
    }
}
