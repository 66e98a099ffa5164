#![allow(clippy::unwrap_used)]

use super::*;
use std::cell::RefCell;

use crate::planner::cem::{CemConfig, Covariance};
use crate::planner::model::{ActionSpace, Candidates};
use crate::planner::point_mass::{PointMass, Points};
use crate::planner::sampler::{Purpose, Stream};
use ndarray::{Array3, ArrayView2, Axis};
use proptest::prelude::*;

fn stream(seed: u64, problem: u64) -> Stream {
    Stream { seed, purpose: Purpose::Actions, problem }
}

fn solve(
    config: &MpcConfig,
    world: &PointMass,
    starts: &Points,
    goals: &Points,
    streams: &[Stream],
    warm_start: Option<&Array3<f32>>,
    share_rollouts: bool,
) -> Result<Vec<Plan>> {
    let warm_start = warm_start.map(WarmStart::from);
    let describe = |problem: usize| format!("problem {problem}");
    let problems =
        Problems { starts, goals, streams, warm_start, share_rollouts, describe: &describe };
    plan(config, world, &problems, &|| Ok(()))
}

fn solve_one(config: &MpcConfig, start: [f32; 2], goal: [f32; 2]) -> Result<Plan> {
    let (starts, goals) = (Points(vec![start]), Points(vec![goal]));
    let mut plans = solve(config, &PointMass::new(), &starts, &goals, &[stream(0, 0)], None, true)?;
    Ok(plans.remove(0))
}

#[test]
fn reaches_a_goal_within_reach_and_saturates_towards_one_beyond() {
    let cem = CemConfig { iterations: 15, min_variance: 0.0, ..CemConfig::default() };
    let config = MpcConfig { cem, ..MpcConfig::default() };
    let near = solve_one(&config, [0.0, 0.0], [2.0, -1.0]).unwrap();
    assert!(near.cost < 1e-4, "{near:?}");
    // Five steps of at most 1 in each direction leave (4, 2) of (9, 7), squared distance 20.
    let far = solve_one(&config, [0.0, 0.0], [9.0, 7.0]).unwrap();
    assert!(far.cost >= 20.0 && far.cost < 20.5, "{far:?}");
    assert!(far.actions.iter().all(|action| *action <= 1.0 && *action > 0.9));
}

#[test]
fn predicted_cost_is_the_cost_of_the_returned_actions() {
    for action_repeat in [1, 2, 3] {
        let config = MpcConfig { horizon: 6, action_repeat, ..MpcConfig::default() };
        let plan = solve_one(&config, [0.5, 0.0], [1.0, 2.0]).unwrap();
        assert_eq!(plan.actions.dim(), (6, 2));
        let cost = PointMass::new().cost([0.5, 0.0], [1.0, 2.0], plan.actions.view());
        assert_eq!(plan.cost, cost);
        for held in plan.actions.as_slice().unwrap().chunks(2 * action_repeat) {
            assert!(held.chunks(2).all(|action| action == &held[..2]));
        }
    }
}

#[test]
fn a_sub_box_confines_the_first_iteration() {
    let initial = ActionInitial::Uniform { low: Some(vec![0.0, -1.0]), high: None };
    let cem = CemConfig { iterations: 1, ..CemConfig::default() };
    let config = MpcConfig { initial, cem, ..MpcConfig::default() };
    let plan = solve_one(&config, [0.0, 0.0], [-5.0, 0.0]).unwrap();
    assert!(plan.actions.column(0).iter().all(|x| *x >= 0.0));
}

