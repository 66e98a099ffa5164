//! The squared length of a blurred change, where most of the image has not changed.
//!
//! The blur is [`GaussianBlur`]'s, a sum over columns and then over rows. Rows of tiles that have not
//! changed are zero: the first sum skips them, and the second leaves them out.

use multiversion::multiversion;

use super::tiles::Tiles;
use crate::image::GaussianBlur;

/// Pixels of a row that are summed at once.
const BLOCK: usize = 32;

/// A blur of images in tiles.
#[derive(Clone, Debug)]
pub struct Smoother {
    tiles: Tiles,
    /// Weights of pixels up to `radius` to either side.
    weights: Vec<f32>,
    /// For each row, the rows that it is a sum of, and their weights.
    sums: Vec<Vec<(usize, f32)>>,
    /// For each pixel of a row with `radius` pixels around it, where it comes from.
    continued: Vec<usize>,
    /// Length of a row in memory.
    stride: usize,
}

/// Room for one image.
#[derive(Clone, Debug)]
pub struct Scratch {
    /// Whether a row of tiles has changed.
    changed: Vec<bool>,
    /// `[3][S][stride]`: what has changed, and what it is after the sum over columns.
    change: Vec<f32>,
    smooth: Vec<f32>,
    row: Vec<f32>,
    /// The rows that a row is a sum of, as far as they have changed.
    terms: Vec<(usize, f32)>,
}

impl Smoother {
    /// `blur`, of images cut into `tiles`.
    pub fn new(blur: &GaussianBlur, tiles: Tiles) -> Self {
        let size = tiles.image_size();
        let matrix = blur.matrix(size);
        let terms = |row: &[f64]| {
            row.iter()
                .enumerate()
                .filter(|(_, &weight)| weight != 0.0)
                .map(|(from, &weight)| (from, weight as f32))
                .collect()
        };
        let radius = blur.radius();
        Self {
            tiles,
            weights: blur.weights().to_vec(),
            sums: matrix.chunks_exact(size).map(terms).collect(),
            continued: (0..size + 2 * radius).map(|x| blur.continued(x, size)).collect(),
            stride: size.next_multiple_of(BLOCK),
        }
    }

    /// Room for one image.
    pub fn scratch(&self) -> Scratch {
        let length = 3 * self.tiles.image_size() * self.stride;
        Scratch {
            changed: vec![false; self.tiles.image_size() / self.tiles.tile_size()],
            change: vec![0.0; length],
            smooth: vec![0.0; length],
            // Blocks read beyond the end.
            row: vec![0.0; self.stride + self.weights.len()],
            terms: Vec::new(),
        }
    }

    /// Begins an image that has not changed.
    pub fn begin(&self, scratch: &mut Scratch) {
        scratch.changed.fill(false);
    }

    /// Notes the change of a tile, `[3][T * T]`.
    pub fn change(&self, tile: usize, values: &[f32], scratch: &mut Scratch) {
        let (size, width, stride) = (self.tiles.image_size(), self.tiles.tile_size(), self.stride);
        let [top, left] = self.tiles.corner(tile);
        let changed = &mut scratch.changed[top / width];
        for (colour, plane) in values.chunks_exact(self.tiles.plane()).enumerate() {
            let rows = &mut scratch.change[(colour * size + top) * stride..][..width * stride];
            if !*changed {
                rows.fill(0.0);
            }
            for (row, values) in rows.chunks_exact_mut(stride).zip(plane.chunks_exact(width)) {
                row[left..left + width].copy_from_slice(values);
            }
        }
        *changed = true;
    }

    /// The sum of squares of the blurred change.
    pub fn squared_norm(&self, scratch: &mut Scratch) -> f64 {
        squared_norm(self, scratch)
    }
}

#[multiversion(targets("x86_64+avx2+fma"))]
fn squared_norm(smoother: &Smoother, scratch: &mut Scratch) -> f64 {
    let Smoother { tiles, weights, sums, continued, stride } = smoother;
    let (size, width) = (tiles.image_size(), tiles.tile_size());
    let Scratch { changed, change, smooth, row, terms } = scratch;
    for colour in 0..3 {
        for y in (0..size).filter(|y| changed[y / width]) {
            let first = (colour * size + y) * stride;
            for (value, &from) in row.iter_mut().zip(continued) {
                *value = change[first + from];
            }
            let out = &mut smooth[first..first + stride];
            for (block, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
                let mut sum = [0.0; BLOCK];
                for (tap, weight) in weights.iter().enumerate() {
                    let from = &row[block * BLOCK + tap..][..BLOCK];
                    for i in 0..BLOCK {
                        sum[i] = weight.mul_add(from[i], sum[i]);
                    }
                }
                *out = sum;
            }
            out[size..].fill(0.0);
        }
    }
    let mut squares = [0.0; BLOCK];
    for all in sums {
        terms.clear();
        terms.extend(all.iter().filter(|(from, _)| changed[from / width]));
        if terms.is_empty() {
            continue;
        }
        for colour in 0..3 {
            for block in 0..stride / BLOCK {
                let mut sum = [0.0; BLOCK];
                for (from, weight) in &*terms {
                    let from = &smooth[(colour * size + from) * stride + block * BLOCK..][..BLOCK];
                    for i in 0..BLOCK {
                        sum[i] = weight.mul_add(from[i], sum[i]);
                    }
                }
                for i in 0..BLOCK {
                    squares[i] = sum[i].mul_add(sum[i], squares[i]);
                }
            }
        }
    }
    squares.iter().map(|&x| f64::from(x)).sum()
}
