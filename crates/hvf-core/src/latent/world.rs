//! A latent model as a [`WorldModel`].

use ndarray::{Array2, Array4, ArrayView3, ArrayView4, ArrayViewMut2, Axis};
use rayon::prelude::*;

use super::cost::{self, LatentCost};
use super::frames::LatentFrames;
use super::network::{self, Dynamics};
use crate::image::OverHorizon;
use crate::lanes::{Lanes, LANES};
use crate::planner::{ActionSpace, Candidates, Frames, SharedCandidates, WorldModel};
use crate::{Error, Result};

/// The most numbers that [`LatentWorld::rollout`] gives.
const MAX_VALUES: usize = 1 << 28;
/// Multiply-adds of one lane that are worth a task of their own.
const TASK: usize = 100_000;
/// Multiply-adds of a call: a third of a second of one core, with steps to spare.
const CALL: usize = 16_000_000_000;
/// Steps of a rollout that [`CALL`] is meant for.
const USUAL_STEPS: usize = 15;

/// A world whose frames are latents, with any network as dynamics.
///
/// # How it works
/// 1. [`Dynamics`] moves the latent of the start frame by each action in turn. An action is scaled
///    so that the action box is from -1 to 1; one beyond the box is taken as it is, and the network
///    extrapolates.
/// 2. [`LatentCost`] says how far what is read out of a latent is from the goal's target; the goal's
///    constant is added. No frame is decoded.
/// 3. [`OverHorizon`] makes one cost of the costs of the predicted frames.
///
/// [`LANES`] candidates, of any problems, are worked on together, each by itself: a cost has the
/// same bits alone and in a batch, with rollouts shared or not, on any number of threads. An action
/// that is not a number makes the cost NaN.
#[derive(Clone, Debug)]
pub struct LatentWorld {
    dynamics: Dynamics,
    cost: LatentCost,
    actions: ActionSpace,
    /// Middle of the action box, and what makes its half one.
    middle: Vec<f32>,
    per_half: Vec<f32>,
    over_horizon: OverHorizon,
    hold: usize,
}

/// Room for one block of candidates.
#[derive(Clone, Debug)]
struct Room {
    latent: Vec<Lanes>,
    action: Vec<Lanes>,
    dynamics: network::Room,
    cost: cost::Room,
}

impl LatentWorld {
    /// A world with these dynamics, this cost and actions in this box.
    ///
    /// One step of the dynamics is `hold` steps of actions, which must all be alike: the first of
    /// them is taken.
    ///
    /// # Errors
    /// A cost of other latents, an action space of other dimensions, or a hold of 0.
    pub fn new(
        dynamics: Dynamics,
        cost: LatentCost,
        actions: ActionSpace,
        over_horizon: OverHorizon,
        hold: usize,
    ) -> Result<Self> {
        if cost.latent_dim() != dynamics.latent_dim() {
            return Err(Error::invalid(
                "readout",
                format!(
                    "expected latents of {} numbers, got {}",
                    dynamics.latent_dim(),
                    cost.latent_dim()
                ),
            ));
        }
        if dynamics.action_dim() != actions.dim() {
            return Err(Error::invalid(
                "action_low",
                format!(
                    "expected {} dimensions, those of the dynamics, got {}",
                    dynamics.action_dim(),
                    actions.dim()
                ),
            ));
        }
        if hold == 0 {
            return Err(Error::invalid("hold", "must be at least 1, got 0"));
        }
        let sides = || actions.low().iter().zip(actions.high());
        let middle = sides().map(|(low, high)| 0.5 * low + 0.5 * high).collect();
        let per_half: Vec<f32> =
            sides().map(|(low, high)| 1.0 / (0.5 * high - 0.5 * low)).collect();
        if per_half.iter().any(|x| !x.is_finite()) {
            return Err(Error::invalid("action_high", "must be well above action_low"));
        }
        Ok(Self { dynamics, cost, actions, middle, per_half, over_horizon, hold })
    }

    /// Length of a latent, `Z`.
    pub fn latent_dim(&self) -> usize {
        self.dynamics.latent_dim()
    }

    /// Steps of actions that one step of the dynamics is long.
    pub fn hold(&self) -> usize {
        self.hold
    }

    /// Which predicted frames count.
    pub fn over_horizon(&self) -> OverHorizon {
        self.over_horizon
    }

    fn room(&self) -> Room {
        Room {
            latent: vec![[0.0; LANES]; self.latent_dim()],
            action: vec![[0.0; LANES]; self.actions.dim()],
            dynamics: self.dynamics.room(),
            cost: self.cost.room(),
        }
    }

