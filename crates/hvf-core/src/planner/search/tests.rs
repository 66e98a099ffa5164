#![allow(clippy::unwrap_used)]

use super::*;
use std::cell::{Cell, RefCell};

use crate::planner::cem::{BestOf, CemConfig, Covariance};
use crate::planner::mpc::{plan, MpcConfig, Problems};
use crate::planner::point_mass::{PointMass, Points, Positions};
use ndarray::{ArrayView2, Axis};
use proptest::prelude::*;

const START: [f32; 2] = [0.0, 0.0];
const GOAL: [f32; 2] = [6.0, 3.0];

fn small(subgoals: usize) -> HvfConfig {
    let mpc_cem = CemConfig { samples: 30, elites: 6, iterations: 3, ..CemConfig::default() };
    let mpc = MpcConfig { horizon: 3, cem: mpc_cem, ..MpcConfig::default() };
    let cem = CemConfig { samples: 24, elites: 5, iterations: 3, ..CemConfig::default() };
    HvfConfig { mpc, subgoals, cem, ..HvfConfig::default() }
}

fn run_in(
    config: &HvfConfig,
    world: &PointMass,
    generator: &Positions,
    seed: u64,
) -> Result<SearchResult<Points>> {
    let (start, goal) = (Points(vec![START]), Points(vec![GOAL]));
    search(config, world, generator, &start, &goal, seed, Watch::nobody())
}

fn run(config: &HvfConfig, seed: u64) -> SearchResult<Points> {
    run_in(config, &PointMass::new(), &Positions::new(), seed).unwrap()
}

/// Everything but what the savings may change: the population and the counts.
fn assert_same(a: &SearchResult<Points>, b: &SearchResult<Points>) {
    assert_eq!(a.subgoals, b.subgoals);
    assert_eq!(a.latents, b.latents);
    assert_eq!(a.cost.to_bits(), b.cost.to_bits());
    assert_eq!(a.plans, b.plans);
    assert_eq!(a.history.len(), b.history.len());
    for (a, b) in a.history.iter().zip(&b.history) {
        let figures = |stats: &SearchStats| {
            let costs = stats.costs;
            [costs.best, costs.elite_mean, costs.elite_worst, costs.max_std].map(f32::to_bits)
        };
        assert_eq!(figures(a), figures(b));
        assert_eq!(a.evaluated + a.skipped, b.evaluated + b.skipped);
    }
}

#[test]
fn splits_a_way_too_long_for_one_plan() {
    // Six steps of at most 1 per segment would do for two of three, not for one.
    let mut config = small(2);
    config.mpc.horizon = 3;
    config.cem = CemConfig { samples: 200, elites: 20, iterations: 8, ..CemConfig::default() };
    config.mpc.cem.samples = 100;
    let alone = run(&small(0), 0);
    let split = run(&config, 0);
    assert!(alone.cost > 8.0, "{alone:?}");
    assert!(split.cost < 0.1, "{split:?}");
    assert_eq!(split.plans.len(), 3);
    assert_eq!(split.subgoals.len(), 2);
}

#[test]
fn no_subgoals_is_the_plan_to_the_goal() {
    let found = run(&small(0), 5);
    let problems = Problems {
        starts: &Points(vec![START]),
        goals: &Points(vec![GOAL]),
        streams: &[Stream { seed: 5, purpose: Purpose::Actions, problem: 0 }],
        warm_start: None,
        share_rollouts: true,
        describe: &|_| String::new(),
    };
    let plans = plan(&small(0).mpc, &PointMass::new(), &problems, &|| Ok(())).unwrap();
    assert_eq!(found.plans, plans);
    assert_eq!(found.cost, plans[0].cost);
    assert!(found.subgoals.is_empty() && found.history.is_empty());
}

/// The segments of one sample of two subgoals, each planned on its own.
fn plain_plans(
    config: &HvfConfig,
    seed: u64,
    iteration: usize,
    sample: usize,
    latents: ArrayView2<'_, f32>,
) -> Vec<Plan> {
    let subgoals = latents.outer_iter().map(|l| Positions::position(&l.to_vec()));
    let way: Vec<[f32; 2]> = [START].into_iter().chain(subgoals).chain([GOAL]).collect();
    (0..3)
        .map(|segment| {
            let problems = Problems {
                starts: &Points(vec![way[segment]]),
                goals: &Points(vec![way[segment + 1]]),
                streams: &[segment_stream(seed, iteration, sample, segment)],
                warm_start: None,
                share_rollouts: false,
                describe: &|_| String::new(),
            };
            plan(&config.mpc, &PointMass::new(), &problems, &|| Ok(())).unwrap().remove(0)
        })
        .collect()
}

