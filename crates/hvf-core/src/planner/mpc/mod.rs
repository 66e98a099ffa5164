//! Visual model-predictive control: the cross-entropy method over actions, with a world model's
//! predicted distance to the goal image as cost (paper, section 3 and algorithm 1).

mod config;
mod problems;
mod rollouts;

use ndarray::Array2;

use super::cem::{minimise, IterationStats};
use super::model::{Frames, WorldModel};
use crate::{Error, Result};
use problems::check_problems;
use rollouts::{hold, Rollouts};

pub use config::{ActionInitial, MpcConfig};
pub use problems::Problems;

/// Asked between two calls of a model whether to go on; its error ends the planning.
pub type Interrupt<'a> = &'a dyn Fn() -> Result<()>;
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
#[cfg(test)]
mod tests;
