//! Candidate-steps per second of latent worlds, what part of the processor's peak that is, and a
//! search with the whole budget.
//!
//! Random weights. `shipped` has the size of the package's own latent model: a small state, read out
//! by a layer of sines. Rates are of one core; the search takes all.
#![allow(clippy::unwrap_used)]

use std::hint::black_box;
use std::time::Instant;

use criterion::{criterion_group, criterion_main, BenchmarkId, Criterion, Throughput};
use hvf_core::image::OverHorizon;
use hvf_core::latent::{Dynamics, LatentCost, LatentFrames, LatentWorld, Readout};
use hvf_core::nn::{Activation, GruWeights, Linear, ResidualWeights};
use hvf_core::planner::{search, ActionSpace, Frames, HvfConfig, SubgoalModel, Watch, WorldModel};
use hvf_core::Result;
use multiversion::multiversion;
use ndarray::{s, Array1, Array2, Array3, Array4, ArrayView2};

/// Problems, candidates of each, steps and action dimensions.
const B: usize = 8;
const D: usize = 200;
const H: usize = 5;
const A: usize = 2;

struct Draws(u64);

impl Draws {
    fn between(&mut self, low: f32, high: f32) -> f32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        low + (high - low) * ((self.0 >> 40) as f32 / (1_u64 << 24) as f32)
    }

    fn matrix(&mut self, rows: usize, columns: usize, scale: f32) -> Array2<f32> {
        Array2::from_shape_simple_fn((rows, columns), || self.between(-scale, scale))
    }

    fn layer(&mut self, outputs: usize, inputs: usize) -> (Array2<f32>, Array1<f32>) {
        let scale = (3.0 / inputs as f32).sqrt();
        (self.matrix(outputs, inputs, scale), Array1::zeros(outputs))
    }
}

type Layer = (Array2<f32>, Array1<f32>);

fn view(layer: &Layer) -> Linear<'_> {
    (layer.0.view(), layer.1.view())
}

/// What dynamics a world has.
#[derive(Clone, Copy)]
enum Kind {
    /// Width and residual blocks.
    Mlp(usize, usize),
    Gru,
}

/// A world, and the multiply-adds of its dynamics.
fn world(latent: usize, kind: Kind, read: Option<[usize; 2]>) -> (LatentWorld, usize) {
    let mut draws = Draws(1);
    let dynamics = match kind {
        Kind::Mlp(width, blocks) => {
            let input = draws.layer(width, latent + A);
            let blocks: Vec<[Layer; 2]> = (0..blocks)
                .map(|_| [draws.layer(width, width), draws.layer(width, width)])
                .collect();
            let output = draws.layer(latent, width);
            let weights = ResidualWeights {
                input: view(&input),
                activation: Activation::Relu,
                blocks: blocks.iter().map(|block| block.each_ref().map(view)).collect(),
                output: view(&output),
            };
            Dynamics::mlp(&weights, Array1::from_elem(1, 0.05).view())
        }
        Kind::Gru => {
            let (input, state) = (draws.layer(3 * latent, A), draws.layer(3 * latent, latent));
            Dynamics::gru(&GruWeights {
                weight_ih: input.0.view(),
                weight_hh: state.0.view(),
                bias_ih: input.1.view(),
                bias_hh: state.1.view(),
            })
        }
    }
    .unwrap();
    let cost = match read {
        None => LatentCost::new(latent, &Readout::Latent, None),
        Some([width, outputs]) => {
            let (input, output) = (draws.layer(width, latent), draws.layer(outputs, width));
            let readout = Readout::Network(ResidualWeights {
                input: view(&input),
                activation: Activation::Sin,
                blocks: Vec::new(),
                output: view(&output),
            });
            LatentCost::new(latent, &readout, None)
        }
    };
    let multiply_adds = dynamics.multiply_adds();
    let actions = ActionSpace::new(vec![-1.0; A], vec![1.0; A]).unwrap();
    let world = LatentWorld::new(dynamics, cost.unwrap(), actions, OverHorizon::Last, 1).unwrap();
    (world, multiply_adds)
}

fn frames(latents: ArrayView2<'_, f32>) -> LatentFrames {
    LatentFrames::new(latents, Default::default()).unwrap()
}

/// Lanes that [`spin`] works on: enough registers that none waits for another, in AVX2 too.
const SPUN: [usize; 2] = [6, 16];

/// Independent multiply-adds as fast as they go, `rounds` times one for each number.
#[multiversion(targets("x86_64+avx512f+fma", "x86_64+avx2+fma"))]
fn spin(rounds: usize, factors: &[f32; SPUN[1]], mut sums: [[f32; SPUN[1]]; SPUN[0]]) -> f32 {
    for _ in 0..rounds {
        for sum in &mut sums {
            for lane in 0..SPUN[1] {
                sum[lane] = factors[lane].mul_add(sum[lane], factors[lane]);
            }
        }
    }
    sums.as_flattened().iter().sum()
}

