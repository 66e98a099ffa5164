//! The learned maze world at the README's settings: candidates per second, and a search through it.
//!
//! The cell has the size of the shipped model's and random weights, about half of its hidden units
//! at rest as there; the sprite is the shipped one. `default` is blur 3 and the minimum over the
//! horizon, `paper` is no blur and the last frame. `RAYON_NUM_THREADS=1` gives the rate of one core.
#![allow(clippy::unwrap_used)]

use criterion::{criterion_group, criterion_main, BenchmarkId, Criterion, Throughput};
use hvf_core::image::OverHorizon;
use hvf_core::keypoint::{Cell, CellWeights, KeypointFrames, KeypointWorld, Sprite};
use hvf_core::planner::mpc::plan;
use hvf_core::planner::sampler::{Purpose, Stream};
use hvf_core::planner::{
    search, ActionSpace, Frames, HvfConfig, MpcConfig, Problems, SubgoalModel, Watch, WorldModel,
};
use hvf_core::Result;
use ndarray::{Array1, Array2, Array3, Array4, Dimension, ShapeBuilder};

const SIZE: usize = 64;
const HIDDEN: usize = 48;
const MEMORY: usize = 6;
/// Candidates of a problem, problems, and steps.
const D: usize = 200;
const B: usize = 40;
const H: usize = 5;
const SPRITE: Sprite =
    Sprite { half_size: [2.4993, 2.4993], edge: [1.0438, 1.0356], colour: [0.14, 0.64, -0.01] };

struct Draws(u64);

impl Draws {
    fn between(&mut self, low: f32, high: f32) -> f32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        low + (high - low) * ((self.0 >> 40) as f32 / (1_u64 << 24) as f32)
    }

    fn array<N: Dimension>(
        &mut self,
        shape: impl ShapeBuilder<Dim = N>,
        scale: f32,
    ) -> ndarray::Array<f32, N> {
        ndarray::Array::from_shape_simple_fn(shape, || self.between(-scale, scale))
    }
}

fn world(blur: f64, over_horizon: OverHorizon) -> KeypointWorld {
    let mut draws = Draws(1);
    let patch: Array2<f32> = draws.array((HIDDEN, 49), 0.3);
    let context: Array2<f32> = draws.array((HIDDEN, 2 + MEMORY), 0.8);
    let middle: Array2<f32> = draws.array((HIDDEN, HIDDEN), 0.35);
    let output: Array2<f32> = draws.array((2 + MEMORY, HIDDEN), 0.05);
    let bias: Array1<f32> = draws.array(HIDDEN, 0.1);
    let mut free = Array2::zeros((2, 2));
    (free[[0, 1]], free[[1, 0]]) = (-1.0, 1.0);
    let cell = Cell::new(CellWeights {
        patch: patch.view(),
        patch_bias: bias.view(),
        context: context.view(),
        middle: middle.view(),
        middle_bias: bias.view(),
        output: output.view(),
        output_bias: Array1::zeros(2 + MEMORY).view(),
        free: free.view(),
        action_scale: 3.0,
        spacing: 2,
        substeps: 4,
    });
    let actions = ActionSpace::new(vec![-3.0; 2], vec![3.0; 2]).unwrap();
    KeypointWorld::new(cell.unwrap(), SPRITE, actions, SIZE, blur, over_horizon).unwrap()
}

/// The sprite at `keypoints` on a plain floor.
fn images(keypoints: &Array2<f32>) -> Array4<u8> {
    let mut images = Array4::zeros((keypoints.nrows(), SIZE, SIZE, 3));
    for (mut image, at) in images.outer_iter_mut().zip(keypoints.rows()) {
        let mut drawn = vec![0.3; SIZE * SIZE * 3];
        SPRITE.draw([at[0], at[1]], 1.0, &mut drawn, SIZE);
        image.iter_mut().zip(drawn).for_each(|(byte, x)| *byte = (255.0 * x) as u8);
    }
    images
}

/// One frame of a scene with walls.
fn scene(world: &KeypointWorld) -> KeypointFrames {
    let at = Array2::from_elem((1, 2), 20.0);
    let map = Array3::from_shape_fn((1, SIZE, SIZE), |(_, row, column)| {
        f32::from((20..24).contains(&column) && !(30..40).contains(&row))
    });
    world.frames(images(&at).view(), at.view(), map.view()).unwrap()
}

/// Subgoals in the middle of the scene, by their latents.
struct Anywhere;

impl SubgoalModel<KeypointFrames> for Anywhere {
    fn latent_dim(&self) -> usize {
        2
    }

    fn decode(&self, scene: &KeypointFrames, latents: Array3<f32>) -> Result<KeypointFrames> {
        let (samples, subgoals, _) = latents.dim();
        let at = latents.into_shape_with_order((samples * subgoals, 2)).unwrap();
        let at = at.mapv(|latent| 32.0 + 8.0 * latent.clamp(-3.0, 3.0));
        scene.moved(images(&at).view(), at.view())
    }
}

fn keypoint(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("keypoint");
    for (name, blur, over_horizon) in
        [("default", 3.0, OverHorizon::Min), ("paper", 0.0, OverHorizon::Last)]
    {
        let world = world(blur, over_horizon);
        let start = scene(&world);
        let mut draws = Draws(2);
        let frames = Anywhere.decode(&start, draws.array((D, 1, 2), 2.0)).unwrap();
        let starts = frames.select(&(0..B).collect::<Vec<_>>()).unwrap();
        let goals = frames.select(&(B..2 * B).collect::<Vec<_>>()).unwrap();
        let candidates: Array4<f32> = draws.array((B, D, H, 2), 3.0);
        let shared: Array3<f32> = draws.array((D, H, 2), 3.0);

        group.sample_size(20);
        group.throughput(Throughput::Elements((B * D) as u64));
        group.bench_function(BenchmarkId::new("rollout_costs", name), |bencher| {
            bencher
                .iter(|| world.rollout_costs(&starts, &goals, candidates.clone().into()).unwrap());
        });
        group.throughput(Throughput::Elements((D * D) as u64));
        group.bench_function(BenchmarkId::new("shared_costs_200_goals", name), |bencher| {
            bencher.iter(|| {
                world.shared_rollout_costs(&start, &frames, shared.clone().into()).unwrap().unwrap()
            });
        });
        group.throughput(Throughput::Elements(1));
        let problems = Problems {
            starts: &start,
            goals: &goals.select(&[0]).unwrap(),
            streams: &[Stream { seed: 0, purpose: Purpose::Actions, problem: 0 }],
            warm_start: None,
            share_rollouts: true,
            describe: &|problem| format!("problem {problem}"),
        };
        group.bench_function(BenchmarkId::new("visual_mpc", name), |bencher| {
            bencher.iter(|| plan(&MpcConfig::default(), &world, &problems, &|| Ok(())).unwrap());
        });
        group.sample_size(10);
        let goal = goals.select(&[1]).unwrap();
        group.bench_function(BenchmarkId::new("full_budget_search", name), |bencher| {
            bencher.iter(|| {
                let config = HvfConfig::default();
                search(&config, &world, &Anywhere, &start, &goal, 0, Watch::nobody()).unwrap()
            });
        });
    }
    group.finish();
}

criterion_group!(benches, keypoint);
criterion_main!(benches);
