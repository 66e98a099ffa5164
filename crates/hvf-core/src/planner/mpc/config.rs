//! Settings of visual MPC, and the distributions over action sequences that they mean.

use ndarray::ArrayView2;

use super::{check_single, plan_one, Plan};
use crate::planner::cem::distribution::{Bounds, Initial, Space};
use crate::planner::cem::noise::Coloured;
use crate::planner::cem::{CemConfig, Covariance};
use crate::planner::model::{ActionSpace, WorldModel};
use crate::planner::sampler::{Purpose, Stream, LONGEST_NORMAL};
use crate::{Error, Result};

/// Distribution of the first iteration's actions, the same in every time step.
#[derive(Clone, Debug, PartialEq)]
pub enum ActionInitial {
    /// Uniform in the action box, or in the part of it given by `low` and `high`, each `[A]`.
    /// The reference code's maze draws `x >= 0` only: a hint that the goal is to the right.
    Uniform {
        /// Lower bounds, or the action box's.
        low: Option<Vec<f64>>,
        /// Upper bounds, or the action box's.
        high: Option<Vec<f64>>,
    },
    /// The same Gaussian in every dimension (the paper's has mean 0 and deviation 1).
    Normal {
        /// Mean, in units of the action.
        mean: f64,
        /// Standard deviation, in units of the action.
        std: f64,
    },
}

/// Settings of visual MPC.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct MpcConfig {
    /// Model steps that a plan looks ahead, `H`.
    pub horizon: usize,
    /// Model steps that one drawn action is held for; divides `horizon`.
    pub action_repeat: usize,
    /// First iteration's distribution where there is no warm start.
    pub initial: ActionInitial,
    /// Standard deviation around a warm start, in units of the action.
    pub warm_start_std: f64,
    /// Whether candidates drawn from a Gaussian (a refitted one, a normal first iteration, around
    /// a warm start) are clipped to the action box. The authors' released code never clips: its
    /// environment does, and its model sees actions as large as they are drawn.
    pub clip: bool,
    /// How fast the power of the noise of drawn actions falls with its frequency, over the time
    /// steps of a plan: 0 for white noise, 2 for iCEM's (Pinneri et al., 2020); see
    /// [`Coloured`].
    pub noise_beta: f64,
    /// Best candidates of the last iteration that a plan keeps; with a warm start they compete
    /// again in the next plan's first iteration, shifted by the step that was acted, in place of as
    /// many samples (iCEM's shifted elites).
    pub shift_elites: usize,
    /// Budget (`D`, `D*`, iterations).
    pub cem: CemConfig,
}

/// Most actions of a candidate whose noise is coloured: each draw takes their square.
const MAX_COLOURED: usize = 256;

impl Default for MpcConfig {
    /// The paper's maze: five steps ahead, first iteration uniform over the action box.
    fn default() -> Self {
        Self {
            horizon: 5,
            action_repeat: 1,
            initial: ActionInitial::Uniform { low: None, high: None },
            warm_start_std: 1.0,
            clip: true,
            noise_beta: 0.0,
            shift_elites: 0,
            cem: CemConfig::default(),
        }
    }
}

impl MpcConfig {
    /// Checks the ranges of all fields that do not depend on the world.
    ///
    /// # Errors
    /// Names the field that is out of range.
    pub fn validate(&self) -> Result<()> {
        self.cem.validate()?;
        if self.horizon == 0 {
            return Err(Error::invalid("horizon", "must be at least 1, got 0"));
        }
        if !self.horizon.is_multiple_of(self.action_repeat) {
            return Err(Error::invalid(
                "action_repeat",
                format!("must divide horizon ({}), got {}", self.horizon, self.action_repeat),
            ));
        }
        if !is_deviation(self.warm_start_std) {
            return Err(Error::invalid(
                "warm_start_std",
                format!("must be finite and positive, got {}", self.warm_start_std),
            ));
        }
        if !(self.noise_beta >= 0.0 && self.noise_beta.is_finite()) {
            return Err(Error::invalid(
                "noise_beta",
                format!("must be finite and not negative, got {}", self.noise_beta),
            ));
        }
        if self.noise_beta > 0.0 && self.decisions() > MAX_COLOURED {
            return Err(Error::invalid(
                "noise_beta",
                format!(
                    "is for at most {MAX_COLOURED} actions, and a plan has {}",
                    self.decisions()
                ),
            ));
        }
        if self.noise_beta > 0.0 && self.cem.covariance != Covariance::Diagonal {
            return Err(Error::invalid(
                "noise_beta",
                format!("must be 0 with covariance 'full', got {}", self.noise_beta),
            ));
        }
        if self.shift_elites > self.cem.elites {
            return Err(Error::invalid(
                "shift_elites",
                format!("must be at most elites ({}), got {}", self.cem.elites, self.shift_elites),
            ));
        }
        if let ActionInitial::Normal { mean, std } = self.initial {
            if !(mean as f32).is_finite() {
                return Err(Error::invalid("initial_mean", format!("must be finite, got {mean}")));
            }
            if !is_deviation(std) {
                return Err(Error::invalid(
                    "initial_std",
                    format!("must be finite and positive, got {std}"),
                ));
            }
        }
        Ok(())
    }