/// Seconds that this thread has been on a core; where the system does not tell, seconds since
/// `start`.
fn seconds(start: Instant) -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanoseconds = told.and_then(|told| told.split(' ').next()?.parse::<f64>().ok());
    nanoseconds.map_or_else(|| start.elapsed().as_secs_f64(), |nanoseconds| nanoseconds * 1e-9)
}

/// Seconds of this thread that `work` takes, the least of the means of a few runs of it.
fn least(mut work: impl FnMut()) -> f64 {
    let start = Instant::now();
    let mean = |_| {
        let before = seconds(start);
        for calls in 1.. {
            work();
            // Long against the steps of a thread's clock.
            let passed = seconds(start) - before;
            if passed > 0.4 {
                return passed / f64::from(calls);
            }
        }
        f64::INFINITY
    };
    (0..4).map(mean).fold(f64::INFINITY, f64::min)
}

/// Multiply-adds per second of one core, at most.
fn peak() -> f64 {
    let rounds = 100_000;
    let seconds = least(|| {
        black_box(spin(rounds, black_box(&[0.5; SPUN[1]]), black_box([[1.0; SPUN[1]]; SPUN[0]])));
    });
    (rounds * SPUN[0] * SPUN[1]) as f64 / seconds
}

fn rollouts(criterion: &mut Criterion) {
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let peak = peak();
    let mut group = criterion.benchmark_group("latent");
    group.sample_size(20);
    for (name, latent, kind, read) in [
        ("shipped: Z=32 W=160 R=2, sines 256, P=128", 32, Kind::Mlp(160, 2), Some([256, 128])),
        ("Z=64 W=256 R=1", 64, Kind::Mlp(256, 1), None),
        ("Z=128 W=256 R=2", 128, Kind::Mlp(256, 2), None),
        ("Z=128 W=512 R=2", 128, Kind::Mlp(512, 2), None),
        ("GRU Z=128", 128, Kind::Gru, None),
    ] {
        let (world, multiply_adds) = world(latent, kind, read);
        let mut draws = Draws(2);
        let starts = frames(draws.matrix(B, latent, 1.0).view());
        let goals = frames(draws.matrix(B, latent, 1.0).view());
        let actions = Array4::from_shape_simple_fn((B, D, H, A), || draws.between(-1.0, 1.0));
        let costs = || world.rollout_costs(&starts, &goals, actions.clone().into()).unwrap();
        group.throughput(Throughput::Elements((B * D * H) as u64));
        group.bench_function(BenchmarkId::new("rollout_costs", name), |bencher| {
            one.install(|| bencher.iter(costs));
        });
        let (start, goal) = (starts.select(&[0]).unwrap(), goals.select(&[0]).unwrap());
        let few = actions.slice(s![..1, .., .., ..]);
        let seconds = one.install(|| {
            least(|| {
                drop(world.rollout_costs(&start, &goal, few.to_owned().into()).unwrap());
            })
        });
        let read = read.map_or(0, |[width, outputs]| width * (latent + outputs));
        let rate = (D * (H * multiply_adds + read)) as f64 / seconds;
        println!(
            "{name}: {:.0} candidate-steps/s, {:.1} of {:.1} GFLOP/s on one core, {:.0} %",
            (D * H) as f64 / seconds,
            rate / 5e8,
            peak / 5e8,
            100.0 * rate / peak
        );
    }
    group.finish();
}

/// Subgoals spread over the latents of a world.
struct Spread(Array2<f32>);

impl SubgoalModel<LatentFrames> for Spread {
    fn latent_dim(&self) -> usize {
        self.0.nrows()
    }

    fn decode(&self, _scene: &LatentFrames, latents: Array3<f32>) -> Result<LatentFrames> {
        let (samples, subgoals, dim) = latents.dim();
        let rows = latents.into_shape_with_order((samples * subgoals, dim)).unwrap();
        Ok(frames(rows.dot(&self.0).view()))
    }
}

/// Searches take too long to be repeated often.
fn searches(_: &mut Criterion) {
    for (name, latent, kind, read) in [
        ("shipped", 32, Kind::Mlp(160, 2), Some([256, 128])),
        ("Z=128 W=256 R=2", 128, Kind::Mlp(256, 2), None),
    ] {
        let (world, _) = world(latent, kind, read);
        let mut draws = Draws(3);
        let ends = frames(draws.matrix(2, latent, 1.0).view());
        let (start, goal) = (ends.select(&[0]).unwrap(), ends.select(&[1]).unwrap());
        let generator = Spread(draws.matrix(8, latent, 0.6));
        let config = HvfConfig::default();
        let begun = Instant::now();
        search(&config, &world, &generator, &start, &goal, 7, Watch::nobody()).unwrap();
        println!(
            "{name}: search with M = D = 200, K = 2, H = 5 in {:.1} s on {} cores",
            begun.elapsed().as_secs_f64(),
            rayon::current_num_threads()
        );
    }
}

criterion_group!(benches, rollouts, searches);
criterion_main!(benches);
