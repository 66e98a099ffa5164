//! Samples of subgoals as an objective: latents to images to planning costs.

use ndarray::{Array2, Array3, Axis};

use super::pruning::plan_what_matters;
use super::segments::{Planner, Segments, Ways};
use super::{
    decoded, latents_in, latents_of, Ends, HvfConfig, Reduction, SearchResult, SearchStats, Watch,
};
use crate::planner::cem::{elites, BestOf, Call, Objective, Solution};
use crate::planner::model::{Frames, SubgoalModel, WorldModel};
use crate::planner::mpc::Plan;
use crate::Result;

/// Most images that are drawn together, where several searches could be: 50 MB of 64 x 64 bytes.
const MOST_IMAGES: usize = 1 << 12;

/// What belongs to the candidate that the optimisation would answer with.
struct Best<F> {
    subgoals: F,
    cost: f32,
    plans: Vec<Plan>,
}

/// One search of the batch, between its iterations.
struct Episode<F> {
    /// How the optimisation stood after its last iteration.
    latest: Option<Solution>,
    /// What belongs to that.
    best: Option<Best<F>>,
    /// What is better, of the iteration that is not finished.
    better: Option<Best<F>>,
    /// Planning problems (evaluated, skipped) of every iteration.
    counts: Vec<(usize, usize)>,
}

/// Samples of subgoals as an objective: latents to images to planning costs, one problem for each
/// search of a batch.
pub(super) struct Samples<'a, W: WorldModel, G> {
    config: &'a HvfConfig,
    world: &'a W,
    generator: &'a G,
    ends: &'a [Ends<W::Frames>],
    watch: Watch<'a, W::Frames>,
    latent_dim: usize,
    episodes: Vec<Episode<W::Frames>>,
}

impl<'a, W: WorldModel, G: SubgoalModel<W::Frames>> Samples<'a, W, G> {
    pub fn new(
        config: &'a HvfConfig,
        world: &'a W,
        generator: &'a G,
        ends: &'a [Ends<W::Frames>],
        watch: Watch<'a, W::Frames>,
    ) -> Self {
        let episode =
            |_: &_| Episode { latest: None, best: None, better: None, counts: Vec::new() };
        Self {
            config,
            world,
            generator,
            ends,
            watch,
            latent_dim: generator.latent_dim(),
            episodes: ends.iter().map(episode).collect(),
        }
    }

    /// What each search answers with as it stands; nothing before the first iteration is done.
    pub fn found(self) -> Option<Vec<SearchResult<W::Frames>>> {
        let subgoals = self.config.subgoals;
        let answer = |Episode { latest, best, counts, .. }| {
            let (solution, best): (Solution, Best<_>) = (latest?, best?);
            let history = solution.history.iter().zip(counts);
            Some(SearchResult {
                subgoals: best.subgoals,
                latents: latents_of(&solution, subgoals),
                cost: solution.cost,
                plans: best.plans,
                history: history
                    .map(|(&costs, (evaluated, skipped))| SearchStats { costs, evaluated, skipped })
                    .collect(),
            })
        };
        self.episodes.into_iter().map(answer).collect()
    }

    /// Plans of the segments of all samples, as far as they matter.
    fn plans(&self, segments: &Segments<'_, W>, call: Call<'_>) -> Result<Vec<Option<Plan>>> {
        if self.config.prune && self.config.reduction == Reduction::Max {
            return plan_what_matters(self.config, segments, call.kept_costs);
        }
        Ok(segments.plan_all()?.into_iter().map(Some).collect())
    }

