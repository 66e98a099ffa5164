//! What the cell sees around every point of a scene, computed once for the scene.
//!
//! The cell's first layer looks at a patch of the scene around the keypoint. It is linear in the
//! scene, so at whole pixels it is a convolution, and between pixels it is the bilinear
//! interpolation of that convolution, to the last term: patches, too, are read bilinearly. A
//! candidate therefore pays four multiply-adds per hidden unit instead of one per pixel of the
//! patch.

use crate::lanes::{Lanes, LANES};
use crate::rows::{Vector, WIDTH};

/// First-layer features of a scene at every whole pixel, `[S, S, hidden]`, filled up with zeros to
/// whole vectors of hidden units.
#[derive(Clone, Debug)]
pub struct SceneField {
    size: usize,
    /// Vectors of one pixel.
    stride: usize,
    features: Vec<Vector>,
}

/// A point between four pixels: where the features of the upper left one and of the one below it
/// begin, and the weights of upper left, upper right, lower left and lower right.
pub(super) struct Place {
    upper: usize,
    lower: usize,
    weights: [f32; 4],
}

/// A whole number of at most 2^23 that is not negative, without the checks of `as`, which are done
/// number by number.
#[inline(always)]
fn whole(number: f32) -> u32 {
    const SHIFT: f32 = (1 << 23) as f32;
    (number + SHIFT).to_bits() - SHIFT.to_bits()
}

/// Places of a block of points.
pub(super) struct Places {
    upper: [u32; LANES],
    /// From the features of a pixel to those of the one below.
    down: usize,
    weights: [[f32; LANES]; 4],
}

impl Places {
    /// Place of one point.
    #[inline(always)]
    pub(super) fn of(&self, lane: usize) -> Place {
        let upper = self.upper[lane] as usize;
        let [a, b, c, d] = &self.weights;
        Place { upper, lower: upper + self.down, weights: [a[lane], b[lane], c[lane], d[lane]] }
    }
}

impl SceneField {
    /// Convolves a scene `map[S, S]` (`map` holds its rows one after the other) with the first
    /// layer: `patch[taps * taps][hidden]`, `bias[hidden]`, both in whole vectors of hidden units,
    /// taps `spacing` pixels apart. Outside the scene its border goes on.
    ///
    /// `S^2 * taps^2 * hidden` multiply-adds.
    pub(super) fn new(
        map: &[f32],
        size: usize,
        patch: &[Vector],
        bias: &[Vector],
        spacing: usize,
    ) -> Self {
        let stride = bias.len();
        let mut features = vec![Vector::ZERO; size * size * stride];
        convolve(map, size, patch, bias, spacing, &mut features);
        Self { size, stride, features }
    }

    /// Where points (rows, columns in pixels, moved into the scene) lie.
    #[inline(always)]
    pub(super) fn places(&self, points: &[Lanes; 2]) -> Places {
        let last = (self.size - 1) as f32;
        // The upper neighbour of the last pixel counts with weight zero; stay inside.
        let most = (self.size - 2) as f32;
        let mut upper = [0; LANES];
        let mut weights = [[0.0; LANES]; 4];
        for lane in 0..LANES {
            let (y, x) = (points[0][lane].clamp(0.0, last), points[1][lane].clamp(0.0, last));
            // What is not a number is nowhere, and read at the first pixel.
            let (top, left) = (y.max(0.0).min(most).floor(), x.max(0.0).min(most).floor());
            let (down, right) = (y - top, x - left);
            upper[lane] = (whole(top) * self.size as u32 + whole(left)) * self.stride as u32;
            weights[0][lane] = (1.0 - down) * (1.0 - right);
            weights[1][lane] = (1.0 - down) * right;
            weights[2][lane] = down * (1.0 - right);
            weights[3][lane] = down * right;
        }
        Places { upper, down: self.size * self.stride, weights }
    }

    /// The features at a place: `V` vectors from vector `from` on.
    #[inline(always)]
    pub(super) fn sample<const V: usize>(&self, place: &Place, from: usize) -> [Vector; V] {
        let weights = place.weights;
        let pair = |row: usize| {
            let both = &self.features[row..][..2 * self.stride];
            (&both[from..from + V], &both[self.stride + from..self.stride + from + V])
        };
        let ((a, b), (c, d)) = (pair(place.upper), pair(place.lower));
        // A loop: closures are compiled for the oldest processors.
        let mut sums = [Vector::ZERO; V];
        for (vector, sum) in sums.iter_mut().enumerate() {
            let (a, b) = (&a[vector].0, &b[vector].0);
            let (c, d) = (&c[vector].0, &d[vector].0);
            for unit in 0..WIDTH {
                let upper = weights[1].mul_add(b[unit], weights[0] * a[unit]);
                sum.0[unit] = weights[3].mul_add(d[unit], weights[2].mul_add(c[unit], upper));
            }
        }
        sums
    }
}

#[multiversion::multiversion(targets("x86_64+avx2+fma"))]
fn convolve(
    map: &[f32],
    size: usize,
    patch: &[Vector],
    bias: &[Vector],
    spacing: usize,
    features: &mut [Vector],
) {
    let stride = bias.len();
    let taps = (patch.len() / stride).isqrt();
    let reach = (taps / 2 * spacing) as isize;
    let last = size as isize - 1;
    let at = |position: usize, tap: usize| -> usize {
        (position as isize + (tap * spacing) as isize - reach).clamp(0, last) as usize
    };
    for (pixel, here) in features.chunks_exact_mut(stride).enumerate() {
        let (row, column) = (pixel / size, pixel % size);
        here.copy_from_slice(bias);
        for tap_row in 0..taps {
            let line = &map[at(row, tap_row) * size..][..size];
            for tap_column in 0..taps {
                let value = line[at(column, tap_column)];
                let weights = &patch[(tap_row * taps + tap_column) * stride..][..stride];
                for (sum, weights) in here.iter_mut().zip(weights) {
                    sum.add(weights, value);
                }
            }
        }
    }
}
