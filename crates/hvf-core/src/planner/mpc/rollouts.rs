//! A world model's planning costs as what the cross-entropy method minimises.

use std::borrow::Cow;

use ndarray::{s, Array, Array2, Array3, Axis, Dimension, Ix3, Ix4};

use super::{Interrupt, MpcConfig, Problems};
use crate::planner::cem::{Call, Objective};
use crate::planner::model::{Candidates, Frames, SharedCandidates, WorldModel};
use crate::planner::sampler::draw_seeds;
use crate::Result;

/// Most values of actions in one call, whatever a model wants, where more than one problem is in
/// it: 256 MiB.
const MAX_CALL_VALUES: usize = 1 << 26;

/// The world model's costs as an objective.
pub(super) struct Rollouts<'a, W: WorldModel> {
    pub config: &'a MpcConfig,
    pub world: &'a W,
    /// Starts and goals as the model prepared them.
    pub problems: Problems<'a, W::Frames>,
    /// Costs that are low enough, one for each problem.
    pub enough: Option<&'a [f32]>,
    pub interrupt: Interrupt<'a>,
}

impl<W: WorldModel> Rollouts<'_, W> {
    /// Actions of candidates `[.., N]`, held as long as the settings say, `[.., H, A]`.
    fn actions<D: Dimension>(&self, candidates: Vec<f32>, shape: D) -> Array<f32, D> {
        let dim = self.world.action_space().dim();
        let held = hold(candidates, dim, self.config.action_repeat);
        Array::from_shape_vec(shape, held)
            .expect("a candidate holds horizon / action_repeat actions")
    }

    /// Seeds of the candidates of `problems` in one iteration, `[B', D]`, if the model wants them.
    fn seeds(&self, iteration: usize, problems: &[usize]) -> Option<Array2<i64>> {
        if !self.world.uses_seeds() {
            return None;
        }
        let samples = self.config.cem.samples_in(iteration);
        let mut seeds = Array2::zeros((problems.len(), samples));
        for (mut row, &problem) in seeds.outer_iter_mut().zip(problems) {
            let stream = self.problems.streams[problem].in_iteration(iteration);
            draw_seeds(stream, iteration, row.as_slice_mut().expect("standard layout"));
        }
        Some(seeds)
    }

    /// Problems of one call: those it is about, and as many copies of the last one as the model
    /// wants besides.
    fn padded(&self, problems: &[usize]) -> Vec<usize> {
        let mut all = problems.to_vec();
        if let (true, Some(&last)) = (self.world.pads(), problems.last()) {
            let most = self.problems_per_call().max(problems.len());
            all.resize(problems.len().next_power_of_two().min(most), last);
        }
        all
    }
}

/// The frames of `problems` (one frame stands for all), without a copy where that is the batch.
fn selected<'f, F: Frames>(frames: &'f F, problems: &[usize]) -> Result<Cow<'f, F>> {
    if problems.iter().copied().eq(0..frames.len()) {
        Ok(Cow::Borrowed(frames))
    } else if frames.len() == 1 {
        Ok(Cow::Owned(frames.select(&vec![0; problems.len()])?))
    } else {
        Ok(Cow::Owned(frames.select(problems)?))
    }
}

/// The costs of the first `problems`, if more were asked for, `padded`.
fn without_copies(costs: Array2<f32>, problems: usize, padded: usize) -> Array2<f32> {
    // Another shape is another's to refuse.
    if costs.nrows() == padded && padded > problems {
        return costs.slice_move(s![..problems, ..]);
    }
    costs
}

impl<W: WorldModel> Objective for Rollouts<'_, W> {
    fn problems_per_call(&self) -> usize {
        let values = self.config.horizon * self.world.action_space().dim();
        let most = self.world.max_candidates().min(MAX_CALL_VALUES / values);
        most / self.config.cem.samples
    }

    fn costs(&mut self, call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>> {
        (self.interrupt)()?;
        let (problems, samples, dimensions) = candidates.dim();
        let all = self.padded(call.problems);
        let mut candidates = candidates.into_raw_vec_and_offset().0;
        for _ in problems..all.len() {
            candidates.extend_from_within(
                (problems - 1) * samples * dimensions..problems * samples * dimensions,
            );
        }
        let shape = Ix4(all.len(), samples, self.config.horizon, self.world.action_space().dim());
        let actions = self.actions(candidates, shape);
        let seeds = self.seeds(call.iteration, &all);
        let Problems { starts, goals, .. } = self.problems;
        let (starts, goals) = (selected(starts, &all)?, selected(goals, &all)?);
        let costs = self.world.rollout_costs(&starts, &goals, Candidates { actions, seeds })?;
        Ok(without_copies(costs, problems, all.len()))
    }

    fn shared_costs(
        &mut self,
        call: Call<'_>,
        candidates: &Array2<f32>,
    ) -> Option<Result<Array2<f32>>> {
        if !self.problems.share_rollouts || self.problems.starts.len() != 1 {
            return None;
        }
        if let Err(stop) = (self.interrupt)() {
            return Some(Err(stop));
        }
        let all = self.padded(call.problems);
        let goals = match selected(self.problems.goals, &all) {
            Ok(goals) => goals,
            Err(error) => return Some(Err(error)),
        };
        let dim = self.world.action_space().dim();
        let shape = Ix3(candidates.nrows(), self.config.horizon, dim);
        let actions = self.actions(candidates.iter().copied().collect(), shape);
        // All problems have one stream in the iteration that they share.
        let seeds = self.seeds(call.iteration, &call.problems[..1]);
        let seeds = seeds.map(|seeds| seeds.index_axis_move(Axis(0), 0));
        let candidates = SharedCandidates { actions, seeds };
        let costs = self.world.shared_rollout_costs(self.problems.starts, &goals, candidates)?;
        Some(costs.map(|costs| without_copies(costs, call.problems.len(), all.len())))
    }

    fn enough(&self, problem: usize) -> Option<f32> {
        self.enough.map(|costs| costs[problem])
    }

    fn describe(&self, problem: usize) -> String {
        format!("rollout_costs for {}", (self.problems.describe)(problem))
    }
}

/// The same, but a cost of NaN is an infinite one: among a few candidates all may cost NaN.
pub(super) struct Lenient<'a, W: WorldModel>(pub Rollouts<'a, W>);

fn leniently(costs: Result<Array2<f32>>) -> Result<Array2<f32>> {
    costs.map(|costs| costs.mapv_into(|cost| if cost.is_nan() { f32::INFINITY } else { cost }))
}

impl<W: WorldModel> Objective for Lenient<'_, W> {
    fn problems_per_call(&self) -> usize {
        self.0.problems_per_call()
    }

    fn costs(&mut self, call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>> {
        leniently(self.0.costs(call, candidates))
    }

    fn shared_costs(
        &mut self,
        call: Call<'_>,
        candidates: &Array2<f32>,
    ) -> Option<Result<Array2<f32>>> {
        self.0.shared_costs(call, candidates).map(leniently)
    }

    fn describe(&self, problem: usize) -> String {
        self.0.describe(problem)
    }
}

/// Every action `repeat` times: `[.., H / repeat, A]` to `[.., H, A]`.
pub(super) fn hold(actions: Vec<f32>, dim: usize, repeat: usize) -> Vec<f32> {
    if repeat == 1 {
        return actions;
    }
    actions.chunks_exact(dim).flat_map(|action| action.repeat(repeat)).collect()
}