    /// Blocks of lanes that one task should have.
    fn blocks_per_task(&self, steps: usize) -> usize {
        let block = (self.dynamics.multiply_adds() + self.cost.multiply_adds()) * steps.max(1);
        TASK.div_ceil(block.max(1))
    }

    /// Rolls out the candidate `of(lane) = (problem, candidate)` of each lane of a block and hands
    /// their latents to `visit(step, latents, room)` after every step.
    fn roll(
        &self,
        starts: &LatentFrames,
        actions: ArrayView4<'_, f32>,
        of: impl Fn(usize) -> (usize, usize),
        room: &mut Room,
        mut visit: impl FnMut(usize, &[Lanes], &mut cost::Room),
    ) {
        let Room { latent, action, dynamics, cost } = room;
        for lane in 0..LANES {
            for (to, from) in latent.iter_mut().zip(starts.latent(of(lane).0)) {
                to[lane] = *from;
            }
        }
        for step in 0..actions.len_of(Axis(2)) / self.hold {
            for lane in 0..LANES {
                let (problem, candidate) = of(lane);
                for (dimension, to) in action.iter_mut().enumerate() {
                    let taken = actions[[problem, candidate, step * self.hold, dimension]];
                    to[lane] = (taken - self.middle[dimension]) * self.per_half[dimension];
                }
            }
            self.dynamics.advance(latent, action, dynamics);
            visit(step, latent, cost);
        }
    }

    /// Latents `[B, D, H / hold, Z]` that are predicted from each of `B` frames for
    /// `actions[B, D, H, A]`.
    ///
    /// # Errors
    /// Frames or actions of other dimensions, not as many of one as of the other, a horizon that is
    /// no multiple of `hold`, or more than 2^28 numbers.
    pub fn rollout(
        &self,
        starts: &LatentFrames,
        actions: ArrayView4<'_, f32>,
    ) -> Result<Array4<f32>> {
        self.check_frames("starts", starts)?;
        let steps = self.check_actions(actions, starts.len())?;
        let (problems, candidates, ..) = actions.dim();
        let length = self.latent_dim();
        let values = [problems, candidates, steps, length]
            .iter()
            .try_fold(1_usize, |product, &n| product.checked_mul(n))
            .filter(|&values| values <= MAX_VALUES)
            .ok_or_else(|| {
                Error::invalid(
                    "actions",
                    format!(
                        "would lead to more than {MAX_VALUES} numbers: {problems} x {candidates} x \
                         {steps} latents of {length}"
                    ),
                )
            })?;
        let mut paths = vec![0.0; values];
        if values > 0 {
            let path = steps * length;
            let last = problems * candidates - 1;
            paths
                .par_chunks_mut(LANES * path)
                .with_min_len(self.blocks_per_task(steps))
                .enumerate()
                .for_each_init(
                    || self.room(),
                    |room, (block, out)| {
                        let of = |lane: usize| {
                            let row = (block * LANES + lane).min(last);
                            (row / candidates, row % candidates)
                        };
                        self.roll(starts, actions, of, room, |step, latent, _| {
                            for (lane, path) in out.chunks_exact_mut(path).enumerate() {
                                for (to, from) in path[step * length..].iter_mut().zip(latent) {
                                    *to = from[lane];
                                }
                            }
                        });
                    },
                );
        }
        Ok(Array4::from_shape_vec((problems, candidates, steps, length), paths)
            .expect("as many numbers as latents have"))
    }

    /// Costs `[B, D]` of `actions[D, H, A]` from the one frame in `start` to each of `goals[B]`.
    ///
    /// # Errors
    /// Frames or actions of other dimensions, more or less than one start, or a horizon that is no
    /// multiple of `hold`.
    pub fn shared_costs(
        &self,
        start: &LatentFrames,
        goals: &LatentFrames,
        actions: ArrayView3<'_, f32>,
    ) -> Result<Array2<f32>> {
        self.check_frames("start", start)?;
        self.check_frames("goals", goals)?;
        self.cost.check_goals(goals)?;
        if start.len() != 1 {
            return Err(Error::invalid("start", format!("expected 1 frame, got {}", start.len())));
        }
        let actions = actions.insert_axis(Axis(0));
        let steps = self.check_actions(actions, 1)?;
        let candidates = actions.len_of(Axis(1));
        let points = self.cost.goals(goals);
        let mut costs = Array2::from_elem((goals.len(), candidates), self.over_horizon.start());
        costs
            .axis_chunks_iter_mut(Axis(1), LANES)
            .into_par_iter()
            .with_min_len(self.blocks_per_task(steps))
            .enumerate()
            .for_each_init(
                || self.room(),
                |room, (block, mut out): (usize, ArrayViewMut2<'_, f32>)| {
                    let of = |lane: usize| (0, (block * LANES + lane).min(candidates - 1));
                    self.roll(start, actions, of, room, |step, latent, room| {
                        if self.over_horizon.counts(step, steps) {
                            let found = self.cost.points(latent, room);
                            points.costs(found, |goal, costs| {
                                for (tally, cost) in out.row_mut(goal).iter_mut().zip(costs) {
                                    *tally = self.over_horizon.add(*tally, *cost);
                                }
                            });
                        }
                    });
                },
            );
        Ok(costs)
    }

