//! The search for subgoal images (paper, section 4 and algorithm 2): the cross-entropy method
//! over `K` latents, where a sample costs what the hardest of its `K + 1` segments costs to plan.
//!
//! Two savings change nothing but the time:
//!
//! 1. All samples' first segments start from `s0`, so their first iteration's rollouts are shared
//!    (where the world model can score one set of rollouts against many goals).
//! 2. With the maximum over segments, a sample costs at least as much as its worst segment so
//!    far. After the first segment of all samples, they are completed in ascending order of that
//!    bound, in chunks, and dropped once it exceeds the `M*`-th best complete sample: they could
//!    not have become elites.

mod config;
mod likelihood;
mod samples;
mod watch;

use ndarray::{Array2, Array3, Axis};

use super::cem::distribution::{Bounds, Initial, Space, Start};
use super::cem::{minimise, IterationStats, Solution};
use super::model::{Frames, SubgoalModel, WorldModel};
use super::mpc::{check_single, plan_one, Interrupt, Plan};
use super::sampler::{Purpose, Stream, MAX_DIMENSIONS};
use crate::{Error, Result};
use likelihood::Likelihoods;
use samples::Samples;

pub use config::{HvfConfig, Reduction, SegmentCost};
pub use watch::{Progress, Watch};

/// How the search stood after one iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct SearchStats {
    /// Costs over the samples; the population is those that were completed.
    pub costs: IterationStats,
    /// Planning problems solved.
    pub evaluated: usize,
    /// Planning problems that pruning made unnecessary.
    pub skipped: usize,
}

/// What the search found.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct SearchResult<F> {
    /// Subgoals in the order to reach them, `[K]`.
    pub subgoals: F,
    /// Their latents, `[K, L]`.
    pub latents: Array2<f32>,
    /// Cost of the segments together.
    pub cost: f32,
    /// Best plan of every segment, `[K + 1]`, with its cost.
    pub plans: Vec<Plan>,
    /// One entry per iteration that was run; empty for `K = 0`.
    pub history: Vec<SearchStats>,
}

/// Searches for `K` subgoals between `start[1]` and `goal[1]`.
///
/// # Errors
/// A setting out of range, frames that are not single, an error of one of the models, a
/// generator that gives another number of frames, or an error of who watches. What was found
/// until then goes to [`Watch::partial`].
pub fn search<W, G>(
    config: &HvfConfig,
    world: &W,
    generator: &G,
    start: &W::Frames,
    goal: &W::Frames,
    seed: u64,
    watch: Watch<'_, W::Frames>,
) -> Result<SearchResult<W::Frames>>
where
    W: WorldModel,
    G: SubgoalModel<W::Frames>,
{
    config.validate()?;
    check_single(start, goal)?;
    if config.subgoals == 0 {
        return plan_directly(config, world, start, goal, seed, watch.interrupt);
    }
    let latent_dim = generator.latent_dim();
    let dimensions = config.subgoals.saturating_mul(latent_dim);
    if latent_dim == 0 {
        return Err(Error::Model("latent_dim must be at least 1, got 0".into()));
    }
    if dimensions > MAX_DIMENSIONS {
        return Err(Error::invalid(
            "subgoals",
            format!("must be at most {}, got {}", MAX_DIMENSIONS / latent_dim, config.subgoals),
        ));
    }
    let prior = Initial::Normal { mean: vec![0.0; dimensions], std: vec![1.0; dimensions] };
    let prior = [Start::from(prior)];
    let streams = [Stream { seed, purpose: Purpose::Latents, problem: 0 }];
    let space = Space::from(Bounds::unbounded(dimensions));
    if config.segment_cost == SegmentCost::Likelihood {
        let mut samples =
            Likelihoods { generator, start, goal, config, latent_dim, watch, latest: None };
        let outcome = minimise(&config.cem, &space, &prior, &streams, &mut samples);
        let latest = samples.latest.take().map(|solution| samples.found(&solution));
        if let Err(error) = outcome {
            if let Some(Ok(partial)) = latest {
                (watch.partial)(partial);
            }
            return Err(error);
        }
        let mut found = latest.expect("an iteration was finished")?;
        let ends = [start, &found.subgoals, goal];
        match plan_along(config, world, ends, seed, watch.interrupt) {
            Ok(plans) => found.plans = plans,
            Err(error) => {
                (watch.partial)(found);
                return Err(error);
            }
        }
        return Ok(found);
    }
    let mut samples = Samples {
        config,
        world,
        generator,
        start,
        goal,
        seed,
        watch,
        latent_dim,
        latest: None,
        best: None,
        counts: Vec::new(),
    };
    let outcome = minimise(&config.cem, &space, &prior, &streams, &mut samples);
    let latest = samples.latest.take().map(|solution| samples.found(&solution));
    match outcome {
        Ok(_) => Ok(latest.expect("an iteration was finished")),
        Err(error) => {
            latest.map(watch.partial);
            Err(error)
        }
    }
}

