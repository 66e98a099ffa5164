//! Gaussian blur of images, as `scipy.ndimage.gaussian_filter` does it.
//!
//! A small object moved by more than its width leaves the pixel cost flat: blurring both frames
//! widens the basin that a planner can descend.

use multiversion::multiversion;
use ndarray::Array2;

use crate::{Error, Result};

/// A Gaussian blur over the two image axes, every channel on its own.
///
/// The kernel is cut off at four standard deviations and the image is continued by reflection
/// about the edges of its border pixels (`d c b a | a b c d | d c b a`); both are
/// `scipy.ndimage.gaussian_filter`'s defaults (`mode="reflect"`, `truncate=4`).
#[derive(Clone, Debug, PartialEq)]
pub struct GaussianBlur {
    sigma: f64,
    /// Normalised weights, `2 * radius + 1`.
    weights: Vec<f32>,
}

/// Memory that [`GaussianBlur::apply`] works in, for one shape of image.
#[derive(Clone, Debug)]
pub struct BlurScratch {
    /// The image after the vertical pass.
    vertical: Vec<f32>,
    /// One row continued to both sides.
    row: Vec<f32>,
    /// Where each tap of the kernel reads.
    offsets: Vec<usize>,
}

impl GaussianBlur {
    /// The largest accepted `sigma`, in pixels: far beyond any use on images of this project.
    pub const MAX_SIGMA: f64 = 1000.0;

    /// A blur of standard deviation `sigma` pixels; `None` where `sigma` is 0.
    ///
    /// # Errors
    /// `sigma` negative, not finite or above [`MAX_SIGMA`](Self::MAX_SIGMA); the error calls it
    /// `argument`.
    pub fn new(sigma: f64, argument: &'static str) -> Result<Option<Self>> {
        if !(0.0..=Self::MAX_SIGMA).contains(&sigma) {
            return Err(Error::invalid(
                argument,
                format!(
                    "must be a standard deviation in pixels within [0, {}], got {sigma}",
                    Self::MAX_SIGMA
                ),
            ));
        }
        // scipy leaves an axis alone below 1e-15.
        if sigma <= 1e-15 {
            return Ok(None);
        }
        let weights = kernel(sigma).into_iter().map(|w| w as f32).collect();
        Ok(Some(Self { sigma, weights }))
    }

    /// Standard deviation in pixels.
    pub fn sigma(&self) -> f64 {
        self.sigma
    }

    /// Pixels that the kernel reaches to each side: `4 * sigma`, rounded.
    pub fn radius(&self) -> usize {
        self.weights.len() / 2
    }

    /// Weights of the pixels up to [`radius`](Self::radius) to either side.
    pub(crate) fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// Where pixel `index` of `n` pixels in a row, continued by [`radius`](Self::radius) pixels to
    /// either side, comes from.
    pub(crate) fn continued(&self, index: usize, n: usize) -> usize {
        reflect(index as i64 - self.radius() as i64, n)
    }

    /// The blur of `n` pixels in a row as a matrix `[n, n]`, row-major: `out = matrix * in`.
    pub fn matrix(&self, n: usize) -> Vec<f64> {
        let weights = kernel(self.sigma);
        let radius = weights.len() / 2;
        let mut matrix = vec![0.0; n * n];
        for to in 0..n {
            for (tap, weight) in weights.iter().enumerate() {
                matrix[to * n + reflect(to as i64 + tap as i64 - radius as i64, n)] += weight;
            }
        }
        matrix
    }

    /// `G'G` of the blur `G` of `n` pixels in a row: what the squared length of a blurred row is a
    /// quadratic form of.
    pub fn gram_matrix(&self, n: usize) -> Array2<f32> {
        let (matrix, radius) = (self.matrix(n), self.radius());
        Array2::from_shape_fn((n, n), |(i, j)| {
            // A pixel reaches `radius` others to each side, also where it is reflected.
            let common = i.max(j).saturating_sub(radius)..(i.min(j) + radius + 1).min(n);
            common.map(|k| matrix[k * n + i] * matrix[k * n + j]).sum::<f64>() as f32
        })
    }

    /// Working memory for images `[height, width, channels]`.
    pub fn scratch(&self, height: usize, width: usize, channels: usize) -> BlurScratch {
        BlurScratch {
            vertical: vec![0.0; height * width * channels],
            row: vec![0.0; (width + 2 * self.radius()) * channels],
            offsets: vec![0; self.weights.len()],
        }
    }

    /// Blurs `image[height, width, channels]` in place.
    ///
    /// # Panics
    /// If `image` or `scratch` is of another shape.
    pub fn apply(
        &self,
        image: &mut [f32],
        height: usize,
        width: usize,
        channels: usize,
        scratch: &mut BlurScratch,
    ) {
        let stride = width * channels;
        let radius = self.radius();
        let BlurScratch { vertical, row, offsets } = scratch;
        assert_eq!(image.len(), height * stride);
        assert_eq!(vertical.len(), image.len());
        for (y, out) in vertical.chunks_exact_mut(stride).enumerate() {
            for (tap, offset) in offsets.iter_mut().enumerate() {
                *offset = reflect((y + tap) as i64 - radius as i64, height) * stride;
            }
            weighted_sum(image, offsets, &self.weights, out);
        }
        for (tap, offset) in offsets.iter_mut().enumerate() {
            *offset = tap * channels;
        }
        for (from, out) in vertical.chunks_exact(stride).zip(image.chunks_exact_mut(stride)) {
            let (left, rest) = row.split_at_mut(radius * channels);
            let (middle, right) = rest.split_at_mut(stride);
            middle.copy_from_slice(from);
            for x in 0..radius {
                let at = reflect(x as i64 - radius as i64, width) * channels;
                left[x * channels..][..channels].copy_from_slice(&from[at..at + channels]);
                let at = reflect((width + x) as i64, width) * channels;
                right[x * channels..][..channels].copy_from_slice(&from[at..at + channels]);
            }
            weighted_sum(row, offsets, &self.weights, out);
        }
    }
}

