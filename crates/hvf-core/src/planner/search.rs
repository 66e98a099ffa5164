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

use ndarray::{Array2, Array3, Axis};

use super::cem::{minimise, BestOf, Call, CemConfig, IterationStats, Objective};
use super::distribution::{Bounds, Initial};
use super::elites::elites;
use super::likelihood::Likelihoods;
use super::model::{Frames, SubgoalModel, WorldModel};
use super::mpc::{plan, Interrupt, MpcConfig, Plan, Problems};
use super::sampler::{Purpose, Stream, MAX_DIMENSIONS};
use crate::{Error, Result};

/// How the costs of the segments make the cost of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reduction {
    /// The hardest segment (paper, equation 4).
    Max,
    /// The mean segment.
    Mean,
}

impl Reduction {
    /// The cost of a sample from those of its segments; NaN if one is.
    pub(super) fn of(self, costs: impl ExactSizeIterator<Item = f32>) -> f32 {
        let count = costs.len() as f64;
        match self {
            Self::Max => costs.fold(f32::NEG_INFINITY, |most, cost| {
                if most.is_nan() || cost.is_nan() {
                    f32::NAN
                } else {
                    most.max(cost)
                }
            }),
            Self::Mean => (costs.map(f64::from).sum::<f64>() / count) as f32,
        }
    }
}

/// Who says what a segment costs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum SegmentCost {
    /// The planner: the predicted cost of its best plan (paper, equation 4).
    #[default]
    Planned,
    /// The generator, without a plan: how unlikely the segment is
    /// ([`SubgoalModel::segment_costs`]).
    Likelihood,
}

/// Settings of the search.
#[derive(Clone, Debug, PartialEq)]
pub struct HvfConfig {
    /// How a segment is planned.
    pub mpc: MpcConfig,
    /// Number of subgoals, `K`; 0 plans to the goal directly.
    pub subgoals: usize,
    /// Budget over latents (`M`, `M*`, iterations).
    pub cem: CemConfig,
    /// Cost of a sample from the costs of its segments.
    pub reduction: Reduction,
    /// Who says what a segment costs.
    pub segment_cost: SegmentCost,
    /// Drop samples that cannot become elites (only with [`Reduction::Max`]).
    pub prune: bool,
    /// Share the first iteration's rollouts of segments with one start.
    pub share_rollouts: bool,
}

impl Default for HvfConfig {
    /// The paper's maze with two subgoals; both savings on.
    fn default() -> Self {
        Self {
            mpc: MpcConfig::default(),
            subgoals: 2,
            cem: CemConfig::default(),
            reduction: Reduction::Max,
            segment_cost: SegmentCost::Planned,
            prune: true,
            share_rollouts: true,
        }
    }
}

impl HvfConfig {
    /// Checks the ranges of all fields that do not depend on the models.
    ///
    /// # Errors
    /// Names the field that is out of range.
    pub fn validate(&self) -> Result<()> {
        self.cem.validate()?;
        // The counters of a search keep 16 bits for the segment.
        if self.subgoals > usize::from(u16::MAX) {
            return Err(Error::invalid(
                "subgoals",
                format!("must be at most {}, got {}", u16::MAX, self.subgoals),
            ));
        }
        self.mpc.validate()
    }
}