    /// The best actions found from `start[1]` to `goal[1]`: [`plan`](super::plan) of one problem,
    /// from no earlier plan and with nobody watching.
    ///
    /// # Errors
    /// As [`plan`](super::plan), and frames that are not single.
    pub fn plan<W: WorldModel>(
        &self,
        world: &W,
        start: &W::Frames,
        goal: &W::Frames,
        seed: u64,
    ) -> Result<Plan> {
        check_single(start, goal)?;
        let stream = Stream { seed, purpose: Purpose::Actions, problem: 0 };
        plan_one(self, world, [start, goal], stream, &|_| "the plan".into(), &|| Ok(()))
    }

    /// Actions drawn per candidate.
    pub(super) fn decisions(&self) -> usize {
        self.horizon / self.action_repeat
    }

    /// The first iteration's distribution for every dimension of a candidate.
    pub(super) fn initial_in(&self, space: &ActionSpace) -> Result<Initial> {
        let (low, high) = match &self.initial {
            ActionInitial::Normal { mean, std } => {
                let dimensions = self.decisions() * space.dim();
                return Ok(Initial::Normal {
                    mean: vec![*mean as f32; dimensions],
                    std: vec![*std as f32; dimensions],
                });
            }
            ActionInitial::Uniform { low, high } => {
                (corner(low.as_deref(), space.low()), corner(high.as_deref(), space.high()))
            }
        };
        for (argument, corner) in [("initial_low", &low), ("initial_high", &high)] {
            if corner.len() != space.dim() {
                return Err(Error::invalid(
                    argument,
                    format!("must have {} action dimensions, got {}", space.dim(), corner.len()),
                ));
            }
        }
        for dimension in 0..space.dim() {
            let (low, high) = (low[dimension], high[dimension]);
            let (least, most) = (space.low()[dimension], space.high()[dimension]);
            if !(least <= low && low <= high && high <= most) {
                return Err(Error::invalid(
                    "initial_low",
                    format!(
                        "initial_low <= initial_high must lie within [{least}, {most}] in \
                         dimension {dimension}, got [{low}, {high}]"
                    ),
                ));
            }
        }
        let decisions = self.decisions();
        Ok(Initial::Uniform { low: low.repeat(decisions), high: high.repeat(decisions) })
    }

    /// A Gaussian around the last plan, `[H, A]`, shifted by the step that was acted.
    pub(super) fn initial_around(&self, plan: ArrayView2<'_, f32>, space: &ActionSpace) -> Initial {
        let mean = self.shifted(plan, space);
        let std = vec![self.warm_start_std as f32; mean.len()];
        Initial::Normal { mean, std }
    }

    /// The candidate of an action sequence, `[H, A]`, shifted by the step that was acted: its last
    /// action is repeated, and steps held together are averaged.
    pub(super) fn shifted(&self, plan: ArrayView2<'_, f32>, space: &ActionSpace) -> Vec<f32> {
        let mut candidate = Vec::with_capacity(self.decisions() * space.dim());
        for decision in 0..self.decisions() {
            for dimension in 0..space.dim() {
                let held = (0..self.action_repeat).map(|step| {
                    let shifted = decision * self.action_repeat + step + 1;
                    plan[[shifted.min(self.horizon - 1), dimension]]
                });
                let average = held.sum::<f32>() / self.action_repeat as f32;
                let (low, high) = (space.low()[dimension], space.high()[dimension]);
                candidate.push(if self.clip { average.clamp(low, high) } else { average });
            }
        }
        candidate
    }

    /// What candidates are clipped to, and what colour their noise has.
    pub(super) fn space(&self, space: &ActionSpace) -> Space {
        let decisions = self.decisions();
        let bounds = match self.clip {
            true => {
                Bounds { low: space.low().repeat(decisions), high: space.high().repeat(decisions) }
            }
            false => Bounds::unbounded(decisions * space.dim()),
        };
        let coloured = || Coloured::new(self.noise_beta, decisions, space.dim());
        Space { bounds, noise: (self.noise_beta > 0.0).then(coloured) }
    }
}

/// Whether a number is a standard deviation in the precision that candidates are drawn with, and
/// no candidate drawn with it is infinite.
fn is_deviation(std: f64) -> bool {
    let narrow = std as f32;
    narrow > 0.0 && (narrow * LONGEST_NORMAL).is_finite()
}
/// A corner of the initial box, or of the action box where it is not given.
fn corner(given: Option<&[f64]>, action_box: &[f32]) -> Vec<f32> {
    given.map_or_else(|| action_box.to_vec(), |g| g.iter().map(|&value| value as f32).collect())
}
