//! What a world may have beyond costs: a preparation of starts and goals, and noise from seeds.
#![allow(clippy::unwrap_used)]

use std::cell::RefCell;

use ndarray::{Array2, Array3};
use proptest::prelude::*;

use super::model::{ActionSpace, Candidates, Frames, SharedCandidates, SubgoalModel, WorldModel};
use super::mpc::{plan, MpcConfig, Plan, Problems};
use super::point_mass::{noise, PointMass, Points, Positions};
use super::sampler::{Purpose, Stream};
use super::search::{search, HvfConfig, Reduction, SearchResult, Watch};
use super::CemConfig;
use crate::Result;

fn small() -> MpcConfig {
    let cem = CemConfig { samples: 40, elites: 6, iterations: 4, ..CemConfig::default() };
    MpcConfig { horizon: 3, cem, ..MpcConfig::default() }
}

fn small_search(subgoals: usize) -> HvfConfig {
    let cem = CemConfig { samples: 24, elites: 5, iterations: 3, ..CemConfig::default() };
    HvfConfig { mpc: small(), subgoals, cem, ..HvfConfig::default() }
}

fn solve<W: WorldModel>(
    config: &MpcConfig,
    world: &W,
    starts: &W::Frames,
    goals: &W::Frames,
    streams: &[Stream],
    share_rollouts: bool,
) -> Result<Vec<Plan>> {
    let problems = Problems {
        starts,
        goals,
        streams,
        warm_start: None,
        share_rollouts,
        describe: &|problem| format!("problem {problem}"),
    };
    plan(config, world, &problems, &|| Ok(()))
}

fn streams(seed: u64, problems: usize) -> Vec<Stream> {
    let stream = |problem| Stream { seed, purpose: Purpose::Actions, problem };
    (0..problems as u64).map(stream).collect()
}

fn goals(count: usize) -> Points {
    Points((0..count).map(|b| [0.3 * b as f32, 1.0 - 0.2 * b as f32]).collect())
}

fn found(config: &HvfConfig, world: &PointMass, seed: u64) -> SearchResult<Points> {
    let (start, goal) = (Points(vec![[0.0; 2]]), Points(vec![[6.0, 3.0]]));
    search(config, world, &Positions::new(), &start, &goal, seed, Watch::nobody()).unwrap()
}

#[test]
fn frames_are_prepared_once_for_all_iterations_calls_and_converged_problems() {
    for (starts, share, max_candidates) in [(1, true, 1 << 16), (1, true, 80), (9, false, 40)] {
        let starts = Points(vec![[0.1, 0.2]; starts]);
        let mut world = PointMass { prepares: true, ..PointMass::new() };
        world.max_candidates = max_candidates;
        let mut config = small();
        config.cem = CemConfig { iterations: 30, min_variance: 0.02, ..config.cem };
        let prepared = solve(&config, &world, &starts, &goals(9), &streams(5, 9), share).unwrap();
        assert_eq!(world.prepared.borrow().as_slice(), [(starts.len(), 9)]);
        let plain =
            solve(&config, &PointMass::new(), &starts, &goals(9), &streams(5, 9), share).unwrap();
        assert_eq!(prepared, plain);
        let iterations: Vec<usize> = plain.iter().map(|plan| plan.history.len()).collect();
        assert!(iterations.iter().min() < iterations.iter().max(), "{iterations:?}");
    }
}

#[test]
fn a_search_prepares_once_per_batch_of_segments() {
    let config = HvfConfig { prune: false, ..small_search(2) };
    let world = PointMass { prepares: true, ..PointMass::new() };
    let with = found(&config, &world, 3);
    // Three iterations of three segments of 24 samples: the first ones have one start.
    assert_eq!(world.prepared.borrow().as_slice(), [(1, 24), (48, 48)].repeat(3));
    let plain = found(&config, &PointMass::new(), 3);
    assert_eq!((&with.latents, &with.plans), (&plain.latents, &plain.plans));
    let world = PointMass { prepares: true, ..PointMass::new() };
    let together = found(&HvfConfig { share_rollouts: false, ..config }, &world, 3);
    assert_eq!(world.prepared.borrow().as_slice(), [(72, 72)].repeat(3));
    // One call for each iteration of their plans.
    let iterations = together.history.len() * 4;
    assert!(world.calls.get() <= iterations, "{} calls", world.calls.get());
    assert_eq!((with.latents, with.plans), (together.latents, together.plans));
    // Pruning asks for all segments too, and needs no other preparation.
    let world = PointMass { prepares: true, ..PointMass::new() };
    found(&small_search(2), &world, 3);
    assert_eq!(world.prepared.borrow().as_slice(), [(1, 24), (48, 48)].repeat(3));
}

