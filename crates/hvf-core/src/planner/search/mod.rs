//! The search for subgoal images (paper, section 4 and algorithm 2): the cross-entropy method
//! over `K` latents, where a sample costs what the hardest of its `K + 1` segments costs to plan
//! (or what another [`Reduction`] makes of them). The latents are drawn from their prior at first,
//! or from what the generator proposes.
//!
//! Savings change nothing but the time:
//!
//! 1. All first segments start from `s0`, so their first iteration's rollouts are shared (where the
//!    world model can score one set of rollouts against many goals).
//! 2. With [`Reduction::Max`], what cannot change the elites is not planned (`pruning`).
//! 3. Several searches go on side by side ([`search_batch`]), so that a model gets fewer, larger
//!    calls.

mod config;
mod likelihood;
mod proposals;
mod pruning;
mod samples;
mod segments;
mod watch;

use ndarray::{Array2, Array3, ArrayView2, Axis};

use super::cem::distribution::{Bounds, Space};
use super::cem::{minimise, IterationStats, Solution};
use super::model::{Frames, SubgoalModel, WorldModel};
use super::mpc::{check_single, plan_one, Interrupt, Plan};
use super::sampler::{Purpose, Stream, MAX_DIMENSIONS};
use crate::{Error, Result};
use likelihood::Likelihoods;
use proposals::starts;
use samples::Samples;
use segments::{Planner, Segments, Ways};

pub use config::{HvfConfig, Reduction, SegmentCost};
pub use watch::{Progress, Watch};

/// How the search stood after one iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct SearchStats {
    /// Costs over the samples; the population is those that were completed.
    pub costs: IterationStats,
    /// Planning problems (segments) that were solved, or worked on until it was clear that they are
    /// not their sample's hardest.
    pub evaluated: usize,
    /// Planning problems that pruning left out.
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
    let ends = [Ends { start: start.clone(), goal: goal.clone(), seed }];
    let found = side_by_side(config, world, generator, &ends, watch)?;
    Ok(found.into_iter().next().expect("one search, one result"))
}

/// A search for each of `B` pairs: `starts` (`[B]`, or `[1]` for all), `goals[B]` and `seeds[B]`.
/// What each finds is what [`search`] finds alone. They go on side by side, and where their frames
/// can be [joined](Frames::join), the segments of all of them are planned in the same calls.
///
/// # Errors
/// As [`search`], and lengths that disagree; the first error ends all.
pub fn search_batch<W, G>(
    config: &HvfConfig,
    world: &W,
    generator: &G,
    [starts, goals]: [&W::Frames; 2],
    seeds: &[u64],
    watch: Watch<'_, W::Frames>,
) -> Result<Vec<SearchResult<W::Frames>>>
where
    W: WorldModel,
    G: SubgoalModel<W::Frames>,
{
    config.validate()?;
    let count = goals.len();
    for (argument, found) in [("seeds", seeds.len()), ("starts", starts.len())] {
        if found != count && (argument, found) != ("starts", 1) {
            return Err(Error::invalid(
                argument,
                format!("must be as many as goals ({count}), got {found}"),
            ));
        }
    }
    let pair = |(episode, &seed): (usize, &u64)| {
        let start = starts.select(&[if starts.len() == 1 { 0 } else { episode }])?;
        Ok(Ends { start, goal: goals.select(&[episode])?, seed })
    };
    let ends: Vec<Ends<W::Frames>> = seeds.iter().enumerate().map(pair).collect::<Result<_>>()?;
    side_by_side(config, world, generator, &ends, watch)
}

/// What one search lies between, and its seed.
struct Ends<F> {
    start: F,
    goal: F,
    seed: u64,
}