    fn check_frames(&self, argument: &'static str, frames: &LatentFrames) -> Result<()> {
        let (expected, found) = (self.latent_dim(), frames.latent_dim());
        if found == expected {
            return Ok(());
        }
        Err(Error::invalid(
            argument,
            format!("expected latents of {expected} numbers, got {found}"),
        ))
    }

    /// Checks `actions[B, D, H, A]` for `problems`; gives the steps of the dynamics.
    fn check_actions(&self, actions: ArrayView4<'_, f32>, problems: usize) -> Result<usize> {
        let (found, _, steps, dim) = actions.dim();
        let invalid = |problem| Err(Error::invalid("actions", problem));
        if found != problems {
            return invalid(format!("expected {problems} problems, got {found}"));
        }
        if dim != self.actions.dim() {
            return invalid(format!("expected {} dimensions, got {dim}", self.actions.dim()));
        }
        if steps % self.hold != 0 {
            return invalid(format!(
                "expected a horizon that is a multiple of hold ({}), got {steps}",
                self.hold
            ));
        }
        Ok(steps / self.hold)
    }
}

impl WorldModel for LatentWorld {
    type Frames = LatentFrames;

    fn action_space(&self) -> &ActionSpace {
        &self.actions
    }

    fn max_candidates(&self) -> usize {
        let step = self.dynamics.multiply_adds() + self.cost.multiply_adds();
        (CALL / (USUAL_STEPS * step.max(1))).clamp(64 * LANES, 1 << 16)
    }

    fn rollout_costs(
        &self,
        starts: &LatentFrames,
        goals: &LatentFrames,
        Candidates { actions, .. }: Candidates,
    ) -> Result<Array2<f32>> {
        self.check_frames("starts", starts)?;
        self.check_frames("goals", goals)?;
        self.cost.check_goals(goals)?;
        let steps = self.check_actions(actions.view(), starts.len())?;
        self.check_actions(actions.view(), goals.len())?;
        let (problems, candidates, ..) = actions.dim();
        let points = self.cost.goals(goals);
        let mut costs = vec![self.over_horizon.start(); problems * candidates];
        let last = costs.len().saturating_sub(1);
        costs
            .par_chunks_mut(LANES)
            .with_min_len(self.blocks_per_task(steps))
            .enumerate()
            .for_each_init(
                || (self.room(), vec![[0.0; LANES]; self.cost.point_dim()]),
                |(room, aims), (block, out)| {
                    let of = |lane: usize| {
                        let row = (block * LANES + lane).min(last);
                        (row / candidates, row % candidates)
                    };
                    points.block(|lane| of(lane).0, aims);
                    self.roll(starts, actions.view(), of, room, |step, latent, room| {
                        if self.over_horizon.counts(step, steps) {
                            let found = self.cost.points(latent, room);
                            let sums = cost::distances(found, aims);
                            for (lane, tally) in out.iter_mut().enumerate() {
                                let cost = sums[lane] + goals.constant(of(lane).0);
                                *tally = self.over_horizon.add(*tally, cost);
                            }
                        }
                    });
                },
            );
        Ok(Array2::from_shape_vec((problems, candidates), costs).expect("a cost per candidate"))
    }

    fn shared_rollout_costs(
        &self,
        start: &LatentFrames,
        goals: &LatentFrames,
        SharedCandidates { actions, .. }: SharedCandidates,
    ) -> Option<Result<Array2<f32>>> {
        Some(self.shared_costs(start, goals, actions.view()))
    }
}

#[cfg(test)]
#[path = "world_tests.rs"]
mod tests;
