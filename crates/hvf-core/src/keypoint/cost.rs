//! Squared distance to a goal image of frames whose sprite is somewhere, for blocks of candidates.
//!
//! A predicted frame is `base + colour * row(y) column(x)`, where `base` is the start frame with
//! its own sprite taken away. With `r = base - goal`, the squared distance after a separable blur
//! `B` with Gram matrix `G = B^T B` is
//!
//! ```text
//! |B r|^2  +  2 row^T (G (colour . r) G) column  +  |colour|^2 (row^T G row) (column^T G column)
//! ```
//!
//! The first term and the matrix in the second depend only on start and goal ([`GoalTerms`]), the
//! third only on where the sprite is ([`Footprint`]). Profiles are zero outside a few pixels: for
//! every candidate the few numbers under its sprite are brought next to those of the others
//! ([`gather`]), so that all sums run over the candidates of a block side by side. Each sum adds
//! its terms in the order of the pixels.

use multiversion::multiversion;
use ndarray::Array2;

use super::sprite::{Sprite, MAX_WIDTH};
use crate::lanes::{Lanes, LANES};

/// Pixels that [`spread_out`] sums at once.
const TOGETHER: usize = 64;
/// Numbers that [`gather`] moves at once.
const FOUR: usize = 4;

/// Where the sprites of a block of candidates are, and what does not depend on the goal.
#[derive(Clone, Debug)]
pub(super) struct Footprint {
    /// First row and column of each.
    first: [[usize; LANES]; 2],
    /// Coverage along rows and columns, `[2][width]`.
    coverage: Vec<Lanes>,
    /// Squared distance of the sprites alone to black.
    own: Lanes,
}

/// What a start and a goal contribute to the cost of every candidate between them.
#[derive(Clone, Debug)]
pub(super) struct GoalTerms {
    /// Squared distance of the base frame to the goal, summed over pixels and channels.
    distance: f32,
    /// Gradient of the cost with respect to the sprite's coverage, halved, `[S + width, S + width]`
    /// with zeros beyond the image.
    projection: Vec<f32>,
}

/// The cost of a world's frames.
#[derive(Clone, Debug)]
pub(super) struct SpriteCost {
    sprite: Sprite,
    /// `|colour|^2`.
    colour: f32,
    size: usize,
    /// Most pixels that a profile covers, a multiple of [`FOUR`].
    width: usize,
    gram: Option<Gram>,
}

#[derive(Clone, Debug)]
struct Gram {
    /// `[S, S]`, row by row.
    matrix: Vec<f32>,
    /// Its part for every first pixel of a profile, `[S + 1][width, width]`, with zeros beyond the
    /// image.
    blocks: Vec<f32>,
}

impl SpriteCost {
    /// For images of `size` pixels and a blur of this Gram matrix, if there is one.
    pub fn new(sprite: Sprite, size: usize, gram: Option<Array2<f32>>) -> Self {
        let pixels = |axis: usize| 2.0 * sprite.half_size[axis] + sprite.edge[axis];
        // One more than fit between two whole pixels, for what rounding adds.
        let covered = pixels(0).max(pixels(1)).floor() as usize + 2;
        let width = covered.min(MAX_WIDTH).next_multiple_of(FOUR);
        let gram = gram.map(|gram| {
            let block = |first: usize| {
                let gram = &gram;
                (0..width * width).map(move |at| {
                    gram.get((first + at / width, first + at % width)).copied().unwrap_or(0.0)
                })
            };
            Gram {
                matrix: gram.iter().copied().collect(),
                blocks: (0..=size).flat_map(block).collect(),
            }
        });
        let colour = sprite.colour.iter().map(|c| c * c).sum();
        Self { sprite, colour, size, width, gram }
    }

    /// Room for the footprint of one block.
    pub fn room(&self) -> Footprint {
        Footprint {
            first: [[0; LANES]; 2],
            coverage: vec![[0.0; LANES]; 2 * self.width],
            own: [0.0; LANES],
        }
    }

