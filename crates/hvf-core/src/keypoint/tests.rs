//! Cell and cost against plain loops over one candidate, bit for bit.
#![allow(clippy::unwrap_used)]

use ndarray::{Array1, Array2, Array3, Array4, Dimension, ShapeBuilder};
use proptest::prelude::*;

use super::cost::SpriteCost;
use super::{Cell, CellWeights, KeypointFrames, KeypointWorld, Sprite};
use crate::image::{GaussianBlur, OverHorizon};
use crate::lanes::LANES;
use crate::planner::{ActionSpace, Frames, WorldModel};

const SPRITE: Sprite =
    Sprite { half_size: [2.4993, 1.7], edge: [1.0438, 1.0356], colour: [0.14, 0.64, -0.01] };

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

/// Weights of a cell that looks at 3 x 3 taps, two pixels apart.
struct Weights {
    patch: Array2<f32>,
    context: Array2<f32>,
    middle: Array2<f32>,
    output: Array2<f32>,
    bias: Array1<f32>,
    output_bias: Array1<f32>,
    free: Array2<f32>,
}

impl Weights {
    fn new(hidden: usize, actions: usize, memory: usize) -> Self {
        let mut draws = Draws((hidden + memory) as u64);
        Self {
            patch: draws.array((hidden, 9), 0.5),
            context: draws.array((hidden, actions + memory), 0.7),
            middle: draws.array((hidden, hidden), 0.4),
            output: draws.array((2 + memory, hidden), 0.3),
            bias: draws.array(hidden, 0.2),
            output_bias: draws.array(2 + memory, 0.2),
            free: draws.array((2, actions), 1.5),
        }
    }

    fn cell(&self) -> Cell {
        Cell::new(CellWeights {
            patch: self.patch.view(),
            patch_bias: self.bias.view(),
            context: self.context.view(),
            middle: self.middle.view(),
            middle_bias: self.bias.view(),
            output: self.output.view(),
            output_bias: self.output_bias.view(),
            free: self.free.view(),
            action_scale: 2.0,
            spacing: 2,
            substeps: 3,
        })
        .unwrap()
    }

    /// What the cell makes of one candidate: every sum in order, every multiply-add fused.
    fn advance(&self, map: &[f32], size: usize, mut at: [f32; 2], action: &[f32]) -> [f32; 2] {
        let (hidden, actions) = (self.patch.nrows(), self.free.ncols());
        let mut memory = vec![0.0_f32; self.output.nrows() - 2];
        let pixel = |row: usize, column: usize, unit: usize| {
            let mut sum = self.bias[unit];
            for tap in 0..9 {
                let near = |position: usize, tap: usize| {
                    (position as isize + 2 * tap as isize - 2).clamp(0, size as isize - 1) as usize
                };
                let value = map[near(row, tap / 3) * size + near(column, tap % 3)];
                sum = self.patch[[unit, tap]].mul_add(value, sum);
            }
            sum
        };
        for _ in 0..3 {
            let [y, x] = at.map(|p| p.clamp(0.0, (size - 1) as f32));
            let (top, left) = ((y as usize).min(size - 2), (x as usize).min(size - 2));
            let (down, right) = (y - top as f32, x - left as f32);
            let first: Vec<f32> = (0..hidden)
                .map(|unit| {
                    let a = (1.0 - down) * (1.0 - right) * pixel(top, left, unit);
                    let b = ((1.0 - down) * right).mul_add(pixel(top, left + 1, unit), a);
                    let c = (down * (1.0 - right)).mul_add(pixel(top + 1, left, unit), b);
                    let mut sum = (down * right).mul_add(pixel(top + 1, left + 1, unit), c);
                    for (j, input) in action.iter().chain(&memory).enumerate() {
                        let scale = if j < actions { 0.5 } else { 1.0 };
                        sum = (self.context[[unit, j]] * scale).mul_add(*input, sum);
                    }
                    sum.max(0.0)
                })
                .collect();
            let layer = |weights: &Array2<f32>, bias: &Array1<f32>, inputs: &[f32]| -> Vec<f32> {
                let of = |(row, bias): (ndarray::ArrayView1<'_, f32>, &f32)| {
                    row.iter().zip(inputs).fold(*bias, |sum, (weight, x)| weight.mul_add(*x, sum))
                };
                weights.rows().into_iter().zip(bias).map(of).collect()
            };
            let mut second = layer(&self.middle, &self.bias, &first);
            second.iter_mut().for_each(|unit| *unit = unit.max(0.0));
            let moved = layer(&self.output, &self.output_bias, &second);
            for axis in 0..2 {
                let mut motion = moved[axis];
                for (input, weight) in action.iter().zip(self.free.row(axis)) {
                    motion = (weight * 0.5).mul_add(*input, motion);
                }
                at[axis] += motion;
            }
            memory.iter_mut().zip(&moved[2..]).for_each(|(kept, change)| *kept += change);
        }
        at
    }
}

