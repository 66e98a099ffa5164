//! Planner throughput: the cross-entropy method's own work (sampling, selection, refit) with an
//! objective that costs nothing, and the time of searches and plans with the true simulator as it
//! grows with `M`, `D`, `K` and `H`.
#![allow(clippy::unwrap_used)]

use criterion::{criterion_group, criterion_main, Criterion, Throughput};
use hvf_core::maze::{Difficulty, Episode, MazeFrames, MazeSubgoals, MazeWorld, MazeWorldConfig};
use hvf_core::planner::cem::distribution::{Bounds, Initial, Space, Start};
use hvf_core::planner::cem::{minimise, Call, CemConfig, Objective};
use hvf_core::planner::mpc::plan;
use hvf_core::planner::sampler::{Purpose, Stream};
use hvf_core::planner::{search, HvfConfig, MpcConfig, Problems, Watch};
use hvf_core::Result;
use ndarray::{Array2, Array3};

const PROBLEMS: usize = 600;
const DIMENSIONS: usize = 10;

/// Costs fixed beforehand, whatever the candidates.
struct Free {
    costs: Array2<f32>,
}

impl Objective for Free {
    fn costs(&mut self, _call: Call<'_>, _candidates: Array3<f32>) -> Result<Array2<f32>> {
        Ok(self.costs.clone())
    }
}

fn cem_own_work(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("cem_own_work");
    group.sample_size(20);
    let mut config = CemConfig::default();
    config.min_variance = 0.0;
    let costs = Array2::from_shape_fn((PROBLEMS, config.samples), |(problem, sample)| {
        ((problem * 7919 + sample * 104_729) % 100_003) as f32
    });
    let bounds = Bounds { low: vec![-3.0; DIMENSIONS], high: vec![3.0; DIMENSIONS] };
    let streams: Vec<Stream> = (0..PROBLEMS as u64)
        .map(|problem| Stream { seed: 0, purpose: Purpose::Actions, problem })
        .collect();
    let uniform: Start =
        Initial::Uniform { low: bounds.low.clone(), high: bounds.high.clone() }.into();
    let space = Space::from(bounds);
    let candidates = PROBLEMS * config.samples * config.iterations;
    group.throughput(Throughput::Elements(candidates as u64));
    group.bench_function("600_problems_x_200_samples_x_10_dims", |bencher| {
        let mut objective = Free { costs: costs.clone() };
        bencher.iter(|| {
            minimise(&config, &space, std::slice::from_ref(&uniform), &streams, &mut objective)
        });
    });
    group.finish();
}

/// Start and goal of one hard episode.
fn hard_episode() -> (MazeFrames, MazeFrames) {
    let episode = Episode::new(0, 0, Difficulty::Hard);
    let frames = |state| MazeFrames::from_states(vec![state], 64);
    (frames(episode.start), frames(episode.goal()))
}

/// One visual MPC step at the paper's budget: what acting repeats in every step.
fn visual_mpc(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("visual_mpc");
    let (start, goal) = hard_episode();
    for (name, blur) in [("plain", 0.0), ("blur_3", 3.0)] {
        let world = MazeWorld::new(MazeWorldConfig { blur, ..Default::default() }).unwrap();
        let problems = Problems {
            starts: &start,
            goals: &goal,
            streams: &[Stream { seed: 0, purpose: Purpose::Actions, problem: 0 }],
            warm_start: None,
            share_rollouts: true,
            describe: &|problem| format!("problem {problem}"),
        };
        group.bench_function(name, |bencher| {
            bencher.iter(|| plan(&MpcConfig::default(), &world, &problems, &|| Ok(())).unwrap());
        });
    }
    group.finish();
}

/// Full-budget subgoal searches (`K = 2`, `M = D = 200`, `H = 5`, 5 x 5 iterations), and with one
/// of these changed at a time.
fn subgoal_search(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("subgoal_search");
    group.sample_size(10);
    let (start, goal) = hard_episode();
    let world = MazeWorld::new(MazeWorldConfig::default()).unwrap();
    let generator = MazeSubgoals::default();
    let full = HvfConfig::default();
    let with = |change: fn(&mut HvfConfig)| {
        let mut config = full.clone();
        change(&mut config);
        config
    };
    let cases = [
        ("full_budget", full.clone()),
        (
            "full_budget_nothing_saved",
            with(|config| (config.prune, config.share_rollouts) = (false, false)),
        ),
        ("m_100", with(|config| config.cem.samples = 100)),
        ("m_400", with(|config| config.cem.samples = 400)),
        ("d_100", with(|config| config.mpc.cem.samples = 100)),
        ("d_400", with(|config| config.mpc.cem.samples = 400)),
        ("k_1", with(|config| config.subgoals = 1)),
        ("k_3", with(|config| config.subgoals = 3)),
        ("h_10", with(|config| config.mpc.horizon = 10)),
        ("h_15", with(|config| config.mpc.horizon = 15)),
    ];
    for (name, config) in cases {
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                search(&config, &world, &generator, &start, &goal, 0, Watch::nobody()).unwrap()
            });
        });
    }
    group.finish();
}

criterion_group!(benches, cem_own_work, visual_mpc, subgoal_search);
criterion_main!(benches);