    /// Room for what is under the sprites of one block.
    pub fn under(&self) -> Vec<Lanes> {
        vec![[0.0; LANES]; self.width * self.width]
    }

    /// Footprint of sprites at `keypoints` (row, column in pixels).
    pub fn footprint(&self, keypoints: &[Lanes; 2], out: &mut Footprint, under: &mut [Lanes]) {
        footprint(self, keypoints, out, under);
    }

    /// Costs per pixel of the frames with this footprint.
    pub fn costs(&self, terms: &GoalTerms, footprint: &Footprint, under: &mut [Lanes]) -> Lanes {
        costs(self, terms, footprint, under)
    }

    /// Terms of a start image and a goal image, `[S, S, 3]` each, where the start's sprite is at
    /// `keypoint`. With a blur, `6 S^3` multiply-adds for images that differ everywhere; pixels
    /// that are the same cost next to nothing.
    pub fn goal_terms(&self, start: &[u8], keypoint: [f32; 2], goal: &[u8]) -> GoalTerms {
        let mut residual: Vec<f32> =
            start.iter().zip(goal).map(|(&a, &b)| (f32::from(a) - f32::from(b)) / 255.0).collect();
        self.sprite.draw(keypoint, -1.0, &mut residual, self.size);
        let differ = Differing::of(&residual, self.size);
        let width = differ.columns.len().max(1);
        let stride = self.size + self.width;
        let mut projection = vec![0.0; stride * stride];
        let mut distance = 0.0;
        let mut plane = Vec::with_capacity(differ.rows.len() * differ.columns.len());
        let mut spread = vec![0.0; self.size * self.size];
        for channel in 0..3 {
            let pixel =
                |&row: &usize, &column: &usize| residual[(row * self.size + column) * 3 + channel];
            plane.clear();
            for row in &differ.rows {
                plane.extend(differ.columns.iter().map(|column| pixel(row, column)));
            }
            match &self.gram {
                None => {
                    for (row, values) in differ.rows.iter().zip(plane.chunks(width)) {
                        for (column, value) in differ.columns.iter().zip(values) {
                            spread[row * self.size + column] = *value;
                        }
                    }
                }
                Some(gram) => spread_out(&gram.matrix, self.size, &differ, &plane, &mut spread),
            }
            let mut sum = 0.0;
            for (row, values) in differ.rows.iter().zip(plane.chunks(width)) {
                for (column, value) in differ.columns.iter().zip(values) {
                    sum += f64::from(*value) * f64::from(spread[row * self.size + column]);
                }
            }
            distance += sum;
            let lines = spread.chunks_exact(self.size).zip(projection.chunks_exact_mut(stride));
            for (spread, projection) in lines {
                for (to, value) in projection.iter_mut().zip(spread) {
                    *to += self.sprite.colour[channel] * value;
                }
            }
        }
        GoalTerms { distance: distance as f32, projection }
    }
}

/// Rows and columns in which a residual is not zero everywhere.
struct Differing {
    rows: Vec<usize>,
    columns: Vec<usize>,
}

impl Differing {
    /// Of a residual `[S, S, 3]`.
    fn of(residual: &[f32], size: usize) -> Self {
        let mut somewhere = vec![false; size];
        let mut rows = Vec::new();
        for (row, line) in residual.chunks_exact(3 * size).enumerate() {
            if line.iter().all(|value| *value == 0.0) {
                continue;
            }
            rows.push(row);
            for (column, pixel) in somewhere.iter_mut().zip(line.as_chunks::<3>().0) {
                *column |= pixel.iter().any(|value| *value != 0.0);
            }
        }
        Self { rows, columns: (0..size).filter(|&column| somewhere[column]).collect() }
    }
}

