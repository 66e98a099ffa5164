//! Candidates per second of the desk's learned world: 15 steps, the last frame, its cost.
//!
//! The layers have the size of the shipped model's and random weights; about a third of all tiles
//! change in a predicted frame, as there. `RAYON_NUM_THREADS=1` gives the rate of one core.
#![allow(clippy::unwrap_used)]

use criterion::{criterion_group, criterion_main, BenchmarkId, Criterion, Throughput};
use hvf_core::image::OverHorizon;
use hvf_core::layers::{
    Backdrop, Cell, CellWeights, Gallery, GalleryImages, LayerFrames, LayerWorld, Painter, Sprites,
};
use hvf_core::nn::Linear;
use hvf_core::planner::{Frames, WorldModel};
use ndarray::{Array1, Array2, Array3, Array4, Array5, Axis, Dimension, ShapeBuilder};

const SIZE: usize = 64;
const TILE: usize = 8;
const PARTS: usize = 3;
const MEMORY: usize = 4;
const PLACES: [usize; 3] = [18, 43, 5];
/// Candidates of a problem, problems, and steps.
const D: usize = 200;
const B: usize = 4;
const H: usize = 15;

struct Draws(u64);

impl Draws {
    fn between(&mut self, low: f32, high: f32) -> f32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        low + (high - low) * ((self.0 >> 40) as f32 / (1_u64 << 24) as f32)
    }

    fn byte(&mut self) -> u8 {
        self.between(0.0, 256.0) as u8
    }

    fn array<N: Dimension>(
        &mut self,
        shape: impl ShapeBuilder<Dim = N>,
        scale: f32,
    ) -> ndarray::Array<f32, N> {
        ndarray::Array::from_shape_simple_fn(shape, || self.between(-scale, scale))
    }

    fn layers(&mut self, sizes: &[usize], last: f32) -> Vec<(Array2<f32>, Array1<f32>)> {
        let count = sizes.len() - 1;
        sizes
            .windows(2)
            .enumerate()
            .map(|(i, pair)| {
                let scale = if i + 1 == count { last } else { 1.5 } / (pair[0] as f32).sqrt();
                (self.array((pair[1], pair[0]), scale), Array1::zeros(pair[1]))
            })
            .collect()
    }
}

fn views(layers: &[(Array2<f32>, Array1<f32>)]) -> Vec<Linear<'_>> {
    layers.iter().map(|(weights, bias)| (weights.view(), bias.view())).collect()
}

fn cell(draws: &mut Draws) -> Cell {
    let hand = draws.layers(&[8, 64, 64, 3], 1.0);
    let sliders = [draws.layers(&[11, 64, 64, 1], 0.3), draws.layers(&[11, 64, 64, 1], 0.3)];
    let parts = draws.layers(&[16 + MEMORY, 128, 128, 3 + MEMORY], 0.3);
    // The hand is in the middle, and moves by seven pixels a full action.
    let contact = Array2::from_shape_fn((10, 2), |(term, axis)| match (term, axis) {
        (0, _) => 32.0,
        (1, 0) | (2, 1) => 7.0,
        _ => 0.0,
    });
    Cell::new(&CellWeights {
        hand: views(&hand),
        sliders: sliders.iter().map(|layers| views(layers)).collect(),
        parts: views(&parts),
        contact: contact.view(),
        reach: 9.0,
        roaming: PARTS,
    })
    .unwrap()
}

/// Two tiles wide, from the upper border down to the hand.
fn gallery(draws: &mut Draws) -> Gallery {
    let side = SIZE / TILE;
    let mut index = Array2::zeros((PLACES.iter().product(), side * side));
    let mut count = 1;
    for (place, mut image) in index.rows_mut().into_iter().enumerate() {
        let (i, j) = (place / (PLACES[1] * PLACES[2]), place / PLACES[2] % PLACES[1]);
        let (last, left) = (i * side / PLACES[0], j * (side - 1) / PLACES[1]);
        for row in 0..=last {
            for column in left..left + 2 {
                image[row * side + column] = count;
                count += 1;
            }
        }
    }
    let shape = (count as usize, 4, TILE, TILE);
    let mut patches = Array4::from_shape_simple_fn(shape, || draws.byte());
    patches.index_axis_mut(Axis(0), 0).fill(0);
    let images = GalleryImages {
        low: [-2.0, -3.0, -1.0],
        step: [0.24, 0.14, 0.5],
        places: PLACES,
        patches: patches.view(),
        index: index.view(),
    };
    Gallery::new(&images, SIZE).unwrap()
}