/// How the search stood after one iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
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
/// generator that gives another number of frames, or the error that `interrupt` gives.
pub fn search<W, G>(
    config: &HvfConfig,
    world: &W,
    generator: &G,
    start: &W::Frames,
    goal: &W::Frames,
    seed: u64,
    interrupt: Interrupt<'_>,
) -> Result<SearchResult<W::Frames>>
where
    W: WorldModel,
    G: SubgoalModel<W::Frames>,
{
    config.validate()?;
    for (argument, frames) in [("start", start), ("goal", goal)] {
        if frames.len() != 1 {
            return Err(Error::invalid(
                argument,
                format!("must be one frame, got {}", frames.len()),
            ));
        }
    }
    if config.subgoals == 0 {
        return plan_directly(config, world, start, goal, seed, interrupt);
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
    let prior = [Initial::Normal { mean: vec![0.0; dimensions], std: vec![1.0; dimensions] }];
    let streams = [Stream { seed, purpose: Purpose::Latents, problem: 0 }];
    let bounds = Bounds::unbounded(dimensions);
    let latents_of = |candidate| {
        Array2::from_shape_vec((config.subgoals, latent_dim), candidate)
            .expect("a candidate has K x L values")
    };
    if config.segment_cost == SegmentCost::Likelihood {
        let mut samples = Likelihoods {
            generator,
            start,
            goal,
            subgoals: config.subgoals,
            latent_dim,
            reduction: config.reduction,
            interrupt,
        };
        let mut solutions = minimise(&config.cem, &bounds, &prior, &streams, &mut samples)?;
        let solution = solutions.pop().expect("one problem, one solution");
        let latents = latents_of(solution.candidate);
        let subgoals = decoded(generator, start, latents.clone().insert_axis(Axis(0)))?;
        let plans = plan_along(config, world, [start, &subgoals, goal], seed, interrupt)?;
        let none = |&costs| SearchStats { costs, evaluated: 0, skipped: 0 };
        let history = solution.history.iter().map(none).collect();
        return Ok(SearchResult { subgoals, latents, cost: solution.cost, plans, history });
    }
    let mut samples = Samples {
        config,
        world,
        generator,
        start,
        goal,
        seed,
        interrupt,
        latent_dim,
        best: None,
        counts: Vec::new(),
    };
    let mut solutions = minimise(&config.cem, &bounds, &prior, &streams, &mut samples)?;
    let solution = solutions.pop().expect("one problem, one solution");
    let best = samples.best.expect("at least one sample was completed");
    let history = solution.history.iter().zip(&samples.counts);
    Ok(SearchResult {
        subgoals: best.subgoals,
        latents: latents_of(solution.candidate),
        cost: solution.cost,
        plans: best.plans,
        history: history
            .map(|(&costs, &(evaluated, skipped))| SearchStats { costs, evaluated, skipped })
            .collect(),
    })
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
    let problems = Problems {
        starts: start,
        goals: goal,
        streams: &[Stream { seed, purpose: Purpose::Actions, problem: 0 }],
        warm_start: None,
        share_rollouts: false,
        describe: &|_| "the plan to the goal".into(),
    };
    let plans = plan(&config.mpc, world, &problems, interrupt)?;
    Ok(SearchResult {
        subgoals: goal.select(&[])?,
        latents: Array2::zeros((0, 0)),
        cost: plans[0].cost,
        plans,
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
        let problems = Problems {
            starts: &from,
            goals: &to,
            streams: &[segment_stream(seed, 0, 0, segment)],
            warm_start: None,
            share_rollouts: false,
            describe: &|_| format!("segment {segment}"),
        };
        plans.append(&mut plan(&config.mpc, world, &problems, interrupt)?);
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

/// A sample on its way to completion: the plans of its segments so far.
#[derive(Clone, Debug, Default)]
struct Sample {
    plans: Vec<Plan>,
}

impl Sample {
    fn cost(&self, reduction: Reduction) -> f32 {
        reduction.of(self.plans.iter().map(|plan| plan.cost))
    }
}

struct Best<F> {
    subgoals: F,
    cost: f32,
    plans: Vec<Plan>,
}

/// Samples of subgoals as an objective: latents to images to planning costs.
struct Samples<'a, W: WorldModel, G> {
    config: &'a HvfConfig,
    world: &'a W,
    generator: &'a G,
    start: &'a W::Frames,
    goal: &'a W::Frames,
    seed: u64,
    interrupt: Interrupt<'a>,
    latent_dim: usize,
    best: Option<Best<W::Frames>>,
    /// Planning problems (evaluated, skipped) of every iteration.
    counts: Vec<(usize, usize)>,
}

impl<W: WorldModel, G: SubgoalModel<W::Frames>> Samples<'_, W, G> {
    /// Plans segment `segment` of the samples `which`; `decoded` holds their subgoals.
    fn plan_segment(
        &self,
        iteration: usize,
        segment: usize,
        which: &[usize],
        decoded: &W::Frames,
        samples: &mut [Sample],
    ) -> Result<()> {
        let subgoals = self.config.subgoals;
        let subgoal = |number: usize| -> Result<W::Frames> {
            let index: Vec<usize> = which.iter().map(|sample| sample * subgoals + number).collect();
            decoded.select(&index)
        };
        let starts = if segment == 0 { self.start.clone() } else { subgoal(segment - 1)? };
        let goals = if segment == subgoals {
            self.goal.select(&vec![0; which.len()])?
        } else {
            subgoal(segment)?
        };
        let streams: Vec<Stream> = which
            .iter()
            .map(|&sample| segment_stream(self.seed, iteration, sample, segment))
            .collect();
        let problems = Problems {
            starts: &starts,
            goals: &goals,
            streams: &streams,
            warm_start: None,
            share_rollouts: self.config.share_rollouts,
            describe: &|problem| {
                format!("segment {segment} of sample {} in iteration {iteration}", which[problem])
            },
        };
        let plans = plan(&self.config.mpc, self.world, &problems, self.interrupt)?;
        for (&sample, plan) in which.iter().zip(plans) {
            samples[sample].plans.push(plan);
        }
        Ok(())
    }

    /// Plans the segments after the first of all samples that can still become elites.
    fn complete(&self, call: Call<'_>, decoded: &W::Frames, samples: &mut [Sample]) -> Result<()> {
        let prune = self.config.prune && self.config.reduction == Reduction::Max;
        let elites = self.config.cem.elites;
        let mut order: Vec<usize> = (0..samples.len()).collect();
        if prune {
            let first: Vec<f32> = samples.iter().map(|sample| sample.plans[0].cost).collect();
            order.sort_by(|&a, &b| first[a].total_cmp(&first[b]).then(a.cmp(&b)));
        }
        let mut complete: Vec<f32> = call.kept_costs[0].to_vec();
        let chunk = if prune { elites } else { samples.len() };
        for chunk in order.chunks(chunk) {
            let limit = complete.get(elites - 1).copied().unwrap_or(f32::INFINITY);
            let mut alive = chunk.to_vec();
            for segment in 1..=self.config.subgoals {
                if prune {
                    alive.retain(|&sample| samples[sample].cost(Reduction::Max) <= limit);
                }
                if alive.is_empty() {
                    break;
                }
                self.plan_segment(call.iteration, segment, &alive, decoded, samples)?;
            }
            complete
                .extend(alive.iter().map(|&sample| samples[sample].cost(self.config.reduction)));
            complete.sort_by(f32::total_cmp);
        }
        Ok(())
    }

    /// Keeps what belongs to the candidate that the optimisation would answer with now.
    fn remember_best(
        &mut self,
        call: Call<'_>,
        samples: &mut [Sample],
        costs: &[f32],
        decoded: &W::Frames,
    ) -> Result<()> {
        let subgoals = self.config.subgoals;
        let segments = subgoals + 1;
        // Ranked as the optimisation ranks them, so that its latents are those of these images.
        let Some(&sample) = elites(&[], costs.into(), 1).first() else {
            return Ok(());
        };
        if samples[sample].plans.len() != segments {
            return Ok(());
        }
        // The best so far competes with the last iteration's only if it was kept as an elite.
        let rival = match self.config.cem.best {
            BestOf::Last if call.kept_costs[0].is_empty() => None,
            _ => self.best.as_ref(),
        };
        if rival.is_none_or(|best| costs[sample] < best.cost) {
            let index: Vec<usize> = (sample * subgoals..(sample + 1) * subgoals).collect();
            self.best = Some(Best {
                subgoals: decoded.select(&index)?,
                cost: costs[sample],
                plans: std::mem::take(&mut samples[sample].plans),
            });
        }
        Ok(())
    }
}

impl<W: WorldModel, G: SubgoalModel<W::Frames>> Objective for Samples<'_, W, G> {
    fn costs(&mut self, call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>> {
        (self.interrupt)()?;
        let (_, count, _) = candidates.dim();
        let subgoals = self.config.subgoals;
        let latents = candidates
            .into_shape_with_order((count, subgoals, self.latent_dim))
            .expect("a candidate has K x L values");
        let decoded = decoded(self.generator, self.start, latents)?;
        let mut samples = vec![Sample::default(); count];
        let all: Vec<usize> = (0..count).collect();
        self.plan_segment(call.iteration, 0, &all, &decoded, &mut samples)?;
        self.complete(call, &decoded, &mut samples)?;

        let segments = subgoals + 1;
        let evaluated: usize = samples.iter().map(|sample| sample.plans.len()).sum();
        self.counts.push((evaluated, count * segments - evaluated));
        let costs: Vec<f32> = samples
            .iter()
            .map(|sample| match sample.plans.len() == segments {
                true => sample.cost(self.config.reduction),
                false => f32::INFINITY,
            })
            .collect();
        self.remember_best(call, &mut samples, &costs, &decoded)?;
        Ok(Array2::from_shape_vec((1, count), costs).expect("one cost per sample"))
    }
}

#[cfg(test)]
#[path = "search_tests.rs"]
mod tests;