/// Algorithm 2 with loops: every sample planned on its own, over the latents that were drawn.
#[test]
fn equals_a_plain_search_over_the_same_latents() {
    for reduction in [Reduction::Max, Reduction::Mean, Reduction::MaxSum] {
        let config = HvfConfig { reduction, ..small(2) };
        let generator = Positions::new();
        let seed = 9;
        let found = run_in(&config, &PointMass::new(), &generator, seed).unwrap();
        let mut best = (f32::INFINITY, Vec::new());
        for (iteration, latents) in generator.seen.borrow().iter().enumerate() {
            let mut costs = Vec::new();
            for (sample, latents) in latents.outer_iter().enumerate() {
                let segments: Vec<f32> = plain_plans(&config, seed, iteration, sample, latents)
                    .iter()
                    .map(|plan| plan.cost)
                    .collect();
                let hardest = segments.iter().copied().fold(0.0, f32::max);
                let sum = segments.iter().sum::<f32>();
                let cost = match reduction {
                    Reduction::Max => hardest,
                    Reduction::Mean => sum / 3.0,
                    Reduction::MaxSum => hardest + 0.1 * sum,
                };
                if cost < best.0 {
                    best = (cost, segments);
                }
                costs.push(cost);
            }
            costs.sort_by(f32::total_cmp);
            let stats = found.history[iteration].costs;
            assert!((stats.best - costs[0]).abs() < 1e-6);
            assert!((stats.elite_worst - costs[4]).abs() < 1e-6);
            let elite_mean = costs[..5].iter().sum::<f32>() / 5.0;
            assert!((stats.elite_mean - elite_mean).abs() < 1e-5);
        }
        let segments: Vec<f32> = found.plans.iter().map(|plan| plan.cost).collect();
        assert_eq!(segments, best.1);
        assert!((found.cost - best.0).abs() < 1e-6);
        let decoded: Vec<[f32; 2]> =
            found.latents.outer_iter().map(|l| Positions::position(&l.to_vec())).collect();
        assert_eq!(found.subgoals.0, decoded);
    }
}

#[test]
fn the_best_of_the_last_iteration_is_one_sample_in_all_its_parts() {
    let mut earlier_was_better = 0;
    for seed in 0..6 {
        let mut config = small(2);
        config.cem.best = BestOf::Last;
        config.cem.min_variance = 0.0;
        let generator = Positions::new();
        let found = run_in(&config, &PointMass::new(), &generator, seed).unwrap();
        let last = generator.seen.borrow().last().unwrap().clone();
        let samples: Vec<Vec<Plan>> = last
            .outer_iter()
            .enumerate()
            .map(|(sample, latents)| plain_plans(&config, seed, 2, sample, latents))
            .collect();
        let cost = |sample: usize| samples[sample].iter().map(|plan| plan.cost).fold(0.0, f32::max);
        let best =
            (0..samples.len()).min_by(|&a, &b| cost(a).partial_cmp(&cost(b)).unwrap()).unwrap();
        assert_eq!(found.cost, cost(best));
        assert_eq!(found.plans, samples[best]);
        assert_eq!(found.latents, last.index_axis(Axis(0), best));
        let decoded = found.latents.outer_iter().map(|l| Positions::position(&l.to_vec()));
        assert_eq!(found.subgoals.0, decoded.collect::<Vec<_>>());

        config.cem.best = BestOf::All;
        let over_all = run(&config, seed);
        assert!(over_all.cost <= found.cost);
        earlier_was_better += usize::from(over_all.cost < found.cost);
    }
    assert!(earlier_was_better > 0, "nothing was tested");
}

#[test]
fn a_kept_elite_can_be_the_best_of_the_last_iteration() {
    for seed in 0..6 {
        let mut config = small(2);
        config.cem.keep_elites = 2;
        config.cem.min_variance = 0.0;
        let over_all = run(&config, seed);
        config.cem.best = BestOf::Last;
        assert_same(&run(&config, seed), &over_all);
    }
}