#[test]
fn a_warm_start_continues_the_shifted_plan() {
    let cem = CemConfig { samples: 100, elites: 10, iterations: 1, ..CemConfig::default() };
    let config = MpcConfig { horizon: 3, warm_start_std: 1e-4, cem, ..MpcConfig::default() };
    let (starts, goals) = (Points(vec![[0.0; 2]]), Points(vec![[0.0; 2]]));
    let last = Array3::from_shape_vec((1, 3, 2), vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6]).unwrap();
    let world = PointMass::new();
    let plans =
        solve(&config, &world, &starts, &goals, &[stream(0, 0)], Some(&last), true).unwrap();
    for (value, expected) in plans[0].actions.iter().zip([0.3, 0.4, 0.5, 0.6, 0.5, 0.6]) {
        assert!((value - expected).abs() < 1e-3, "{plans:?}");
    }
}

/// A world whose box is so wide that nothing is clipped, with the box of `PointMass` for the first
/// iteration where that is uniform.
fn wide(config: &MpcConfig) -> (PointMass, MpcConfig) {
    let actions = ActionSpace::new(vec![-1e3; 2], vec![1e3; 2]).unwrap();
    let initial = match &config.initial {
        ActionInitial::Uniform { .. } => {
            ActionInitial::Uniform { low: Some(vec![-1.0; 2]), high: Some(vec![1.0; 2]) }
        }
        normal => normal.clone(),
    };
    (PointMass { actions, ..PointMass::new() }, MpcConfig { initial, clip: true, ..config.clone() })
}

#[test]
fn without_clipping_the_box_matters_to_the_first_uniform_iteration_only() {
    let goals = Points(vec![[9.0, -7.0], [0.5, 30.0], [0.1, 0.2]]);
    let starts = Points(vec![[0.0; 2]]);
    let streams = [stream(1, 0), stream(1, 1), stream(2, 5)];
    let last = Array3::from_shape_fn((3, 6, 2), |(b, h, a)| b as f32 + h as f32 * 0.7 - a as f32);
    for initial in [
        ActionInitial::Uniform { low: None, high: None },
        ActionInitial::Normal { mean: 0.5, std: 2.0 },
    ] {
        for warm_start in [None, Some(&last)] {
            let config = MpcConfig {
                horizon: 6,
                action_repeat: 2,
                initial: initial.clone(),
                clip: false,
                ..MpcConfig::default()
            };
            let run = |config: &MpcConfig, world: &PointMass| {
                solve(config, world, &starts, &goals, &streams, warm_start, true).unwrap()
            };
            let free = run(&config, &PointMass::new());
            let (world, wide) = wide(&config);
            assert_eq!(free, run(&wide, &world));
            assert!(free[0].actions.iter().any(|action| action.abs() > 1.0));
            let clipped = run(&MpcConfig { clip: true, ..config }, &PointMass::new());
            assert!(clipped[0].actions.iter().all(|action| action.abs() <= 1.0));
        }
    }
}

#[test]
fn one_start_and_one_seed_share_the_first_rollouts() {
    let config = MpcConfig::default();
    let starts = Points(vec![[0.0; 2]]);
    let goals = Points((0..20).map(|goal| [goal as f32 * 0.2, 1.0]).collect());
    let streams: Vec<Stream> = (0..20).map(|problem| stream(3, problem)).collect();
    let (shared, alone) = (PointMass::new(), PointMass::new());
    let with = solve(&config, &shared, &starts, &goals, &streams, None, true).unwrap();
    let without = solve(&config, &alone, &starts, &goals, &streams, None, false).unwrap();
    assert_eq!(with, without);
    assert_eq!(alone.rollouts.get() - shared.rollouts.get(), 19 * 200);
}

#[test]
fn different_seeds_do_not_share() {
    let starts = Points(vec![[0.0; 2]]);
    let goals = Points(vec![[1.0; 2], [1.0; 2]]);
    let streams = [stream(1, 0), stream(2, 0)];
    let plans =
        solve(&MpcConfig::default(), &PointMass::new(), &starts, &goals, &streams, None, true);
    let plans = plans.unwrap();
    assert_ne!(plans[0].actions, plans[1].actions);
}

