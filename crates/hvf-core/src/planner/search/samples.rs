//! Samples of subgoals as an objective: latents to images to planning costs.

use ndarray::{Array2, Array3};

use super::{
    decoded, latents_of, segment_stream, HvfConfig, Reduction, SearchResult, SearchStats, Watch,
};
use crate::planner::cem::{elites, BestOf, Call, Objective, Solution};
use crate::planner::model::{Frames, SubgoalModel, WorldModel};
use crate::planner::mpc::{plan, Plan, Problems};
use crate::planner::sampler::Stream;
use crate::Result;

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

/// What belongs to the candidate that the optimisation would answer with.
pub(super) struct Best<F> {
    subgoals: F,
    cost: f32,
    plans: Vec<Plan>,
}

/// Samples of subgoals as an objective: latents to images to planning costs.
pub(super) struct Samples<'a, W: WorldModel, G> {
    pub config: &'a HvfConfig,
    pub world: &'a W,
    pub generator: &'a G,
    pub start: &'a W::Frames,
    pub goal: &'a W::Frames,
    pub seed: u64,
    pub watch: Watch<'a, W::Frames>,
    /// How the optimisation stood after its last iteration.
    pub latest: Option<Solution>,
    pub latent_dim: usize,
    pub best: Option<Best<W::Frames>>,
    /// Planning problems (evaluated, skipped) of every iteration.
    pub counts: Vec<(usize, usize)>,
}

impl<W: WorldModel, G: SubgoalModel<W::Frames>> Samples<'_, W, G> {
    /// What the search answers with, if `solution` is what the optimisation does.
    pub fn found(&self, solution: &Solution) -> SearchResult<W::Frames> {
        let best = self.best.as_ref().expect("at least one sample was completed");
        let history = solution.history.iter().zip(&self.counts);
        SearchResult {
            subgoals: best.subgoals.clone(),
            latents: latents_of(solution, self.config.subgoals),
            cost: solution.cost,
            plans: best.plans.clone(),
            history: history
                .map(|(&costs, &(evaluated, skipped))| SearchStats { costs, evaluated, skipped })
                .collect(),
        }
    }

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
        let plans = plan(&self.config.mpc, self.world, &problems, self.watch.interrupt)?;
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
        (self.watch.interrupt)()?;
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

    fn iterated(&mut self, solutions: &[&Solution]) -> Result<()> {
        let solution = solutions[0];
        self.latest = Some(solution.clone());
        self.watch.iterated(solution, self.config.cem.iterations)
    }
}
