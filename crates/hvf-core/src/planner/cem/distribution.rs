//! What candidates are drawn from: the first iteration's distribution and the Gaussian that the
//! elites are refitted to.

use crate::planner::sampler::Draw;

/// Distribution of the first iteration's candidates, over all `N` dimensions of one.
#[derive(Clone, Debug, PartialEq)]
pub enum Initial {
    /// Uniform in a box.
    Uniform {
        /// Lower bounds, `[N]`.
        low: Vec<f32>,
        /// Upper bounds, `[N]`.
        high: Vec<f32>,
    },
    /// A diagonal Gaussian, clipped to the bounds of the problem.
    Normal {
        /// Means, `[N]`.
        mean: Vec<f32>,
        /// Standard deviations, `[N]`.
        std: Vec<f32>,
    },
}

/// The box that candidates are clipped to, over all `N` dimensions.
#[derive(Clone, Debug, PartialEq)]
pub struct Bounds {
    /// Lower bounds, `[N]`.
    pub low: Vec<f32>,
    /// Upper bounds, `[N]`.
    pub high: Vec<f32>,
}

impl Bounds {
    /// No bounds in `dimensions` dimensions.
    pub fn unbounded(dimensions: usize) -> Self {
        Self { low: vec![f32::NEG_INFINITY; dimensions], high: vec![f32::INFINITY; dimensions] }
    }
}

impl Initial {
    /// This distribution within `bounds`, for the sampler.
    pub(super) fn draw<'a>(&'a self, bounds: &'a Bounds) -> Draw<'a> {
        match self {
            Initial::Uniform { low, high } => Draw::Uniform { low, high },
            Initial::Normal { mean, std } => {
                Draw::Normal { mean, std, low: &bounds.low, high: &bounds.high }
            }
        }
    }
}

/// A Gaussian with independent dimensions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DiagonalGaussian {
    /// Means, `[N]`.
    pub mean: Vec<f32>,
    /// Standard deviations, `[N]`.
    pub std: Vec<f32>,
}

impl DiagonalGaussian {
    /// The maximum-likelihood fit to the rows of `elites`, `[E, N]` (variance divided by `E`).
    /// Sums run over the rows in order and in double precision.
    pub fn fit(elites: &[f32], dimensions: usize) -> Self {
        let count = (elites.len() / dimensions) as f64;
        let mut mean = vec![0.0_f64; dimensions];
        for row in elites.chunks_exact(dimensions) {
            for (sum, &value) in mean.iter_mut().zip(row) {
                *sum += f64::from(value);
            }
        }
        mean.iter_mut().for_each(|sum| *sum /= count);
        let mut variance = vec![0.0_f64; dimensions];
        for row in elites.chunks_exact(dimensions) {
            for ((sum, &value), &mean) in variance.iter_mut().zip(row).zip(&mean) {
                let deviation = f64::from(value) - mean;
                *sum += deviation * deviation;
            }
        }
        Self {
            mean: mean.iter().map(|&mean| mean as f32).collect(),
            std: variance.iter().map(|&sum| (sum / count).sqrt() as f32).collect(),
        }
    }

    /// This distribution within `bounds`, for the sampler.
    pub(super) fn draw<'a>(&'a self, bounds: &'a Bounds) -> Draw<'a> {
        Draw::Normal { mean: &self.mean, std: &self.std, low: &bounds.low, high: &bounds.high }
    }

    /// Largest standard deviation of any dimension.
    pub fn max_std(&self) -> f32 {
        self.std.iter().copied().fold(0.0, f32::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fit_gives_mean_and_population_deviation() {
        let fit = DiagonalGaussian::fit(&[1.0, 10.0, 3.0, 10.0, 5.0, 10.0], 2);
        assert_eq!(fit.mean, [3.0, 10.0]);
        let expected = (8.0_f32 / 3.0).sqrt();
        assert_eq!(fit.std, [expected, 0.0]);
        assert_eq!(fit.max_std(), expected);
    }

    #[test]
    fn fit_is_exact_far_from_zero() {
        let fit = DiagonalGaussian::fit(&[1e6, 1e6 + 1.0], 1);
        assert_eq!(fit.std, [0.5]);
    }
}
