//! Noise whose values depend on each other: over time, or as those of the elites do.
//!
//! Both are white noise through a linear map that leaves every value's variance at 1, before it
//! is scaled and clipped as independent values are. Sums run in a fixed order in double precision,
//! and what is no sum, product, division or square root comes from `libm` in software, so that a
//! seed gives the same bits on every machine.

use std::f64::consts::{FRAC_1_SQRT_2, TAU};

use nalgebra::{Cholesky, DMatrix};

use crate::planner::sampler::{self, Draw, Stream};

/// Noise over the time steps of an action sequence, whose power falls with frequency as
/// `f^-beta` (Pinneri et al., "Sample-efficient cross-entropy method", CoRL 2020, section 3.1;
/// generated as Timmer & Koenig do, 1995).
///
/// # How it works
/// White noise is convolved, around the circle of `T` steps, with the kernel whose transform is
/// `max(k, 1)^(-beta / 2)` at frequency `k / T`: the constant part is as strong as the slowest
/// wave, as in the authors' code. The first step is therefore as close to the last as to the
/// second; and two steps or fewer have no colour.
#[derive(Clone, Debug, PartialEq)]
pub struct Coloured {
    /// What a step takes of the one `t` before it, around the circle, `[T]`.
    kernel: Vec<f64>,
    /// Values of one step, `A`.
    dim: usize,
}

impl Coloured {
    /// Noise of `steps` steps of `dim` values each, `[T, A]` in a candidate; `beta` 0 is white, 1
    /// pink, 2 red.
    pub fn new(beta: f64, steps: usize, dim: usize) -> Self {
        let amplitude = |k: usize| {
            let frequency = k.min(steps - k).max(1);
            libm::pow(frequency as f64, -beta / 2.0)
        };
        let power: f64 = (0..steps).map(|k| amplitude(k) * amplitude(k)).sum();
        let scale = (power * steps as f64).sqrt();
        let kernel = (0..steps).map(|lag| {
            let wave = |k: usize| {
                let turn = (k * lag % steps) as f64 / steps as f64;
                amplitude(k) * libm::cos(TAU * turn)
            };
            (0..steps).map(wave).sum::<f64>() / scale
        });
        Self { kernel: kernel.collect(), dim }
    }

    fn mix(&self, white: &[f32], mixed: &mut [f32]) {
        let steps = self.kernel.len();
        for step in 0..steps {
            for value in 0..self.dim {
                let parts = (0..steps).map(|lag| {
                    let from = (step + steps - lag) % steps;
                    self.kernel[lag] * f64::from(white[from * self.dim + value])
                });
                mixed[step * self.dim + value] = parts.sum::<f64>() as f32;
            }
        }
    }
}

/// How the dimensions of a candidate depend on each other.
#[derive(Clone, Debug, PartialEq)]
pub struct Correlation {
    /// Correlation matrix, `[N, N]`.
    matrix: DMatrix<f64>,
    /// Lower triangular, `[N, N]`; times its transpose it is the matrix.
    factor: DMatrix<f64>,
}

impl Correlation {
    /// Of a covariance matrix, shrunk: `(1 - shrinkage) R + shrinkage I`. A dimension without
    /// variance depends on none. `None` if rounding has left the matrix without a factor.
    pub(super) fn of(covariance: &DMatrix<f64>, shrinkage: f64) -> Option<Self> {
        let std: Vec<f64> = covariance.diagonal().iter().map(|variance| variance.sqrt()).collect();
        let matrix = DMatrix::from_fn(covariance.nrows(), covariance.ncols(), |row, column| {
            let scale = std[row] * std[column];
            match row == column {
                true => 1.0,
                false if scale > 0.0 => (1.0 - shrinkage) * covariance[(row, column)] / scale,
                false => 0.0,
            }
        });
        Self::factored(matrix)
    }

    /// `share` of `before` (no correlations, where there are none) and the rest of this one.
    pub(super) fn blended(self, before: Option<&Self>, share: f64) -> Option<Self> {
        if share == 0.0 {
            return Some(self);
        }
        let dimensions = self.matrix.nrows();
        let none = || DMatrix::identity(dimensions, dimensions);
        let old = before.map_or_else(none, |before| before.matrix.clone());
        Self::factored(old * share + self.matrix * (1.0 - share))
    }

    fn factored(matrix: DMatrix<f64>) -> Option<Self> {
        let factor = Cholesky::new(matrix.clone())?.unpack();
        Some(Self { matrix, factor })
    }

    /// The correlation matrix, `[N, N]`, row after row.
    pub fn matrix(&self) -> Vec<f64> {
        self.matrix.iter().copied().collect()
    }

    fn mix(&self, white: &[f32], mixed: &mut [f32]) {
        for (row, mixed) in mixed.iter_mut().enumerate() {
            let parts =
                (0..=row).map(|column| self.factor[(row, column)] * f64::from(white[column]));
            *mixed = parts.sum::<f64>() as f32;
        }
    }
}

/// What makes the values of one candidate depend on each other.
#[derive(Clone, Copy, Debug)]
pub(super) enum Mixing<'a> {
    /// Nothing.
    None,
    /// Time.
    Coloured(&'a Coloured),
    /// The elites did.
    Correlated(&'a Correlation),
}

/// [`sampler::draw`] with values that depend on each other.
///
/// Of a uniform distribution each value stays uniform: it is the normal distribution function of
/// its noise that is spread over the box.
pub(super) fn draw(
    stream: Stream,
    iteration: usize,
    samples: &[u32],
    mixing: Mixing<'_>,
    from: Draw<'_>,
    out: &mut [f32],
) {
    if samples.is_empty() {
        return;
    }
    let mix: &dyn Fn(&[f32], &mut [f32]) = match mixing {
        Mixing::None => return sampler::draw(stream, iteration, samples, from, out),
        Mixing::Coloured(noise) => &|white, mixed| noise.mix(white, mixed),
        Mixing::Correlated(noise) => &|white, mixed| noise.mix(white, mixed),
    };
    let dimensions = out.len() / samples.len();
    let (none, unit) = (vec![0.0; dimensions], vec![1.0; dimensions]);
    let (least, most) = (vec![f32::NEG_INFINITY; dimensions], vec![f32::INFINITY; dimensions]);
    let standard = Draw::Normal { mean: &none, std: &unit, low: &least, high: &most };
    sampler::draw(stream, iteration, samples, standard, out);
    let mut white = vec![0.0; dimensions];
    for row in out.chunks_exact_mut(dimensions) {
        white.copy_from_slice(row);
        mix(&white, row);
        match from {
            Draw::Uniform { low, high } => {
                for ((value, &low), &high) in row.iter_mut().zip(low).zip(high) {
                    let share = normal_distribution(f64::from(*value)) as f32;
                    *value = (low + (high - low) * share).clamp(low, high);
                }
            }
            Draw::Normal { mean, std, low, high } => {
                for (n, value) in row.iter_mut().enumerate() {
                    *value = (mean[n] + std[n] * *value).clamp(low[n], high[n]);
                }
            }
        }
    }
}

fn normal_distribution(x: f64) -> f64 {
    0.5 * libm::erfc(-x * FRAC_1_SQRT_2)
}

#[cfg(test)]
#[path = "noise_tests.rs"]
mod tests;
