//! Visual model-predictive control: the cross-entropy method over actions, with a world model's
//! predicted distance to the goal image as cost (paper, section 3 and algorithm 1).

use ndarray::{Array2, ArrayView2, ArrayView3};

use super::cem::{minimise, CemConfig, IterationStats, MAX_VALUES};
use super::distribution::{Bounds, Initial};
use super::model::{ActionSpace, Frames, WorldModel};
use super::rollouts::{hold, Rollouts};
use super::sampler::{Stream, LONGEST_NORMAL, MAX_DIMENSIONS};
use crate::{Error, Result};

/// Asked between two calls of a model whether to go on; its error ends the planning.
pub type Interrupt<'a> = &'a dyn Fn() -> Result<()>;

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
    /// Budget (`D`, `D*`, iterations).
    pub cem: CemConfig,
}

impl Default for MpcConfig {
    /// The paper's maze: five steps ahead, first iteration uniform over the action box.
    fn default() -> Self {
        Self {
            horizon: 5,
            action_repeat: 1,
            initial: ActionInitial::Uniform { low: None, high: None },
            warm_start_std: 1.0,
            clip: true,
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

    /// Actions drawn per candidate.
    fn decisions(&self) -> usize {
        self.horizon / self.action_repeat
    }

    /// The first iteration's distribution for every dimension of a candidate.
    fn initial_in(&self, space: &ActionSpace) -> Result<Initial> {
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

    /// A Gaussian around the last plan, `[H, A]`, shifted by the step that was acted: its last
    /// action is repeated, and steps held together are averaged.
    fn initial_around(&self, plan: ArrayView2<'_, f32>, space: &ActionSpace) -> Initial {
        let mut mean = Vec::with_capacity(self.decisions() * space.dim());
        for decision in 0..self.decisions() {
            for dimension in 0..space.dim() {
                let held = (0..self.action_repeat).map(|step| {
                    let shifted = decision * self.action_repeat + step + 1;
                    plan[[shifted.min(self.horizon - 1), dimension]]
                });
                let average = held.sum::<f32>() / self.action_repeat as f32;
                let (low, high) = (space.low()[dimension], space.high()[dimension]);
                mean.push(if self.clip { average.clamp(low, high) } else { average });
            }
        }
        let std = vec![self.warm_start_std as f32; mean.len()];
        Initial::Normal { mean, std }
    }

    /// What candidates are clipped to.
    fn bounds(&self, space: &ActionSpace) -> Bounds {
        let decisions = self.decisions();
        if !self.clip {
            return Bounds::unbounded(decisions * space.dim());
        }
        Bounds { low: space.low().repeat(decisions), high: space.high().repeat(decisions) }
    }
}

/// Whether a number is a standard deviation in the precision that candidates are drawn with, and
/// no candidate drawn with it is infinite.
fn is_deviation(std: f64) -> bool {
    let narrow = std as f32;
    narrow > 0.0 && (narrow * LONGEST_NORMAL).is_finite()
}

/// `B` planning problems.
pub struct Problems<'a, F> {
    /// Where each starts, `[B]`, or one frame for all.
    pub starts: &'a F,
    /// What each should reach, `[B]`.
    pub goals: &'a F,
    /// Random numbers of each, `[B]`.
    pub streams: &'a [Stream],
    /// Plans to start from, `[B, H, A]`, as they were before the step that has been acted since.
    pub warm_start: Option<ArrayView3<'a, f32>>,
    /// Whether problems with one start and one seed may share their first iteration's rollouts.
    pub share_rollouts: bool,
    /// What to call a problem in an error.
    pub describe: &'a dyn Fn(usize) -> String,
}

/// The best actions found for one problem.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// Actions, `[H, A]`.
    pub actions: Array2<f32>,
    /// Predicted cost of these actions.
    pub cost: f32,
    /// One entry per iteration that was run.
    pub history: Vec<IterationStats>,
}

/// Plans for every problem: the candidate with the lowest predicted cost of all iterations, or of
/// the last one ([`CemConfig::best`]).
///
/// # Errors
/// A setting out of range, batches of different sizes, an error of the model, batches of other
/// sizes out of its [`prepare`](WorldModel::prepare), a problem whose costs are all NaN, or the
/// error that `interrupt` gives.
pub fn plan<W: WorldModel>(
    config: &MpcConfig,
    world: &W,
    problems: &Problems<'_, W::Frames>,
    interrupt: Interrupt<'_>,
) -> Result<Vec<Plan>> {
    config.validate()?;
    let space = world.action_space();
    check_problems(config, space, problems)?;
    let initial = match problems.warm_start {
        None => vec![config.initial_in(space)?],
        Some(plans) => plans.outer_iter().map(|plan| config.initial_around(plan, space)).collect(),
    };
    let bounds = config.bounds(space);
    let prepared = prepared(world, problems)?;
    let (starts, goals) = match &prepared {
        Some((starts, goals)) => (starts, goals),
        None => (problems.starts, problems.goals),
    };
    let mut objective =
        Rollouts { config, world, problems: Problems { starts, goals, ..*problems }, interrupt };
    let solutions = minimise(&config.cem, &bounds, &initial, problems.streams, &mut objective)?;
    Ok(solutions
        .into_iter()
        .map(|solution| Plan {
            actions: Array2::from_shape_vec(
                (config.horizon, space.dim()),
                hold(solution.candidate, space.dim(), config.action_repeat),
            )
            .expect("a candidate holds horizon / action_repeat actions"),
            cost: solution.cost,
            history: solution.history,
        })
        .collect())
}

/// What the model made of starts and goals, if anything.
fn prepared<W: WorldModel>(
    world: &W,
    problems: &Problems<'_, W::Frames>,
) -> Result<Option<(W::Frames, W::Frames)>> {
    let prepared = world.prepare(problems.starts, problems.goals)?;
    if let Some((starts, goals)) = &prepared {
        let expected = (problems.starts.len(), problems.goals.len());
        let got = (starts.len(), goals.len());
        if got != expected {
            return Err(Error::Model(format!(
                "prepare must give as many frames as it got, {} starts and {} goals, got {} and {}",
                expected.0, expected.1, got.0, got.1
            )));
        }
    }
    Ok(prepared)
}

/// A corner of the initial box, or of the action box where it is not given.
fn corner(given: Option<&[f64]>, action_box: &[f32]) -> Vec<f32> {
    given.map_or_else(|| action_box.to_vec(), |g| g.iter().map(|&value| value as f32).collect())
}

fn check_problems<F: Frames>(
    config: &MpcConfig,
    space: &ActionSpace,
    problems: &Problems<'_, F>,
) -> Result<()> {
    let count = problems.goals.len();
    if count == 0 {
        return Err(Error::invalid("goals", "must hold at least one frame"));
    }
    if problems.starts.len() != count && problems.starts.len() != 1 {
        return Err(Error::invalid(
            "starts",
            format!(
                "must hold one frame or as many as goals ({count}), got {}",
                problems.starts.len()
            ),
        ));
    }
    if problems.streams.len() != count {
        return Err(Error::invalid(
            "seeds",
            format!("must be as many as goals ({count}), got {}", problems.streams.len()),
        ));
    }
    if config.decisions() * space.dim() > MAX_DIMENSIONS {
        let most = MAX_DIMENSIONS / space.dim();
        return Err(Error::invalid(
            "horizon",
            format!("must be at most {most} actions, got {}", config.decisions()),
        ));
    }
    let values = config.horizon.saturating_mul(space.dim()).saturating_mul(config.cem.samples);
    if values > MAX_VALUES {
        return Err(Error::invalid(
            "samples",
            format!(
                "samples x horizon x action dimensions must be at most {MAX_VALUES}, got {} x {} x {}",
                config.cem.samples,
                config.horizon,
                space.dim()
            ),
        ));
    }
    if let Some(plans) = problems.warm_start {
        let expected = (count, config.horizon, space.dim());
        if plans.dim() != expected {
            return Err(Error::invalid(
                "warm_start",
                format!("must have shape {expected:?}, got {:?}", plans.dim()),
            ));
        }
        if plans.iter().any(|value| !value.is_finite()) {
            return Err(Error::invalid("warm_start", "must be finite"));
        }
    }
    Ok(())
}

#[cfg(test)]
#[path = "mpc_tests.rs"]
mod tests;