    /// Keeps what belongs to the candidate that the optimisation of an episode would answer with
    /// now; `plans` are those of all segments of its samples, of which `first` is the first.
    fn remember_best(
        &mut self,
        (episode, kept): (usize, &[f32]),
        (segments, first): (&Segments<'_, W>, usize),
        plans: &[Option<Plan>],
        costs: &[f32],
        decoded: &W::Frames,
    ) -> Result<()> {
        let subgoals = self.config.subgoals;
        let width = subgoals + 1;
        // Ranked as the optimisation ranks them, so that its latents are those of these images.
        let Some(&sample) = elites(&[], costs.into(), 1).first() else {
            return Ok(());
        };
        let plans = &plans[sample * width..(sample + 1) * width];
        let Some(mut plans) = plans.iter().cloned().collect::<Option<Vec<Plan>>>() else {
            return Ok(());
        };
        // The best so far competes with the last iteration's only if it was kept as an elite.
        let rival = match self.config.cem.best {
            BestOf::Last if kept.is_empty() => None,
            _ => self.episodes[episode].best.as_ref(),
        };
        if rival.is_some_and(|best| costs[sample] >= best.cost) {
            return Ok(());
        }
        // Of all but the hardest segment, planning may have ended early.
        let early: Vec<usize> = (0..width)
            .filter(|&segment| plans[segment].history.len() < self.config.mpc.cem.iterations)
            .collect();
        let numbers: Vec<usize> =
            early.iter().map(|segment| first + sample * width + segment).collect();
        if !numbers.is_empty() {
            for (&segment, plan) in early.iter().zip(segments.plan(&numbers, None)?) {
                plans[segment] = plan;
            }
        }
        let index: Vec<usize> = (sample * subgoals..(sample + 1) * subgoals).collect();
        self.episodes[episode].better =
            Some(Best { subgoals: decoded.select(&index)?, cost: costs[sample], plans });
        Ok(())
    }
}

impl<W: WorldModel, G: SubgoalModel<W::Frames>> Objective for Samples<'_, W, G> {
    fn problems_per_call(&self) -> usize {
        MOST_IMAGES / self.config.cem.samples.saturating_mul(self.config.subgoals)
    }

    fn costs(&mut self, call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>> {
        (self.watch.interrupt)()?;
        let (problems, count, _) = candidates.dim();
        let (subgoals, ends, iteration) = (self.config.subgoals, self.ends, call.iteration);
        let mut ways = Vec::with_capacity(problems);
        for (latents, &episode) in candidates.axis_iter(Axis(0)).zip(call.problems) {
            let Ends { start, goal, seed } = &ends[episode];
            let latents = latents_in(latents, subgoals, self.latent_dim);
            let subgoals = decoded(self.generator, start, latents)?;
            ways.push(Ways { start, goal, subgoals, seed: *seed });
        }
        let width = subgoals + 1;
        let describe = |number: usize| {
            let (sample, segment) = (number / width % count, number % width);
            let segment = format!("segment {segment} of sample {sample} in iteration {iteration}");
            match ends.len() {
                1 => segment,
                _ => format!("{segment} of problem {}", call.problems[number / width / count]),
            }
        };
        let planner = Planner {
            mpc: &self.config.mpc,
            world: self.world,
            share_rollouts: self.config.share_rollouts,
            interrupt: self.watch.interrupt,
        };
        let segments = Segments::new(planner, &ways, subgoals, iteration, &describe)?;
        let plans = self.plans(&segments, call)?;

        let reduction = self.config.reduction;
        let cost = |plans: &[Option<Plan>]| {
            let costs: Option<Vec<f32>> =
                plans.iter().map(|plan| plan.as_ref().map(|plan| plan.cost)).collect();
            costs.map_or(f32::INFINITY, |costs| reduction.of(costs.iter().copied()))
        };
        let costs: Vec<f32> = plans.chunks_exact(width).map(cost).collect();
        for (problem, &episode) in call.problems.iter().enumerate() {
            let first = problem * count * width;
            let plans = &plans[first..first + count * width];
            let evaluated = plans.iter().flatten().count();
            self.episodes[episode].counts.push((evaluated, plans.len() - evaluated));
            self.remember_best(
                (episode, call.kept_costs[problem]),
                (&segments, first),
                plans,
                &costs[problem * count..(problem + 1) * count],
                &ways[problem].subgoals,
            )?;
        }
        Ok(Array2::from_shape_vec((problems, count), costs).expect("one cost per sample"))
    }

    fn iterated(&mut self, episodes: &[usize], solutions: &[&Solution]) -> Result<()> {
        for (&episode, &solution) in episodes.iter().zip(solutions) {
            let Episode { latest, best, better, .. } = &mut self.episodes[episode];
            *latest = Some(solution.clone());
            *best = better.take().or(best.take());
        }
        self.watch.iterated(solutions, self.config.cem.iterations)
    }
}