/// The latents of a candidate, `[K, L]`.
fn latents_of(solution: &Solution, subgoals: usize) -> Array2<f32> {
    let candidate = solution.candidate.clone();
    Array2::from_shape_vec((subgoals, candidate.len() / subgoals), candidate)
        .expect("a candidate has K x L values")
}

/// No subgoals: one segment from start to goal.
fn plan_directly<W: WorldModel>(
    config: &HvfConfig,
    world: &W,
    start: &W::Frames,
    goal: &W::Frames,
    seed: u64,
    interrupt: Interrupt<'_>,
) -> Result<SearchResult<W::Frames>> {
    let stream = Stream { seed, purpose: Purpose::Actions, problem: 0 };
    let describe = |_| "the plan to the goal".into();
    let plan = plan_one(&config.mpc, world, [start, goal], stream, &describe, interrupt)?;
    Ok(SearchResult {
        subgoals: goal.select(&[])?,
        latents: Array2::zeros((0, 0)),
        cost: plan.cost,
        plans: vec![plan],
        history: Vec::new(),
    })
}

/// Plans the segments of one way: from `start[1]` over `subgoals[K]` to `goal[1]`.
fn plan_along<W: WorldModel>(
    config: &HvfConfig,
    world: &W,
    [start, subgoals, goal]: [&W::Frames; 3],
    seed: u64,
    interrupt: Interrupt<'_>,
) -> Result<Vec<Plan>> {
    let (count, mut plans) = (subgoals.len(), Vec::new());
    for segment in 0..=count {
        let from = match segment {
            0 => start.clone(),
            _ => subgoals.select(&[segment - 1])?,
        };
        let to = if segment == count { goal.clone() } else { subgoals.select(&[segment])? };
        let stream = segment_stream(seed, 0, 0, segment);
        let describe = |_| format!("segment {segment}");
        plans.push(plan_one(&config.mpc, world, [&from, &to], stream, &describe, interrupt)?);
    }
    Ok(plans)
}

/// What a generator draws for `latents[M, K, L]`: `M * K` frames, or an error.
pub(super) fn decoded<F: Frames, G: SubgoalModel<F>>(
    generator: &G,
    scene: &F,
    latents: Array3<f32>,
) -> Result<F> {
    let expected = latents.len_of(Axis(0)) * latents.len_of(Axis(1));
    let drawn = generator.decode(scene, latents)?;
    match drawn.len() {
        got if got != expected => {
            Err(Error::Model(format!("decode must give {expected} frames, got {got}")))
        }
        _ => Ok(drawn),
    }
}

/// The stream of one segment's planning problem: 16 bits of iteration, 32 of sample, 16 of
/// segment, so that it does not depend on which other problems are solved.
fn segment_stream(seed: u64, iteration: usize, sample: usize, segment: usize) -> Stream {
    let problem = (iteration as u64) << 48 | (sample as u64) << 16 | segment as u64;
    Stream { seed, purpose: Purpose::Actions, problem }
}
#[cfg(test)]
mod tests;