/// `gram plane gram`, `[S, S]`, of a plane of which only the rows and columns that differ are
/// given. Sums run over ascending pixels with fused multiply-adds.
#[multiversion(targets("x86_64+avx2+fma"))]
fn spread_out(gram: &[f32], size: usize, differ: &Differing, plane: &[f32], spread: &mut [f32]) {
    let width = differ.columns.len();
    let mut across = vec![0.0_f32; width];
    for (gram_row, out) in gram.chunks_exact(size).zip(spread.chunks_exact_mut(size)) {
        across.fill(0.0);
        for (&row, values) in differ.rows.iter().zip(plane.chunks(width.max(1))) {
            let weight = gram_row[row];
            // Pixels are further apart than the blur reaches.
            if weight != 0.0 {
                for (sum, value) in across.iter_mut().zip(values) {
                    *sum = weight.mul_add(*value, *sum);
                }
            }
        }
        let mut from = 0;
        for out in out.chunks_mut(TOGETHER) {
            let mut sums = [0.0; TOGETHER];
            for (&column, &value) in differ.columns.iter().zip(&across) {
                let weights = &gram[column * size + from..][..out.len()];
                if let Some(weights) = weights.first_chunk::<TOGETHER>() {
                    for (sum, weight) in sums.iter_mut().zip(weights) {
                        *sum = value.mul_add(*weight, *sum);
                    }
                } else {
                    for (sum, weight) in sums.iter_mut().zip(weights) {
                        *sum = value.mul_add(*weight, *sum);
                    }
                }
            }
            out.copy_from_slice(&sums[..out.len()]);
            from += TOGETHER;
        }
    }
}

/// `out[count][lane] = rows[lane][count]`, for as many numbers as `out` has (a multiple of four).
#[inline(always)]
fn gather(rows: &[&[f32]; LANES], out: &mut [Lanes]) {
    for (four, out) in out.as_chunks_mut::<FOUR>().0.iter_mut().enumerate() {
        for group in 0..LANES / FOUR {
            let mut block = [[0.0; FOUR]; FOUR];
            for lane in 0..FOUR {
                block[lane].copy_from_slice(&rows[group * FOUR + lane][four * FOUR..][..FOUR]);
            }
            for (out, numbers) in out.iter_mut().zip(transposed(block)) {
                out[group * FOUR..][..FOUR].copy_from_slice(&numbers);
            }
        }
    }
}

/// Rows as columns. (Of a loop the compiler makes sixteen loads and stores.)
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn transposed(block: [[f32; FOUR]; FOUR]) -> [[f32; FOUR]; FOUR] {
    use std::arch::x86_64::{
        __m128, _mm_movehl_ps, _mm_movelh_ps, _mm_unpackhi_ps, _mm_unpacklo_ps,
    };
    // SAFETY: SSE is part of every x86-64 processor, and its vectors are four numbers.
    unsafe {
        let [a, b, c, d] = std::mem::transmute::<[[f32; FOUR]; FOUR], [__m128; FOUR]>(block);
        let (low, also_low) = (_mm_unpacklo_ps(a, b), _mm_unpacklo_ps(c, d));
        let (high, also_high) = (_mm_unpackhi_ps(a, b), _mm_unpackhi_ps(c, d));
        std::mem::transmute::<[__m128; FOUR], [[f32; FOUR]; FOUR]>([
            _mm_movelh_ps(low, also_low),
            _mm_movehl_ps(also_low, low),
            _mm_movelh_ps(high, also_high),
            _mm_movehl_ps(also_high, high),
        ])
    }
}

/// Rows as columns.
#[cfg(not(target_arch = "x86_64"))]
fn transposed(block: [[f32; FOUR]; FOUR]) -> [[f32; FOUR]; FOUR] {
    std::array::from_fn(|row| std::array::from_fn(|column| block[column][row]))
}