#[test]
fn pruning_and_sharing_skip_work() {
    let config = small(2);
    let lazy = PointMass::new();
    let found = run_in(&config, &lazy, &Positions::new(), 1).unwrap();
    let skipped: usize = found.history.iter().map(|stats| stats.skipped).sum();
    assert!(skipped > 20, "{found:?}");
    let diligent = PointMass::new();
    let all = HvfConfig { prune: false, share_rollouts: false, ..config };
    run_in(&all, &diligent, &Positions::new(), 1).unwrap();
    assert!(lazy.rollouts.get() < diligent.rollouts.get());
}

/// Which segment is the hardest does not have to be guessed right.
#[test]
fn only_what_can_be_the_hardest_segment_is_planned_to_its_end() {
    let mut config = small(3);
    config.mpc.cem = CemConfig { iterations: 6, min_variance: 0.0, ..config.mpc.cem };
    let rollouts = |config: &HvfConfig, world: PointMass| {
        run_in(config, &world, &Positions::new(), 1).unwrap();
        world.rollouts.get() as f64
    };
    let world = || PointMass { shares: false, ..PointMass::new() };
    let all = rollouts(&HvfConfig { prune: false, ..config.clone() }, world());
    let least = rollouts(&config, world());
    // 4 segments of 24 samples; were only whole plans left out, one of each and 4 of 5 elites.
    assert!(least < 0.4 * all, "{least} of {all} rollouts");
}

#[test]
fn how_many_samples_are_completed_at_a_time_changes_nothing() {
    for chunk in [1, 3, 24, usize::MAX] {
        let config = HvfConfig { chunk: Some(chunk), ..small(2) };
        assert_same(&run(&config, 2), &run(&small(2), 2));
    }
    let error = HvfConfig { chunk: Some(0), ..small(2) }.validate().unwrap_err().to_string();
    assert!(error.starts_with("chunk: must be at least 1"), "{error}");
}

#[test]
fn the_best_of_the_last_iteration_of_a_plan_is_not_cut_short() {
    for seed in 0..4 {
        let mut config = small(2);
        config.mpc.cem.best = BestOf::Last;
        let plain = HvfConfig { prune: false, share_rollouts: false, ..config.clone() };
        assert_same(&run(&config, seed), &run(&plain, seed));
    }
}

#[test]
fn searches_side_by_side_find_what_each_finds_alone() {
    let starts = Points(vec![[0.0, 0.0], [1.0, -1.0], [0.5, 4.0]]);
    let goals = Points(vec![[6.0, 3.0], [-4.0, 2.0], [0.0, -3.0]]);
    let seeds = [4, 4, 9];
    for (subgoals, segment_cost) in
        [(0, SegmentCost::Planned), (2, SegmentCost::Planned), (2, SegmentCost::Likelihood)]
    {
        // Latents are learned well enough in some searches before the last iteration.
        let mut config = HvfConfig { segment_cost, ..small(subgoals) };
        config.cem = CemConfig { iterations: 8, min_variance: 0.5, ..config.cem };
        let (world, generator) = (PointMass::new(), Positions::new());
        let all = [&starts, &goals];
        let found =
            search_batch(&config, &world, &generator, all, &seeds, Watch::nobody()).unwrap();
        for (episode, found) in found.iter().enumerate() {
            let [start, goal] = all.map(|frames| frames.select(&[episode]).unwrap());
            let alone = config.search(&world, &generator, &start, &goal, seeds[episode]).unwrap();
            assert_same(found, &alone);
            assert_eq!(found.history, alone.history);
        }
        if subgoals > 0 {
            let ends: Vec<usize> = found.iter().map(|found| found.history.len()).collect();
            assert!(ends.iter().min() < ends.iter().max(), "all took {ends:?}");
        }
        let one = starts.select(&[1]).unwrap();
        let from_one =
            search_batch(&config, &world, &generator, [&one, &goals], &seeds, Watch::nobody());
        assert_same(&from_one.unwrap()[1], &found[1]);
    }
}