fn world(blur: f64) -> LayerWorld {
    let mut draws = Draws(1);
    let gallery = gallery(&mut draws);
    // Sliders show in a fifth of all tiles.
    let always: Vec<u8> = (0..3 * SIZE * SIZE).map(|_| draws.byte()).collect();
    let table = Array5::from_shape_fn((40, 8, 3, SIZE, SIZE), |(i, j, colour, row, column)| {
        let value = always[(colour * SIZE + row) * SIZE + column];
        let slides = (8..40).contains(&row) && column >= 40;
        value.wrapping_add(if slides { (3 * i + 5 * j) as u8 } else { 0 })
    });
    let backdrop = Backdrop::new(table.view(), gallery.tiles()).unwrap();
    let sprites = draws.array((PARTS, 4, 15, 15), 0.5).mapv(f32::abs);
    let painter = Painter::new(backdrop, Sprites::new(sprites.view()).unwrap(), gallery).unwrap();
    LayerWorld::new(cell(&mut draws), painter, blur, OverHorizon::Last).unwrap()
}

fn frames(world: &LayerWorld, count: usize) -> LayerFrames {
    let mut draws = Draws(2);
    let images = Array4::from_shape_simple_fn((count, SIZE, SIZE, 3), || draws.byte());
    let clean = images.mapv(|x| f32::from(x) / 255.0);
    let at = [[30.0, 20.0], [44.0, 42.0], [50.0, 24.0]];
    let shape = (count, PARTS, SIZE, SIZE);
    let regions = Array4::from_shape_fn(shape, |(_, part, row, column)| {
        let [y, x]: [f32; 2] = at[part];
        (row as f32 - y).abs() < 5.0 && (column as f32 - x).abs() < 5.0
    });
    let mut state = vec![0.0, 0.0, 0.0, 0.0, 0.1];
    state.extend(at.iter().flat_map(|[y, x]| [*y, *x, 1.0]));
    let states = Array2::from_shape_fn((count, state.len()), |(_, x)| state[x]);
    world.frames(images.view(), clean.view(), regions.view(), states.view()).unwrap()
}

/// Actions that are held for three steps.
fn actions(problems: usize) -> Array4<f32> {
    let mut draws = Draws(3);
    let held: Array4<f32> = draws.array((problems, D, H / 3, 3), 1.0);
    Array4::from_shape_fn((problems, D, H, 3), |(b, d, h, a)| held[[b, d, h / 3, a]])
}

fn layers(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("layers");
    group.sample_size(20);
    for blur in [0.0, 2.0] {
        let world = world(blur);
        let frames = frames(&world, D);
        let starts = frames.select(&(0..B).collect::<Vec<_>>()).unwrap();
        let goals = frames.select(&(B..2 * B).collect::<Vec<_>>()).unwrap();
        let candidates = actions(B);
        group.throughput(Throughput::Elements((B * D) as u64));
        group.bench_function(BenchmarkId::new("rollout_costs/blur", blur), |bencher| {
            bencher
                .iter(|| world.rollout_costs(&starts, &goals, candidates.clone().into()).unwrap());
        });
        if blur == 0.0 {
            group.bench_function("rollout", |bencher| {
                bencher.iter(|| world.rollout(&starts, candidates.view()).unwrap());
            });
        }
        let start = frames.select(&[0]).unwrap();
        let candidates: Array3<f32> = actions(1).index_axis_move(Axis(0), 0);
        group.throughput(Throughput::Elements((D * D) as u64));
        group.bench_function(BenchmarkId::new("shared_costs_200_goals/blur", blur), |bencher| {
            bencher.iter(|| world.shared_costs(&start, &frames, candidates.view()).unwrap());
        });
    }
    group.finish();
}

criterion_group!(benches, layers);
criterion_main!(benches);