/// `sum += a * b`, lane by lane.
#[inline(always)]
fn add_products(sum: &mut Lanes, a: &Lanes, b: &Lanes) {
    for lane in 0..LANES {
        sum[lane] += a[lane] * b[lane];
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn footprint(cost: &SpriteCost, keypoints: &[Lanes; 2], out: &mut Footprint, under: &mut [Lanes]) {
    let (size, width) = (cost.size as f32, cost.width);
    let mut norms = [[0.0; LANES]; 2];
    for axis in 0..2 {
        let coverage = &mut out.coverage[axis * width..][..width];
        let centre = &keypoints[axis];
        let (half, edge) = (cost.sprite.half_size[axis], cost.sprite.edge[axis]);
        let reach = half + 0.5 * edge;
        let (mut first, mut end) = ([0.0; LANES], [0.0; LANES]);
        for lane in 0..LANES {
            first[lane] = (centre[lane] - reach).ceil().clamp(0.0, size);
            end[lane] = ((centre[lane] + reach).floor() + 1.0).clamp(0.0, size);
        }
        for (out, first) in out.first[axis].iter_mut().zip(first) {
            // A centre that is not a number covers nothing.
            *out = first as usize;
        }
        for (place, coverage) in coverage.iter_mut().enumerate() {
            for lane in 0..LANES {
                let pixel = first[lane] + place as f32;
                let distance = (pixel - centre[lane]).abs();
                let part = ((half - distance) / edge + 0.5).clamp(0.0, 1.0);
                coverage[lane] = if pixel < end[lane] { part } else { 0.0 };
            }
        }
        let norm = &mut norms[axis];
        match &cost.gram {
            None => {
                for part in coverage.iter() {
                    add_products(norm, part, part);
                }
            }
            Some(gram) => {
                let mut blocks: [&[f32]; LANES] = [&[]; LANES];
                for (block, first) in blocks.iter_mut().zip(out.first[axis]) {
                    *block = &gram.blocks[first * width * width..][..width * width];
                }
                gather(&blocks, under);
                for (under, a) in under.chunks_exact(width).zip(coverage.iter()) {
                    for (under, b) in under.iter().zip(coverage.iter()) {
                        let mut weighted = [0.0; LANES];
                        for lane in 0..LANES {
                            weighted[lane] = a[lane] * under[lane];
                        }
                        add_products(norm, &weighted, b);
                    }
                }
            }
        }
    }
    let norms = norms[0].iter().zip(&norms[1]);
    let places = keypoints[0].iter().zip(&keypoints[1]);
    for ((own, (row, column)), (y, x)) in out.own.iter_mut().zip(norms).zip(places) {
        // A sprite that is nowhere must not cost what a frame without it does: NaN ranks last.
        *own = cost.colour * row * column + 0.0 * (y + x);
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn costs(
    cost: &SpriteCost,
    terms: &GoalTerms,
    footprint: &Footprint,
    under: &mut [Lanes],
) -> Lanes {
    let Footprint { first, coverage, own } = footprint;
    let (row, column) = coverage.split_at(cost.width);
    let stride = cost.size + cost.width;
    for (place, under) in under.chunks_exact_mut(cost.width).enumerate() {
        let mut rows: [&[f32]; LANES] = [&[]; LANES];
        for lane in 0..LANES {
            let at = (first[0][lane] + place) * stride + first[1][lane];
            rows[lane] = &terms.projection[at..at + cost.width];
        }
        gather(&rows, under);
    }
    let mut cross = [0.0; LANES];
    for (under, a) in under.chunks_exact(cost.width).zip(row) {
        let mut dot = [0.0; LANES];
        for (under, b) in under.iter().zip(column) {
            add_products(&mut dot, under, b);
        }
        add_products(&mut cross, a, &dot);
    }
    let pixels = (cost.size * cost.size) as f32;
    let mut costs = [0.0; LANES];
    for lane in 0..LANES {
        let sum = terms.distance + 2.0 * cross[lane] + own[lane];
        // Below zero by rounding only; NaN stays NaN.
        costs[lane] = if sum < 0.0 { 0.0 } else { sum } / pixels;
    }
    costs
}