fn map(size: usize) -> Vec<f32> {
    let mut draws = Draws(7);
    (0..size * size).map(|_| draws.between(-1.0, 1.0)).collect()
}

#[test]
fn a_block_moves_as_each_of_its_candidates_alone() {
    // One panel and many, one word of units and two, one group of outputs and two.
    for (hidden, actions, memory) in [(4, 1, 0), (12, 2, 3), (48, 2, 6), (64, 3, 7), (148, 2, 9)] {
        let weights = Weights::new(hidden, actions, memory);
        let (cell, size) = (weights.cell(), 11);
        let map = map(size);
        let (field, mut scratch) = (cell.field(&map, size), cell.scratch());
        let mut draws = Draws(3);
        for count in [16, 1, 7, 8] {
            // Some beyond the border.
            let starts: [[f32; 2]; LANES] =
                std::array::from_fn(|_| [draws.between(-2.0, 12.0), draws.between(-2.0, 12.0)]);
            let action: Vec<f32> = (0..LANES * actions).map(|_| draws.between(-3.0, 3.0)).collect();
            let mut block = [starts.map(|at| at[0]), starts.map(|at| at[1])];
            cell.advance(&field, &mut block, count, &action, &mut scratch);
            for lane in 0..count {
                let action = &action[lane * actions..][..actions];
                let expected = weights.advance(&map, size, starts[lane], action);
                assert_eq!([block[0][lane], block[1][lane]], expected, "{hidden} units");
            }
        }
    }
}

/// First pixel and coverage of a profile.
fn profile(axis: usize, centre: f32, size: usize) -> (usize, Vec<f32>) {
    let (half, edge) = (SPRITE.half_size[axis], SPRITE.edge[axis]);
    let reach = half + 0.5 * edge;
    let covered: Vec<usize> = (0..size)
        .filter(|&pixel| {
            let pixel = pixel as f32;
            pixel >= (centre - reach).ceil() && pixel <= (centre + reach).floor()
        })
        .collect();
    let part =
        |&pixel: &usize| ((half - (pixel as f32 - centre).abs()) / edge + 0.5).clamp(0.0, 1.0);
    (covered.first().copied().unwrap_or(0), covered.iter().map(part).collect())
}