#[test]
fn calls_filled_up_have_few_sizes_and_change_nothing() {
    for (shares, noisy, most) in [(true, false, 1 << 16), (false, true, 24 * 40), (true, true, 90)]
    {
        let mut config = small_search(3);
        config.mpc.cem = CemConfig { iterations: 12, min_variance: 0.02, ..config.mpc.cem };
        let world = PointMass { shares, noisy, max_candidates: most, ..PointMass::new() };
        let plain = found(&config, &world, 3);
        let ordinary = distinct(&world);
        let world =
            PointMass { pads: true, shares, noisy, max_candidates: most, ..PointMass::new() };
        let filled = found(&config, &world, 3);
        assert_eq!((plain.latents, plain.plans), (filled.latents, filled.plans));
        assert_eq!(plain.history, filled.history);
        let sizes = distinct(&world);
        // Probes have 2 candidates, plans 40.
        let fits = |size: &usize| size.is_power_of_two() || *size == most / 40 || *size == most / 2;
        assert!(sizes.iter().all(fits), "{sizes:?}");
        assert!(most < 100 || sizes.len() < ordinary.len(), "{sizes:?} and {ordinary:?}");
    }
}

fn distinct(world: &PointMass) -> Vec<usize> {
    let mut sizes = world.sizes.take();
    sizes.sort_unstable();
    sizes.dedup();
    sizes
}

/// Points that cannot be joined.
#[derive(Clone, Debug, PartialEq)]
struct Apart(Points);

impl Frames for Apart {
    fn len(&self) -> usize {
        self.0.len()
    }

    fn select(&self, index: &[usize]) -> Result<Self> {
        self.0.select(index).map(Self)
    }
}

/// The point mass with such frames; counts its calls.
struct Split(PointMass);

impl WorldModel for Split {
    type Frames = Apart;

    fn action_space(&self) -> &ActionSpace {
        &self.0.actions
    }

    fn rollout_costs(
        &self,
        starts: &Apart,
        goals: &Apart,
        candidates: Candidates,
    ) -> Result<Array2<f32>> {
        self.0.rollout_costs(&starts.0, &goals.0, candidates)
    }
}

impl SubgoalModel<Apart> for Positions {
    fn latent_dim(&self) -> usize {
        3
    }

    fn decode(&self, scene: &Apart, latents: Array3<f32>) -> Result<Apart> {
        self.decode(&scene.0, latents).map(Apart)
    }
}

#[test]
fn frames_that_cannot_be_joined_are_planned_part_by_part() {
    for (prune, share_rollouts) in [(true, true), (false, true), (true, false), (false, false)] {
        let config = HvfConfig { prune, share_rollouts, ..small_search(3) };
        let (start, goal) = (Points(vec![[0.0; 2]]), Points(vec![[6.0, 3.0]]));
        let world = Split(PointMass::new());
        let (from, to) = (Apart(start), Apart(goal));
        let apart = config.search(&world, &Positions::new(), &from, &to, 7).unwrap();
        let joined = found(&config, &PointMass::new(), 7);
        assert_eq!((apart.subgoals.0, apart.latents), (joined.subgoals, joined.latents));
        assert_eq!((apart.plans, apart.history), (joined.plans, joined.history));
    }
}

#[test]
fn frames_that_are_too_many_after_preparation_are_an_error() {
    let world = PointMass { prepares: true, prepares_too_many: 2, ..PointMass::new() };
    let error = solve(&small(), &world, &goals(3), &goals(3), &streams(0, 3), true)
        .unwrap_err()
        .to_string();
    assert!(error.contains("prepare must give") && error.contains("got 3 and 5"), "{error}");
}