/// Normalised Gaussian weights out to four standard deviations.
fn kernel(sigma: f64) -> Vec<f64> {
    let radius = (4.0 * sigma + 0.5) as i64;
    let weights: Vec<f64> =
        (-radius..=radius).map(|x| (-0.5 * (x * x) as f64 / (sigma * sigma)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    weights.into_iter().map(|w| w / sum).collect()
}

/// The pixel that stands at `index` when `n` pixels are continued by reflection.
fn reflect(index: i64, n: usize) -> usize {
    let n = n as i64;
    let folded = index.rem_euclid(2 * n);
    (if folded < n { folded } else { 2 * n - 1 - folded }) as usize
}

/// `out[i] = sum over taps of weights[tap] * from[offsets[tap] + i]`.
#[multiversion(targets("x86_64+avx2"))]
fn weighted_sum(from: &[f32], offsets: &[usize], weights: &[f32], out: &mut [f32]) {
    // Enough sums to keep the adders busy, few enough to stay in registers.
    const LANES: usize = 64;
    let (lanes, rest) = out.as_chunks_mut::<LANES>();
    let done = lanes.len() * LANES;
    for (block, out) in lanes.iter_mut().enumerate() {
        let mut sum = [0.0_f32; LANES];
        for (&offset, &weight) in offsets.iter().zip(weights) {
            let from = &from[offset + block * LANES..][..LANES];
            for lane in 0..LANES {
                sum[lane] += weight * from[lane];
            }
        }
        *out = sum;
    }
    for (i, out) in rest.iter_mut().enumerate() {
        *out = offsets.iter().zip(weights).map(|(&o, &w)| w * from[o + done + i]).sum();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// `scipy.ndimage.gaussian_filter1d([0, 0, 0, 1, 0, 0, 5], 1.0)`.
    #[test]
    fn matches_scipy_on_a_row() {
        let expected = [
            0.004565692244646007,
            0.05399112742070441,
            0.24264059877967442,
            0.42177193057932777,
            0.5340863908602791,
            1.53380399280723,
            3.2091402673081384,
        ];
        let blur = GaussianBlur::new(1.0, "blur").unwrap().unwrap();
        let mut row = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 5.0];
        let mut scratch = blur.scratch(1, 7, 1);
        blur.apply(&mut row, 1, 7, 1, &mut scratch);
        for (got, want) in row.iter().zip(expected) {
            assert!((f64::from(*got) - want).abs() < 1e-6, "{row:?}");
        }
    }

    #[test]
    fn equals_its_matrix_on_both_axes_even_where_the_kernel_is_wider_than_the_image() {
        let (h, w, c) = (5, 9, 3);
        for sigma in [0.3, 1.0, 3.0, 7.0] {
            let blur = GaussianBlur::new(sigma, "blur").unwrap().unwrap();
            let mut image: Vec<f32> =
                (0..h * w * c).map(|i| ((i * 37) % 11) as f32 / 11.0).collect();
            let (vertical, horizontal) = (blur.matrix(h), blur.matrix(w));
            let mut expected = vec![0.0; image.len()];
            for y in 0..h {
                for x in 0..w {
                    for ch in 0..c {
                        for v in 0..h {
                            for u in 0..w {
                                expected[(y * w + x) * c + ch] += vertical[y * h + v]
                                    * horizontal[x * w + u]
                                    * f64::from(image[(v * w + u) * c + ch]);
                            }
                        }
                    }
                }
            }
            let mut scratch = blur.scratch(h, w, c);
            blur.apply(&mut image, h, w, c, &mut scratch);
            for (got, want) in image.iter().zip(expected) {
                assert!((f64::from(*got) - want).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn gram_matrix_gives_the_squared_length_of_a_blurred_row() {
        for (n, sigma) in [(16, 1.0), (5, 7.0), (1, 2.0)] {
            let blur = GaussianBlur::new(sigma, "blur").unwrap().unwrap();
            let row: Vec<f32> = (0..n).map(|i| ((i * 7) % 5) as f32).collect();
            let row = ndarray::Array1::from_vec(row);
            let by_gram = row.dot(&blur.gram_matrix(n).dot(&row));
            let mut blurred = row.to_vec();
            blur.apply(&mut blurred, 1, n, 1, &mut blur.scratch(1, n, 1));
            let expected: f32 = blurred.iter().map(|x| x * x).sum();
            assert!((by_gram - expected).abs() <= 1e-5 * expected, "{by_gram}, not {expected}");
        }
    }

    #[test]
    fn keeps_a_constant_image() {
        let blur = GaussianBlur::new(2.5, "blur").unwrap().unwrap();
        let mut image = vec![0.75; 16 * 16];
        blur.apply(&mut image, 16, 16, 1, &mut blur.scratch(16, 16, 1));
        assert!(image.iter().all(|v| (v - 0.75).abs() < 1e-6));
    }

    #[test]
    fn refuses_a_sigma_that_is_none() {
        for sigma in [-1.0, f64::NAN, f64::INFINITY, 1e9] {
            let said = GaussianBlur::new(sigma, "blur").unwrap_err().to_string();
            assert!(said.starts_with("blur: "), "{said}");
        }
        assert_eq!(GaussianBlur::new(0.0, "blur").unwrap(), None);
    }
}