/// Images of 24 x 2 subgoals of so many searches are drawn in several batches: an error in the
/// second batch comes when the first is an iteration further.
#[test]
fn an_error_between_batches_leaves_each_search_as_it_was_after_a_finished_iteration() {
    let count = 100;
    let starts = Points(vec![START; count]);
    let goals = Points((0..count).map(|i| [0.1 * i as f32, 3.0]).collect());
    let seeds: Vec<u64> = (0..count as u64).collect();
    let mut config = small(2);
    config.mpc.cem.iterations = 1;
    let run = |watch: Watch<'_, Points>, config: &HvfConfig| {
        let ends = [&starts, &goals];
        search_batch(config, &PointMass::new(), &Positions::new(), ends, &seeds, watch)
    };
    let asked = Cell::new(0_usize);
    let count_up = || {
        asked.set(asked.get() + 1);
        Ok(())
    };
    config.cem.iterations = 1;
    let expected = run(Watch { interrupt: &count_up, ..Watch::nobody() }, &config).unwrap();
    let of_one_iteration = asked.get();
    config.cem.iterations = 2;
    asked.set(0);
    let stop = || {
        asked.set(asked.get() + 1);
        match asked.get() > of_one_iteration * 3 / 2 {
            true => Err(Error::Interrupted),
            false => Ok(()),
        }
    };
    let kept = RefCell::new(Vec::new());
    let keep = |found| kept.borrow_mut().push(found);
    let watch = Watch { interrupt: &stop, partial: &keep, ..Watch::nobody() };
    assert!(run(watch, &config).is_err());
    let kept = kept.into_inner();
    assert_eq!(kept.len(), count);
    for (found, expected) in kept.iter().zip(&expected) {
        assert_same(found, expected);
    }
    assert!(search_batch(
        &config,
        &PointMass::new(),
        &Positions::new(),
        [&Points(vec![]), &Points(vec![])],
        &[],
        Watch::nobody()
    )
    .unwrap()
    .is_empty());
}

#[test]
fn searches_side_by_side_share_their_calls() {
    let config = HvfConfig { prune: false, share_rollouts: false, ..small(2) };
    let ends = |count: usize| {
        [Points(vec![START; count]), Points((0..count).map(|i| [i as f32, 3.0]).collect())]
    };
    let calls = |count: usize| {
        let [starts, goals] = ends(count);
        let world = PointMass::new();
        let seeds: Vec<u64> = (0..count as u64).collect();
        let all = [&starts, &goals];
        search_batch(&config, &world, &Positions::new(), all, &seeds, Watch::nobody()).unwrap();
        world.calls.get()
    };
    assert_eq!(calls(1), calls(5));
}

#[test]
fn batches_whose_lengths_disagree_are_refused() {
    let points = |count: usize| Points(vec![START; count]);
    let go = |starts: usize, goals: usize, seeds: &[u64]| {
        let (world, generator) = (PointMass::new(), Positions::new());
        let ends = [&points(starts), &points(goals)];
        search_batch(&small(1), &world, &generator, ends, seeds, Watch::nobody())
            .unwrap_err()
            .to_string()
    };
    assert!(go(2, 3, &[0; 3]).starts_with("starts: must be as many as goals (3), got 2"));
    assert!(go(3, 3, &[0; 2]).starts_with("seeds: must be as many as goals (3), got 2"));
}

#[test]
fn only_the_maximum_is_pruned() {
    for (reduction, prunes) in
        [(Reduction::Max, true), (Reduction::Mean, false), (Reduction::MaxSum, false)]
    {
        let found = run(&HvfConfig { reduction, ..small(2) }, 1);
        assert_eq!(found.history.iter().any(|stats| stats.skipped > 0), prunes, "{reduction:?}");
    }
}

#[test]
fn a_generator_that_gives_too_few_frames_is_an_error() {
    let generator = Positions { frames_missing: 1, ..Positions::new() };
    let error = run_in(&small(2), &PointMass::new(), &generator, 0).unwrap_err().to_string();
    assert!(error.contains("decode") && error.contains("48") && error.contains("47"), "{error}");
}

#[test]
fn all_nan_names_iteration_sample_and_segment() {
    let mut world = PointMass::new();
    world.nan_at = Some(GOAL[0]);
    let error = run_in(&small(1), &world, &Positions::new(), 0).unwrap_err().to_string();
    assert!(error.contains("segment 1 of sample") && error.contains("iteration 0"), "{error}");
}