/// Frames that do not exist before they are prepared, and belong to pairs.
#[derive(Clone)]
enum Encoded {
    Raw(Points),
    Differences(Points),
}

impl Frames for Encoded {
    fn len(&self) -> usize {
        match self {
            Self::Raw(points) | Self::Differences(points) => points.len(),
        }
    }

    fn select(&self, index: &[usize]) -> Result<Self> {
        match self {
            Self::Raw(points) => points.select(index).map(Self::Raw),
            Self::Differences(points) => points.select(index).map(Self::Differences),
        }
    }
}

/// Scores against the difference of goal and start, which it takes before planning.
struct Pairwise(PointMass);

impl WorldModel for Pairwise {
    type Frames = Encoded;

    fn action_space(&self) -> &ActionSpace {
        &self.0.actions
    }

    fn prepare(&self, starts: &Encoded, goals: &Encoded) -> Result<Option<(Encoded, Encoded)>> {
        let (Encoded::Raw(start), Encoded::Raw(goal)) = (starts, goals) else {
            panic!("prepared twice");
        };
        let pairs = goal.0.iter().enumerate().map(|(b, goal)| {
            let start = start.0[b.min(start.0.len() - 1)];
            [goal[0] - start[0], goal[1] - start[1]]
        });
        Ok(Some((starts.clone(), Encoded::Differences(Points(pairs.collect())))))
    }

    fn rollout_costs(
        &self,
        starts: &Encoded,
        goals: &Encoded,
        candidates: Candidates,
    ) -> Result<Array2<f32>> {
        let Encoded::Differences(goals) = goals else { panic!("not prepared") };
        self.0.rollout_costs(&Points(vec![[0.0; 2]; starts.len()]), goals, candidates)
    }

    fn shared_rollout_costs(
        &self,
        _: &Encoded,
        goals: &Encoded,
        candidates: SharedCandidates,
    ) -> Option<Result<Array2<f32>>> {
        let Encoded::Differences(goals) = goals else { panic!("not prepared") };
        self.0.shared_rollout_costs(&Points(vec![[0.0; 2]]), goals, candidates)
    }
}

#[test]
fn a_prepared_goal_may_hold_what_belongs_to_its_pair() {
    for starts in [vec![[0.5, -0.5]], (0..6).map(|b| [b as f32, 0.5]).collect()] {
        let world = Pairwise(PointMass::new());
        let (raw, to) = (Encoded::Raw(Points(starts.clone())), Encoded::Raw(goals(6)));
        let plans = solve(&small(), &world, &raw, &to, &streams(2, 6), true).unwrap();
        let differences = (0..6).map(|b| {
            let (start, goal) = (starts[b.min(starts.len() - 1)], goals(6).0[b]);
            [goal[0] - start[0], goal[1] - start[1]]
        });
        let from = Points(vec![[0.0; 2]]);
        let to = Points(differences.collect());
        let expected = solve(&small(), &PointMass::new(), &from, &to, &streams(2, 6), true);
        assert_eq!(plans, expected.unwrap());
    }
}

/// Remembers the seeds of every call beside the actions.
struct Recording {
    inner: PointMass,
    seen: RefCell<Vec<Candidates>>,
}

impl WorldModel for Recording {
    type Frames = Points;

    fn action_space(&self) -> &ActionSpace {
        &self.inner.actions
    }

    fn uses_seeds(&self) -> bool {
        self.inner.noisy
    }

    fn rollout_costs(
        &self,
        starts: &Points,
        goals: &Points,
        candidates: Candidates,
    ) -> Result<Array2<f32>> {
        self.seen.borrow_mut().push(candidates.clone());
        self.inner.rollout_costs(starts, goals, candidates)
    }
}