#[test]
fn all_nan_names_the_problem_and_the_method() {
    let mut world = PointMass::new();
    world.nan_at = Some(2.0);
    let starts = Points(vec![[0.0; 2]; 3]);
    let goals = Points(vec![[1.0; 2], [1.5; 2], [2.0; 2]]);
    let streams = [stream(0, 0); 3];
    let error =
        solve(&MpcConfig::default(), &world, &starts, &goals, &streams, None, true).unwrap_err();
    let error = error.to_string();
    assert!(error.contains("rollout_costs for problem 2"), "{error}");
}

#[test]
fn interrupts_stop_between_calls() {
    let world = PointMass::new();
    let frames = Points(vec![[0.0; 2]]);
    let problems = Problems {
        starts: &frames,
        goals: &frames,
        streams: &[stream(0, 0)],
        warm_start: None,
        share_rollouts: true,
        describe: &|_| String::new(),
    };
    let stop = || if world.calls.get() == 2 { Err(Error::Interrupted) } else { Ok(()) };
    let cem = CemConfig { min_variance: 0.0, ..CemConfig::default() };
    let config = MpcConfig { cem, ..MpcConfig::default() };
    let error = plan(&config, &world, &problems, &stop).unwrap_err();
    assert!(matches!(error, Error::Interrupted));
    assert_eq!(world.calls.get(), 2);
}

#[test]
fn fields_out_of_range_are_named() {
    let good = MpcConfig::default();
    let uniform = |low: Vec<f64>, high: Vec<f64>| MpcConfig {
        initial: ActionInitial::Uniform { low: Some(low), high: Some(high) },
        ..good.clone()
    };
    let normal =
        |mean, std| MpcConfig { initial: ActionInitial::Normal { mean, std }, ..good.clone() };
    for (field, config) in [
        ("horizon", MpcConfig { horizon: 0, ..good.clone() }),
        ("horizon", MpcConfig { horizon: 200_000, ..good.clone() }),
        ("samples", MpcConfig { horizon: 1 << 40, action_repeat: 1 << 40, ..good.clone() }),
        ("action_repeat", MpcConfig { action_repeat: 0, ..good.clone() }),
        ("action_repeat", MpcConfig { action_repeat: 2, ..good.clone() }),
        ("warm_start_std", MpcConfig { warm_start_std: 0.0, ..good.clone() }),
        ("initial_std", normal(0.0, -1.0)),
        ("initial_mean", normal(f64::NAN, 1.0)),
        ("initial_low", uniform(vec![-2.0, 0.0], vec![1.0, 1.0])),
        ("initial_low", uniform(vec![0.5, 0.0], vec![0.0, 1.0])),
        ("initial_low", uniform(vec![f64::NAN, 0.0], vec![0.0, 1.0])),
        ("initial_low", uniform(vec![0.0], vec![1.0, 1.0])),
        ("initial_high", uniform(vec![0.0, 0.0], vec![1.0])),
    ] {
        let error = solve_one(&config, [0.0; 2], [1.0; 2]).unwrap_err().to_string();
        assert!(error.starts_with(field), "{field}: {error}");
    }
}

