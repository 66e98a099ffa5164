//! With the maximum over segments, most planning tells nothing about which samples are elites.
//!
//! 1. A sample costs at least as much as its worst segment so far: once that exceeds the `M*`-th
//!    best complete sample, it cannot become an elite, and the rest of it is left out. So the
//!    segment that a [probe](crate::planner::mpc::probe) takes for the hardest is planned first.
//! 2. Of any other segment of a sample only one thing matters: whether it is harder. Its search may
//!    end as soon as it has found a plan that costs no more than the worst one so far.
//!
//! Neither changes a bit of what the elites are and cost.

use super::segments::Segments;
use super::HvfConfig;
use crate::planner::cem::BestOf;
use crate::planner::model::WorldModel;
use crate::planner::mpc::Plan;
use crate::Result;

/// Plans of the segments of `M` samples of each problem, as far as they matter; `None` for those
/// that do not. Samples whose segments all have a plan are complete: their largest cost is the one
/// that full plans would have.
///
/// `kept` are the costs of the elites that each problem kept, best first.
pub(super) fn plan_what_matters<W: WorldModel>(
    config: &HvfConfig,
    segments: &Segments<'_, W>,
    kept: &[&[f32]],
) -> Result<Vec<Option<Plan>>> {
    let width = config.subgoals + 1;
    let samples = segments.len() / width;
    let per_problem = samples / kept.len();
    let guesses = segments.probe()?;
    let hardest_first: Vec<Vec<usize>> = guesses.chunks_exact(width).map(descending).collect();

    let mut plans: Vec<Option<Plan>> = vec![None; segments.len()];
    let mut worst = vec![f32::NEG_INFINITY; samples];
    let mut plan = |rank: usize, which: &[usize], worst: &mut [f32]| -> Result<()> {
        let numbers: Vec<usize> =
            which.iter().map(|&sample| sample * width + hardest_first[sample][rank]).collect();
        let enough: Vec<f32> = which.iter().map(|&sample| worst[sample]).collect();
        // The best of the last iteration may cost more than the best of an earlier one.
        let may_stop = rank > 0 && config.mpc.cem.best == BestOf::All;
        let found = segments.plan(&numbers, may_stop.then_some(&enough))?;
        for ((&sample, number), plan) in which.iter().zip(numbers).zip(found) {
            worst[sample] = worst[sample].max(plan.cost);
            plans[number] = Some(plan);
        }
        Ok(())
    };
    plan(0, &(0..samples).collect::<Vec<_>>(), &mut worst)?;

    let mut orders: Vec<Vec<usize>> = (0..kept.len())
        .map(|problem| (problem * per_problem..(problem + 1) * per_problem).collect())
        .collect();
    for order in &mut orders {
        order.sort_by(|&a, &b| worst[a].total_cmp(&worst[b]).then(a.cmp(&b)));
    }
    let mut complete: Vec<Vec<f32>> = kept.iter().map(|costs| costs.to_vec()).collect();
    let (elites, chunk) = (config.cem.elites, config.chunk.unwrap_or(config.cem.elites));
    for begin in (0..per_problem).step_by(chunk) {
        let limits: Vec<f32> = complete
            .iter()
            .map(|costs| costs.get(elites - 1).copied().unwrap_or(f32::INFINITY))
            .collect();
        let end = per_problem.min(begin.saturating_add(chunk));
        let mut alive: Vec<usize> =
            orders.iter().flat_map(|order| order[begin..end].iter().copied()).collect();
        for rank in 1..width {
            alive.retain(|&sample| worst[sample] <= limits[sample / per_problem]);
            if alive.is_empty() {
                break;
            }
            plan(rank, &alive, &mut worst)?;
        }
        for &sample in &alive {
            complete[sample / per_problem].push(worst[sample]);
        }
        for costs in &mut complete {
            costs.sort_by(f32::total_cmp);
        }
    }
    Ok(plans)
}

/// Places of the costs, the largest first.
fn descending(costs: &[f32]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..costs.len()).collect();
    order.sort_by(|&a, &b| costs[b].total_cmp(&costs[a]));
    order
}