#[test]
fn seeds_are_shared_with_the_candidates_and_new_afterwards() {
    let world = Recording {
        inner: PointMass { noisy: true, ..PointMass::new() },
        seen: RefCell::new(Vec::new()),
    };
    let mut config = small();
    config.cem.min_variance = 0.0;
    solve(&config, &world, &goals(3), &goals(3), &streams(8, 3), true).unwrap();
    let mut all: Vec<i64> = Vec::new();
    for (iteration, candidates) in world.seen.take().into_iter().enumerate() {
        let seeds = candidates.seeds.unwrap();
        assert_eq!(seeds.dim(), (3, 40));
        let equal = seeds.row(0) == seeds.row(1) && seeds.row(0) == seeds.row(2);
        assert_eq!(equal, iteration == 0);
        let rows = if iteration == 0 { 1 } else { 3 };
        all.extend(seeds.iter().take(40 * rows));
    }
    assert_eq!(all.len(), 40 * (1 + 3 * 3));
    all.sort_unstable();
    all.dedup();
    assert_eq!(all.len(), 40 * (1 + 3 * 3), "a seed came twice");
}

#[test]
fn seeds_are_not_drawn_where_they_are_not_asked_for() {
    let world = Recording { inner: PointMass::new(), seen: RefCell::new(Vec::new()) };
    solve(&small(), &world, &goals(3), &goals(3), &streams(8, 3), true).unwrap();
    assert!(world.seen.take().iter().all(|candidates| candidates.seeds.is_none()));
}

#[test]
fn the_predicted_cost_is_of_the_noise_that_was_drawn() {
    let world = Recording {
        inner: PointMass { noisy: true, ..PointMass::new() },
        seen: RefCell::new(Vec::new()),
    };
    let start = Points(vec![[0.0; 2]]);
    let plans = solve(&small(), &world, &start, &goals(1), &streams(4, 1), true).unwrap();
    let mut least = f32::INFINITY;
    for Candidates { actions, seeds } in world.seen.take() {
        for (d, actions) in actions.index_axis(ndarray::Axis(0), 0).outer_iter().enumerate() {
            let noise = noise(seeds.as_ref().unwrap()[[0, d]]);
            least = least.min(world.inner.cost([0.0; 2], goals(1).0[0], actions) + noise);
        }
    }
    assert_eq!(plans[0].cost, least);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn a_stochastic_plan_depends_on_its_seed_only(
        seed: u64,
        problems in 1usize..40,
        threads in 1usize..5,
        max_candidates in 1usize..2000,
        shares: bool,
        prepares: bool,
    ) {
        let starts = Points(vec![[0.1, -0.3]]);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let batch = pool.install(|| {
            let world =
                PointMass { noisy: true, max_candidates, shares, prepares, ..PointMass::new() };
            solve(&small(), &world, &starts, &goals(problems), &streams(seed, problems), true)
                .unwrap()
        });
        for (b, expected) in batch.iter().enumerate().step_by(5) {
            let goal = Points(vec![goals(problems).0[b]]);
            let stream = [streams(seed, problems)[b]];
            let world = PointMass { noisy: true, ..PointMass::new() };
            let alone = solve(&small(), &world, &starts, &goal, &stream, false).unwrap();
            prop_assert_eq!(&alone[0], expected);
        }
    }

    #[test]
    fn a_stochastic_search_is_the_same_with_its_savings(
        seed: u64,
        subgoals in 0usize..3,
        reduction in prop::sample::select(&[Reduction::Max, Reduction::Mean, Reduction::MaxSum]),
        prune: bool,
        shares: bool,
        max_candidates in 1usize..3000,
    ) {
        let plain = HvfConfig {
            prune: false, share_rollouts: false, reduction, ..small_search(subgoals)
        };
        let expected = found(&plain, &PointMass { noisy: true, ..PointMass::new() }, seed);
        let world = PointMass {
            noisy: true, prepares: true, shares, max_candidates, ..PointMass::new()
        };
        let with = HvfConfig { prune, reduction, ..small_search(subgoals) };
        let found = found(&with, &world, seed);
        prop_assert_eq!(found.cost.to_bits(), expected.cost.to_bits());
        prop_assert_eq!(found.latents, expected.latents);
        prop_assert_eq!(found.plans, expected.plans);
    }
}