#[test]
fn batches_that_disagree_are_named() {
    let config = MpcConfig::default();
    let world = PointMass::new();
    let points = |count: usize| Points(vec![[0.0; 2]; count]);
    let wrong = |starts, goals, streams, warm: Option<Array3<f32>>| {
        let streams = vec![stream(0, 0); streams];
        let starts: Points = points(starts);
        solve(&config, &world, &starts, &points(goals), &streams, warm.as_ref(), true)
            .unwrap_err()
            .to_string()
    };
    assert!(wrong(1, 0, 0, None).starts_with("goals"));
    assert!(wrong(2, 3, 3, None).starts_with("starts"));
    assert!(wrong(3, 3, 2, None).starts_with("seeds"));
    assert!(wrong(2, 2, 2, Some(Array3::zeros((2, 4, 2)))).starts_with("warm_start"));
    let nan = Array3::from_elem((2, 5, 2), f32::NAN);
    assert!(wrong(2, 2, 2, Some(nan)).starts_with("warm_start"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_plan_depends_neither_on_its_batch_nor_on_threads_nor_on_the_calls(
        seed: u64,
        problems in 1usize..60,
        threads in 1usize..5,
        max_candidates in 1usize..2000,
    ) {
        let cem = CemConfig { samples: 60, elites: 9, ..CemConfig::default() };
        let config = MpcConfig { cem, ..MpcConfig::default() };
        let start = |b: usize| [b as f32 * 0.1, -0.3];
        let goal = |b: usize| [1.0, b as f32 * 0.4];
        let starts = Points((0..problems).map(start).collect());
        let goals = Points((0..problems).map(goal).collect());
        let streams: Vec<Stream> = (0..problems as u64).map(|b| stream(seed, b)).collect();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let batch = pool.install(|| {
            let mut world = PointMass::new();
            world.max_candidates = max_candidates;
            solve(&config, &world, &starts, &goals, &streams, None, true).unwrap()
        });
        for (b, expected) in batch.iter().enumerate().step_by(7) {
            let (starts, goals) = (Points(vec![start(b)]), Points(vec![goal(b)]));
            let world = PointMass::new();
            let alone =
                solve(&config, &world, &starts, &goals, &[streams[b]], None, true).unwrap();
            prop_assert_eq!(&alone[0], expected);
        }
    }
}

/// One plan, and every candidate that the world was asked about, `[I, D, H, A]` flattened.
fn watched(config: &MpcConfig, warm_start: Option<WarmStart<'_>>) -> Result<(Plan, Vec<f32>)> {
    let world = Watched { inner: PointMass::new(), seen: RefCell::default() };
    let (starts, goals) = (Points(vec![[0.0; 2]]), Points(vec![[2.0, -1.0]]));
    let problems = Problems {
        starts: &starts,
        goals: &goals,
        streams: &[stream(4, 0)],
        warm_start,
        share_rollouts: true,
        describe: &|problem| format!("problem {problem}"),
    };
    let plan = plan(config, &world, &problems, &|| Ok(()))?.remove(0);
    Ok((plan, world.seen.into_inner()))
}

/// A point mass that remembers its candidates.
struct Watched {
    inner: PointMass,
    seen: RefCell<Vec<f32>>,
}

impl WorldModel for Watched {
    type Frames = Points;

    fn action_space(&self) -> &ActionSpace {
        self.inner.action_space()
    }

    fn rollout_costs(
        &self,
        starts: &Points,
        goals: &Points,
        candidates: Candidates,
    ) -> Result<Array2<f32>> {
        self.seen.borrow_mut().extend(candidates.actions.iter());
        self.inner.rollout_costs(starts, goals, candidates)
    }
}

#[test]
fn elites_of_a_plan_are_the_best_candidates_of_its_last_iteration() {
    let cem = CemConfig { iterations: 2, ..CemConfig::default() };
    let config =
        MpcConfig { shift_elites: 3, horizon: 4, action_repeat: 2, cem, ..MpcConfig::default() };
    let (plan, seen) = watched(&config, None).unwrap();
    let cost = |actions: &[f32]| {
        let actions = ArrayView2::from_shape((4, 2), actions).unwrap();
        PointMass::new().cost([0.0; 2], [2.0, -1.0], actions)
    };
    let mut last: Vec<&[f32]> = seen[200 * 8..].chunks(8).collect();
    last.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
    assert_eq!(plan.elites.dim(), (3, 4, 2));
    assert_eq!(plan.elites.as_slice().unwrap(), last[..3].concat());
}

#[test]
fn a_warm_start_begins_with_the_shifted_elites() {
    let config = MpcConfig { shift_elites: 2, horizon: 3, ..MpcConfig::default() };
    let (before, _) = watched(&config, None).unwrap();
    let [actions, elites] = [before.actions.clone().into_dyn(), before.elites.clone().into_dyn()];
    let actions = actions.insert_axis(Axis(0)).into_dimensionality().unwrap();
    let elites = elites.insert_axis(Axis(0)).into_dimensionality().unwrap();
    let warm = WarmStart { actions: &actions, elites: Some(&elites) };
    let (with, seen) = watched(&config, Some(warm)).unwrap();
    for (elite, candidate) in before.elites.outer_iter().zip(seen.chunks(6)) {
        let steps: Vec<f32> = [1, 2, 2].iter().flat_map(|&step| elite.row(step).to_vec()).collect();
        assert_eq!(candidate, steps);
    }
    // The others are drawn as without.
    let (without, plain) = watched(&config, Some(WarmStart::from(&actions))).unwrap();
    assert_eq!(seen[12..200 * 6], plain[12..200 * 6]);
    assert_eq!(with.elites.dim(), without.elites.dim());
    let fewer = MpcConfig { shift_elites: 1, ..config.clone() };
    let error = watched(&fewer, Some(warm)).unwrap_err().to_string();
    assert!(error.starts_with("warm_elites: must have shape [1, S, 3, 2] with S up to"), "{error}");
    let nan = elites.mapv(|_| f32::NAN);
    let error = watched(&config, Some(WarmStart { elites: Some(&nan), ..warm }));
    assert!(error.unwrap_err().to_string().starts_with("warm_elites: must be finite"));
}

#[test]
fn coloured_actions_change_slowly_and_stay_in_the_box() {
    let roughness = |noise_beta: f64| {
        let config = MpcConfig { noise_beta, horizon: 10, ..MpcConfig::default() };
        let (_, seen) = watched(&config, None).unwrap();
        assert!(seen.iter().all(|action| action.abs() <= 1.0));
        let first = seen[..200 * 20].chunks(20);
        first.flat_map(|row| (2..20).map(|n| (row[n] - row[n - 2]).powi(2))).sum::<f32>()
    };
    assert!(roughness(2.0) < 0.5 * roughness(0.0));
}

#[test]
fn options_over_time_are_checked() {
    let named = |config: MpcConfig, expected: &str| {
        let error = config.validate().unwrap_err().to_string();
        assert!(error.starts_with(expected), "{error}");
    };
    let good = MpcConfig::default;
    for noise_beta in [-1.0, f64::NAN, f64::INFINITY] {
        named(MpcConfig { noise_beta, ..good() }, "noise_beta: must be finite");
    }
    named(MpcConfig { noise_beta: 1.0, horizon: 257, ..good() }, "noise_beta: is for at most 256");
    let covariance = Covariance::Full { shrinkage: 0.1 };
    let cem = CemConfig { covariance, ..CemConfig::default() };
    named(MpcConfig { noise_beta: 1.0, cem, ..good() }, "noise_beta: must be 0 with covariance");
    named(MpcConfig { shift_elites: 41, ..good() }, "shift_elites: must be at most elites (40)");
}

#[test]
fn the_short_method_is_the_plan_of_one_problem() {
    let config = MpcConfig::default();
    let (start, goal) = (Points(vec![[0.5, 0.0]]), Points(vec![[2.0, -1.0]]));
    let world = PointMass::new();
    let expected = solve(&config, &world, &start, &goal, &[stream(7, 0)], None, true).unwrap();
    assert_eq!(config.plan(&world, &start, &goal, 7).unwrap(), expected[0]);
    let two = Points(vec![[0.0; 2]; 2]);
    let said = config.plan(&world, &two, &goal, 7).unwrap_err().to_string();
    assert_eq!(said, "start: must be one frame, got 2");
    let said = config.plan(&world, &start, &two, 7).unwrap_err().to_string();
    assert_eq!(said, "goal: must be one frame, got 2");
}