/// Searches, each between two frames.
fn side_by_side<W, G>(
    config: &HvfConfig,
    world: &W,
    generator: &G,
    ends: &[Ends<W::Frames>],
    watch: Watch<'_, W::Frames>,
) -> Result<Vec<SearchResult<W::Frames>>>
where
    W: WorldModel,
    G: SubgoalModel<W::Frames>,
{
    if ends.is_empty() {
        return Ok(Vec::new());
    }
    if config.subgoals == 0 {
        let one = |ends| plan_directly(config, world, ends, watch.interrupt);
        return ends.iter().map(one).collect();
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
    let starts = starts(generator, ends, (config.subgoals, latent_dim))?;
    let stream = |ends: &Ends<_>| Stream { seed: ends.seed, purpose: Purpose::Latents, problem: 0 };
    let streams: Vec<Stream> = ends.iter().map(stream).collect();
    let space = Space::from(Bounds::unbounded(dimensions));
    let partially = |found: Option<Vec<SearchResult<W::Frames>>>| {
        found.into_iter().flatten().for_each(watch.partial);
    };
    match config.segment_cost {
        SegmentCost::Planned => {
            let mut samples = Samples::new(config, world, generator, ends, watch);
            let outcome = minimise(&config.cem, &space, &starts, &streams, &mut samples);
            let found = samples.found();
            match outcome {
                Ok(_) => Ok(found.expect("an iteration was finished")),
                Err(error) => {
                    partially(found);
                    Err(error)
                }
            }
        }
        SegmentCost::Likelihood => {
            let mut samples = Likelihoods::new(config, generator, ends, watch);
            let outcome = minimise(&config.cem, &space, &starts, &streams, &mut samples);
            let found = samples.found();
            if let Err(error) = outcome {
                partially(found.unwrap_or(None));
                return Err(error);
            }
            let mut found = found?.expect("an iteration was finished");
            match plan_along(config, world, ends, &found, watch.interrupt) {
                Ok(plans) => {
                    let mut plans = plans.into_iter();
                    for result in &mut found {
                        result.plans = plans.by_ref().take(config.subgoals + 1).collect();
                    }
                    Ok(found)
                }
                Err(error) => {
                    partially(Some(found));
                    Err(error)
                }
            }
        }
    }
}

/// The latents of a candidate, `[K, L]`.
fn latents_of(solution: &Solution, subgoals: usize) -> Array2<f32> {
    let candidate = solution.candidate.clone();
    Array2::from_shape_vec((subgoals, candidate.len() / subgoals), candidate)
        .expect("a candidate has K x L values")
}

/// The latents of the samples of one search, `[M, K, L]`, from candidates `[M, K * L]`.
fn latents_in(candidates: ArrayView2<'_, f32>, subgoals: usize, dim: usize) -> Array3<f32> {
    let shape = (candidates.nrows(), subgoals, dim);
    candidates.to_shape(shape).expect("a candidate has K x L values").into_owned()
}

/// No subgoals: one segment from start to goal.
fn plan_directly<W: WorldModel>(
    config: &HvfConfig,
    world: &W,
    Ends { start, goal, seed }: &Ends<W::Frames>,
    interrupt: Interrupt<'_>,
) -> Result<SearchResult<W::Frames>> {
    let stream = Stream { seed: *seed, purpose: Purpose::Actions, problem: 0 };
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

/// Plans all segments along what was found, way after way.
fn plan_along<W: WorldModel>(
    config: &HvfConfig,
    world: &W,
    ends: &[Ends<W::Frames>],
    found: &[SearchResult<W::Frames>],
    interrupt: Interrupt<'_>,
) -> Result<Vec<Plan>> {
    let ways: Vec<Ways<'_, W::Frames>> = ends
        .iter()
        .zip(found)
        .map(|(Ends { start, goal, seed }, found)| {
            let subgoals = found.subgoals.clone();
            Ways { start, goal, subgoals, seed: *seed }
        })
        .collect();
    let describe = |number: usize| format!("segment {}", number % (config.subgoals + 1));
    let share_rollouts = config.share_rollouts;
    let planner = Planner { mpc: &config.mpc, world, share_rollouts, interrupt };
    let segments = Segments::new(planner, &ways, config.subgoals, 0, &describe)?;
    segments.plan_all()
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
