//! The squared length of a blurred change, where most of the image has not changed.
//!
//! The blur is [`GaussianBlur`]'s, a sum over columns and then over rows. Rows of tiles that have not
//! changed are zero: the first sum skips them, and the second those before and after all others.

use multiversion::multiversion;

use super::tiles::Tiles;
use crate::image::GaussianBlur;

/// Pixels of a row that are summed at once; they fill eight vector registers.
const BLOCK: usize = 64;

/// A blur of images in tiles.
#[derive(Clone, Debug)]
pub struct Smoother {
    tiles: Tiles,
    /// Weights of pixels up to `radius` to either side.
    weights: Vec<f32>,
    /// For each row, the first of the rows that it is a sum of, and the weights of these.
    sums: Vec<(usize, Vec<f32>)>,
    /// Pixels beyond the border of a row, and the pixels inside that they are like; both count from
    /// `radius` pixels before the row.
    beyond: Vec<(usize, usize)>,
    /// Length of a row of sums, and of a row of change with what is beyond it.
    stride: usize,
    long: usize,
}

/// Room for one image.
#[derive(Clone, Debug)]
pub struct Scratch {
    /// Whether a row has changed.
    changed: Vec<bool>,
    /// What has changed, `[3][S][long]`.
    change: Vec<f32>,
    /// What one colour of it is after the sum over columns, `[S][stride]`.
    smooth: Vec<f32>,
}

impl Smoother {
    /// `blur`, of images cut into `tiles`.
    pub fn new(blur: &GaussianBlur, tiles: Tiles) -> Self {
        let size = tiles.image_size();
        let matrix = blur.matrix(size);
        let terms = |row: &[f64]| {
            let first = row.iter().position(|&weight| weight != 0.0).unwrap_or(0);
            let last = row.iter().rposition(|&weight| weight != 0.0).unwrap_or(0);
            (first, row[first..=last].iter().map(|&weight| weight as f32).collect())
        };
        let radius = blur.radius();
        Self {
            tiles,
            weights: blur.weights().to_vec(),
            sums: matrix.chunks_exact(size).map(terms).collect(),
            beyond: (0..radius)
                .chain(radius + size..2 * radius + size)
                .map(|x| (x, radius + blur.continued(x, size)))
                .collect(),
            stride: size.next_multiple_of(BLOCK),
            long: size.next_multiple_of(BLOCK) + 2 * radius,
        }
    }

    /// Room for one image.
    pub fn scratch(&self) -> Scratch {
        let size = self.tiles.image_size();
        Scratch {
            changed: vec![false; size],
            change: vec![0.0; 3 * size * self.long],
            smooth: vec![0.0; size * self.stride],
        }
    }

    /// Begins an image that has not changed.
    pub fn begin(&self, scratch: &mut Scratch) {
        scratch.changed.fill(false);
    }

    /// Notes the change of a tile, `[3][T * T]`.
    pub fn change(&self, tile: usize, values: &[f32], scratch: &mut Scratch) {
        let (size, width, long) = (self.tiles.image_size(), self.tiles.tile_size(), self.long);
        let [top, left] = self.tiles.corner(tile);
        let left = left + self.weights.len() / 2;
        for (colour, plane) in values.chunks_exact(self.tiles.plane()).enumerate() {
            let rows = &mut scratch.change[(colour * size + top) * long..][..width * long];
            if !scratch.changed[top] {
                rows.fill(0.0);
            }
            for (row, values) in rows.chunks_exact_mut(long).zip(plane.chunks_exact(width)) {
                row[left..left + width].copy_from_slice(values);
            }
        }
        scratch.changed[top..top + width].fill(true);
    }

    /// The sum of squares of the blurred change.
    pub fn squared_norm(&self, scratch: &mut Scratch) -> f64 {
        squared_norm(self, scratch)
    }
}

#[multiversion(targets("x86_64+avx2+fma"))]
fn squared_norm(smoother: &Smoother, scratch: &mut Scratch) -> f64 {
    let Smoother { tiles, weights, sums, beyond, stride, long } = smoother;
    let size = tiles.image_size();
    let Scratch { changed, change, smooth } = scratch;
    let Some(begin) = changed.iter().position(|&changed| changed) else { return 0.0 };
    let end = changed.iter().rposition(|&changed| changed).map_or(0, |last| last + 1);
    let mut squares = [0.0; BLOCK];
    for colour in 0..3 {
        for (y, out) in smooth.chunks_exact_mut(*stride).enumerate().take(end).skip(begin) {
            if !changed[y] {
                out.fill(0.0);
                continue;
            }
            let row = &mut change[(colour * size + y) * long..][..*long];
            for &(to, from) in beyond {
                row[to] = row[from];
            }
            for (block, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
                let mut sum = [0.0; BLOCK];
                for (from, weight) in row[block * BLOCK..].windows(BLOCK).zip(weights) {
                    for i in 0..BLOCK {
                        sum[i] = weight.mul_add(from[i], sum[i]);
                    }
                }
                *out = sum;
            }
            out[size..].fill(0.0);
        }
        for (first, weights) in sums {
            // The rows that both are terms of the sum and may have changed.
            let (from, to) = (begin.max(*first), end.min(first + weights.len()));
            if from >= to {
                continue;
            }
            let weights = &weights[from - first..to - first];
            let rows = &smooth[from * stride..to * stride];
            for block in 0..stride / BLOCK {
                let mut sum = [0.0; BLOCK];
                for (row, weight) in rows.chunks_exact(*stride).zip(weights) {
                    let row = &row[block * BLOCK..][..BLOCK];
                    for i in 0..BLOCK {
                        sum[i] = weight.mul_add(row[i], sum[i]);
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use proptest::prelude::*;

    use super::super::toys::{Draws, SIZE};
    use super::*;

    proptest! {
        #[test]
        fn the_length_is_that_of_the_whole_image_blurred(
            seed in 0_u64..1000,
            sigma in prop::sample::select(vec![0.3, 1.0, 2.5, 9.0]),
            tile in prop::sample::select(vec![4_usize, 8]),
            which in prop::collection::vec(any::<prop::sample::Index>(), 0..9),
        ) {
            let tiles = Tiles::new(SIZE, tile).unwrap();
            let blur = GaussianBlur::new(sigma, "blur").unwrap().unwrap();
            let smoother = Smoother::new(&blur, tiles);
            let mut scratch = smoother.scratch();
            let mut draws = Draws::new(seed);
            // Once before, so that what is left of it would show.
            for round in 0..2 {
                smoother.begin(&mut scratch);
                let mut image = vec![0.0; SIZE * SIZE * 3];
                for at in &which[which.len() / 2 * round..] {
                    let values: Vec<f32> =
                        (0..tiles.values()).map(|_| draws.between(-255.0, 255.0)).collect();
                    let number = at.index(tiles.count());
                    smoother.change(number, &values, &mut scratch);
                    tiles.place(number, &values, &mut image);
                }
                blur.apply(&mut image, SIZE, SIZE, 3, &mut blur.scratch(SIZE, SIZE, 3));
                let expected: f64 = image.iter().map(|&x| f64::from(x).powi(2)).sum();
                let found = smoother.squared_norm(&mut scratch);
                prop_assert!((found - expected).abs() <= 1e-5 * expected, "{found}, {expected}");
            }
        }
    }
}