/// The squared distance as it is written down, one candidate at a time; matrix products are
/// sums in order with fused multiply-adds.
fn cost(
    start: &[u8],
    goal: &[u8],
    from: [f32; 2],
    at: [f32; 2],
    gram: Option<&Array2<f32>>,
    size: usize,
) -> f32 {
    let mut residual: Vec<f32> =
        start.iter().zip(goal).map(|(&a, &b)| (f32::from(a) - f32::from(b)) / 255.0).collect();
    SPRITE.draw(from, -1.0, &mut residual, size);
    let times = |a: &Array2<f32>, b: &Array2<f32>| {
        Array2::from_shape_fn((size, size), |(i, j)| {
            (0..size).fold(0.0_f32, |sum, k| a[[i, k]].mul_add(b[[k, j]], sum))
        })
    };
    let mut distance = 0.0_f64;
    let mut projection = Array2::<f32>::zeros((size, size));
    for channel in 0..3 {
        let plane =
            Array2::from_shape_fn((size, size), |(y, x)| residual[(y * size + x) * 3 + channel]);
        let spread = match gram {
            None => plane.clone(),
            Some(gram) => times(&times(gram, &plane), gram),
        };
        distance +=
            plane.iter().zip(&spread).fold(0.0, |sum, (a, b)| sum + f64::from(*a) * f64::from(*b));
        projection.zip_mut_with(&spread, |sum, value| *sum += SPRITE.colour[channel] * value);
    }
    let (rows, columns) = (profile(0, at[0], size), profile(1, at[1], size));
    let norm = |(first, parts): &(usize, Vec<f32>)| {
        let mut sum = 0.0;
        for (i, a) in parts.iter().enumerate() {
            for (j, b) in parts.iter().enumerate() {
                match gram {
                    Some(gram) => sum += a * gram[[first + i, first + j]] * b,
                    None if i == j => sum += a * b,
                    None => {}
                }
            }
        }
        sum
    };
    let mut cross = 0.0;
    for (i, a) in rows.1.iter().enumerate() {
        let mut dot = 0.0;
        for (j, b) in columns.1.iter().enumerate() {
            dot += projection[[rows.0 + i, columns.0 + j]] * b;
        }
        cross += a * dot;
    }
    let colour: f32 = SPRITE.colour.iter().map(|c| c * c).sum();
    let sum = distance as f32 + 2.0 * cross + colour * norm(&rows) * norm(&columns);
    sum.max(0.0) / (size * size) as f32
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn a_block_costs_what_each_of_its_candidates_costs_alone(
        seed in 0_u64..1000, size in 2_usize..24, blurred: bool, apart in 0_usize..3
    ) {
        let mut draws = Draws(seed);
        let start: Vec<u8> = (0..size * size * 3).map(|_| draws.between(0.0, 256.0) as u8).collect();
        // Images that differ nowhere, in a corner, or everywhere.
        let mut goal = start.clone();
        let changed = [0, size / 2 * 3, size * size * 3][apart];
        goal[..changed].iter_mut().for_each(|byte| *byte = draws.between(0.0, 256.0) as u8);
        let blur = GaussianBlur::new(1.5, "blur").unwrap().unwrap();
        let gram = blurred.then(|| blur.gram_matrix(size));
        let fast = SpriteCost::new(SPRITE, size, gram.clone());
        let (mut footprint, mut under) = (fast.room(), fast.under());
        let mut point = || draws.between(-6.0, size as f32 + 6.0);
        let from = [point(), point()];
        let terms = fast.goal_terms(&start, from, &goal);
        let mut at = [[0.0; LANES]; 2];
        at.as_flattened_mut().iter_mut().for_each(|place| *place = point());
        // On whole pixels and halves, too.
        (at[0][0], at[1][0]) = (size as f32 / 2.0, 0.0);
        fast.footprint(&at, &mut footprint, &mut under);
        let costs = fast.costs(&terms, &footprint, &mut under);
        for lane in 0..LANES {
            let at = [at[0][lane], at[1][lane]];
            let expected = cost(&start, &goal, from, at, gram.as_ref(), size);
            prop_assert_eq!(costs[lane], expected, "at {:?}", at);
        }
    }
}

const SIZE: usize = 16;

fn world(over_horizon: OverHorizon) -> KeypointWorld {
    let actions = ActionSpace::new(vec![-3.0; 2], vec![3.0; 2]).unwrap();
    let cell = Weights::new(12, 2, 3).cell();
    KeypointWorld::new(cell, SPRITE, actions, SIZE, 1.0, over_horizon).unwrap()
}

fn frames(world: &KeypointWorld, count: usize) -> KeypointFrames {
    let mut draws = Draws(5);
    let images =
        Array4::from_shape_simple_fn((count, SIZE, SIZE, 3), || draws.between(0.0, 256.0) as u8);
    let keypoints = draws.array((count, 2), 8.0).mapv(|x: f32| x + 8.0);
    let maps: Array3<f32> = draws.array((count, SIZE, SIZE), 1.0);
    world.frames(images.view(), keypoints.view(), maps.view()).unwrap()
}

#[test]
fn prepared_goals_and_shared_rollouts_change_no_bit() {
    for over_horizon in [OverHorizon::Last, OverHorizon::Sum, OverHorizon::Min] {
        let world = world(over_horizon);
        let all = frames(&world, 5);
        let (starts, goals) = (all.select(&[0, 0, 1]).unwrap(), all.select(&[2, 3, 4]).unwrap());
        let actions: Array4<f32> = Draws(9).array((3, 21, 4, 2), 3.0);
        let expected = world.rollout_costs(&starts, &goals, actions.clone().into()).unwrap();
        let (also_starts, prepared) = world.prepare(&starts, &goals).unwrap().unwrap();
        let found = world.rollout_costs(&also_starts, &prepared, actions.clone().into()).unwrap();
        assert_eq!(found, expected);

        let those = [2, 0];
        let (starts, prepared) = (starts.select(&those).unwrap(), prepared.select(&those).unwrap());
        let some = actions.select(ndarray::Axis(0), &those);
        let found = world.rollout_costs(&starts, &prepared, some.into()).unwrap();
        assert_eq!(found, expected.select(ndarray::Axis(0), &those));

        let one = all.select(&[0]).unwrap();
        let shared = actions.index_axis(ndarray::Axis(0), 0).to_owned();
        let (_, prepared) = world.prepare(&one, &goals).unwrap().unwrap();
        for goals in [&goals, &prepared] {
            let found = world.shared_rollout_costs(&one, goals, shared.clone().into());
            assert_eq!(found.unwrap().unwrap().row(0), expected.row(0));
        }
    }
}