#[test]
fn several_starts_or_goals_are_refused() {
    let (one, two) = (Points(vec![START]), Points(vec![START, GOAL]));
    let (world, generator) = (PointMass::new(), Positions::new());
    let config = small(1);
    let go = |start: &Points, goal: &Points| {
        search(&config, &world, &generator, start, goal, 0, Watch::nobody())
            .unwrap_err()
            .to_string()
    };
    assert!(go(&two, &one).starts_with("start"));
    assert!(go(&one, &two).starts_with("goal"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn savings_threads_and_call_sizes_change_nothing(
        seed: u64,
        subgoals in 1usize..4,
        keep_elites in 0usize..5,
        threads in 1usize..5,
        max_candidates in 1usize..3000,
        reduction in prop::sample::select(&[Reduction::Max, Reduction::Mean, Reduction::MaxSum]),
        prune: bool,
        shares: bool,
    ) {
        let mut config = HvfConfig { reduction, ..small(subgoals) };
        config.cem.keep_elites = keep_elites;
        let plain = HvfConfig { prune: false, share_rollouts: false, ..config.clone() };
        let expected = run(&plain, seed);
        let config = HvfConfig { prune, ..config };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let found = pool.install(|| {
            let mut world = PointMass::new();
            world.max_candidates = max_candidates;
            world.shares = shares;
            run_in(&config, &world, &Positions::new(), seed).unwrap()
        });
        assert_same(&found, &expected);
    }
}

#[test]
fn watchers_are_told_how_the_search_stands_after_every_iteration() {
    for segment_cost in [SegmentCost::Planned, SegmentCost::Likelihood] {
        let config = HvfConfig { segment_cost, ..small(2) };
        let told = RefCell::new(Vec::new());
        let note = |progress: Progress| {
            told.borrow_mut().push((progress.iteration, progress.iterations, progress.cost));
            Ok(())
        };
        let watch = Watch {
            progress: &note,
            partial: &|_| panic!("nothing ended the search"),
            ..Watch::nobody()
        };
        let found = watched(&config, watch).unwrap();
        let mut best = f32::INFINITY;
        let expected = found.history.iter().enumerate().map(|(n, stats)| {
            best = best.min(stats.costs.best);
            (n + 1, 3, best)
        });
        assert_eq!(told.into_inner(), expected.collect::<Vec<_>>());
    }
}

fn watched(config: &HvfConfig, watch: Watch<'_, Points>) -> Result<SearchResult<Points>> {
    let (start, goal) = (Points(vec![START]), Points(vec![GOAL]));
    search(config, &PointMass::new(), &Positions::new(), &start, &goal, 3, watch)
}

#[test]
fn an_error_leaves_what_was_found_by_the_last_finished_iteration() {
    for segment_cost in [SegmentCost::Planned, SegmentCost::Likelihood] {
        let config = HvfConfig { segment_cost, ..small(2) };
        for ends_at in 1..=3 {
            let partial = RefCell::new(None);
            let end = |progress: Progress| match progress.iteration == ends_at {
                true => Err(Error::Interrupted),
                false => Ok(()),
            };
            let keep = |found| *partial.borrow_mut() = Some(found);
            let watch = Watch { progress: &end, partial: &keep, ..Watch::nobody() };
            assert!(matches!(watched(&config, watch).unwrap_err(), Error::Interrupted));
            let found = partial.into_inner().unwrap();
            // What a search with no more iterations answers.
            let mut shorter = config.clone();
            shorter.cem.iterations = ends_at;
            let expected = watched(&shorter, Watch::nobody()).unwrap();
            assert_eq!((found.subgoals, found.latents), (expected.subgoals, expected.latents));
            assert_eq!((found.cost, found.history), (expected.cost, expected.history));
            match segment_cost {
                SegmentCost::Planned => assert_eq!(found.plans, expected.plans),
                SegmentCost::Likelihood => assert!(found.plans.is_empty()),
            }
        }
    }
}

#[test]
fn an_error_in_the_first_iteration_leaves_nothing() {
    let stop = || Err(Error::Interrupted);
    let watch = Watch {
        interrupt: &stop,
        partial: &|_| panic!("no iteration was finished"),
        ..Watch::nobody()
    };
    assert!(watched(&small(1), watch).is_err());
}

#[test]
fn options_of_the_search_change_nothing_about_its_savings() {
    let covariance = Covariance::Full { shrinkage: 0.2 };
    for samples_decay in [1.0, 1.5] {
        let mut config = small(2);
        config.cem = CemConfig {
            covariance,
            samples_decay,
            momentum: 0.1,
            temperature: Some(0.5),
            keep_elites: 2,
            min_std: 0.05,
            ..config.cem
        };
        let plain = HvfConfig { prune: false, share_rollouts: false, ..config.clone() };
        assert_same(&run(&config, 1), &run(&plain, 1));
    }
}

#[test]
fn the_short_method_is_the_search_that_nobody_watches() {
    let (start, goal) = (Points(vec![START]), Points(vec![GOAL]));
    let config = small(2);
    let found = config.search(&PointMass::new(), &Positions::new(), &start, &goal, 4).unwrap();
    assert_same(&found, &run(&config, 4));
}
