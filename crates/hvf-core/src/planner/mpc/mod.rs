//! Visual model-predictive control: the cross-entropy method over actions, with a world model's
//! predicted distance to the goal image as cost (paper, section 3 and algorithm 1).

mod config;
mod problems;
mod rollouts;

use ndarray::{Array2, Array3, ArrayView3};

use super::cem::distribution::{Initial, Start};
use super::cem::{minimise, CemConfig, IterationStats, Solution};
use super::model::{ActionSpace, Frames, WorldModel};
use super::sampler::Stream;
use crate::{Error, Result};
use problems::check_problems;
pub(super) use problems::check_single;
use rollouts::{hold, Lenient, Rollouts};

pub use config::{ActionInitial, MpcConfig};
pub use problems::{Problems, WarmStart};

/// Asked between two calls of a model whether to go on; its error ends the planning.
pub type Interrupt<'a> = &'a dyn Fn() -> Result<()>;
/// The best actions found for one problem.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Plan {
    /// Actions, `[H, A]`.
    pub actions: Array2<f32>,
    /// Predicted cost of these actions.
    pub cost: f32,
    /// The best candidates of the last iteration, best first, `[S, H, A]` for
    /// [`MpcConfig::shift_elites`] of `S`; the last one stands again for those that cost NaN.
    pub elites: Array3<f32>,
    /// One entry per iteration that was run.
    pub history: Vec<IterationStats>,
}
/// Plans for every problem: the candidate with the lowest predicted cost of all iterations, or of
/// the last one ([`CemConfig::best`](super::CemConfig::best)).
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
    check_problems(config, world.action_space(), problems)?;
    let prepared = prepared(world, problems.starts, problems.goals)?;
    let (starts, goals) = match &prepared {
        Some((starts, goals)) => (starts, goals),
        None => (problems.starts, problems.goals),
    };
    solve(config, world, &Problems { starts, goals, ..*problems }, None, interrupt)
}

/// [`plan`] of frames that are [`prepared`]. Where a cost is `enough` for problem `b`, its search
/// ends with the first iteration that has found as much.
///
/// # Errors
/// As [`plan`].
pub(super) fn solve<W: WorldModel>(
    config: &MpcConfig,
    world: &W,
    problems: &Problems<'_, W::Frames>,
    enough: Option<&[f32]>,
    interrupt: Interrupt<'_>,
) -> Result<Vec<Plan>> {
    let space = world.action_space();
    check_problems(config, space, problems)?;
    let starts = starts(config, space, problems.warm_start)?;
    // Where the searches begin is settled.
    let problems = Problems { warm_start: None, ..*problems };
    let streams = problems.streams;
    let mut objective = Rollouts { config, world, problems, enough, interrupt };
    let solutions = minimise(&config.cem, &config.space(space), &starts, streams, &mut objective)?;
    Ok(solutions.into_iter().map(|solution| found(config, space.dim(), solution)).collect())
}

/// The least cost among the first few candidates of each problem of [`prepared`] frames: a guess,
/// at a small share of a plan's time, of how hard it is. Infinite where all of them cost NaN.
///
/// # Errors
/// As [`plan`].
pub(super) fn probe<W: WorldModel>(
    config: &MpcConfig,
    world: &W,
    problems: &Problems<'_, W::Frames>,
    interrupt: Interrupt<'_>,
) -> Result<Vec<f32>> {
    let samples = (config.cem.samples / CANDIDATES_PER_PROBE).clamp(1, MOST_PROBES);
    let cem = CemConfig { samples, elites: 1, iterations: 1, keep_elites: 0, ..config.cem.clone() };
    let config = MpcConfig { cem, shift_elites: 0, ..config.clone() };
    let space = world.action_space();
    check_problems(&config, space, problems)?;
    let starts = [config.initial_in(space)?.into()];
    let (streams, problems) = (problems.streams, Problems { ..*problems });
    let rollouts = Rollouts { config: &config, world, problems, enough: None, interrupt };
    let solutions =
        minimise(&config.cem, &config.space(space), &starts, streams, &mut Lenient(rollouts))?;
    Ok(solutions.into_iter().map(|solution| solution.cost).collect())
}

/// A probe takes one candidate for so many of a plan's iteration,
const CANDIDATES_PER_PROBE: usize = 16;
/// but not more than these: the search for subgoals in the maze does as well with 8 as with 32.
const MOST_PROBES: usize = 8;

/// Where the searches begin: one for all, or around each problem's last plan.
fn starts(
    config: &MpcConfig,
    space: &ActionSpace,
    warm_start: Option<WarmStart<'_>>,
) -> Result<Vec<Start>> {
    let Some(WarmStart { actions, elites }) = warm_start else {
        return Ok(vec![config.initial_in(space)?.into()]);
    };
    let initial = actions.outer_iter().map(|plan| config.initial_around(plan, space));
    let Some(elites) = elites else {
        return Ok(initial.map(Start::from).collect());
    };
    let shifted = |(initial, elites): (Initial, ArrayView3<'_, f32>)| Start {
        initial,
        candidates: elites.outer_iter().flat_map(|elite| config.shifted(elite, space)).collect(),
    };
    Ok(initial.zip(elites.outer_iter()).map(shifted).collect())
}

/// A candidate as actions of every step, with its cost.
fn found(config: &MpcConfig, dim: usize, mut solution: Solution) -> Plan {
    let values = solution.candidate.len();
    let last = solution.elites[solution.elites.len() - values..].to_vec();
    solution.elites.truncate(config.shift_elites * values);
    while solution.elites.len() < config.shift_elites * values {
        solution.elites.extend_from_slice(&last);
    }
    let shape = (config.horizon, dim);
    let held = |candidates| hold(candidates, dim, config.action_repeat);
    Plan {
        actions: Array2::from_shape_vec(shape, held(solution.candidate))
            .expect("a candidate holds horizon / action_repeat actions"),
        cost: solution.cost,
        elites: Array3::from_shape_vec(
            (config.shift_elites, shape.0, shape.1),
            held(solution.elites),
        )
        .expect("as many candidates as were asked for"),
        history: solution.history,
    }
}

/// [`plan`] of one problem, from `start[1]` to `goal[1]` and from no earlier plan.
pub(super) fn plan_one<W: WorldModel>(
    config: &MpcConfig,
    world: &W,
    [start, goal]: [&W::Frames; 2],
    stream: Stream,
    describe: &dyn Fn(usize) -> String,
    interrupt: Interrupt<'_>,
) -> Result<Plan> {
    let problems = Problems {
        starts: start,
        goals: goal,
        streams: &[stream],
        warm_start: None,
        share_rollouts: false,
        describe,
    };
    let plans = plan(config, world, &problems, interrupt)?;
    Ok(plans.into_iter().next().expect("one problem, one plan"))
}

/// What the model made of starts and goals, if anything.
pub(super) fn prepared<W: WorldModel>(
    world: &W,
    starts: &W::Frames,
    goals: &W::Frames,
) -> Result<Option<(W::Frames, W::Frames)>> {
    let expected = (starts.len(), goals.len());
    let prepared = world.prepare(starts, goals)?;
    if let Some((starts, goals)) = &prepared {
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
