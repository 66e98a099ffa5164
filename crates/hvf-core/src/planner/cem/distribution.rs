//! What candidates are drawn from: the first iteration's distribution and the Gaussian that the
//! elites are refitted to.

use nalgebra::DMatrix;

use super::config::{CemConfig, Covariance};
use super::noise::{Coloured, Correlation};
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

    /// The Gaussian of the same means and standard deviations.
    pub(super) fn moments(&self) -> Gaussian {
        let (mean, std) = match self {
            Initial::Normal { mean, std } => (mean.clone(), std.clone()),
            Initial::Uniform { low, high } => low
                .iter()
                .zip(high)
                .map(|(&low, &high)| {
                    let (low, high) = (f64::from(low), f64::from(high));
                    (((low + high) / 2.0) as f32, ((high - low) / 12.0_f64.sqrt()) as f32)
                })
                .unzip(),
        };
        Gaussian { mean, std, correlation: None }
    }
}

/// Where the search of one problem begins.
#[derive(Clone, Debug, PartialEq)]
pub struct Start {
    /// Distribution of the first iteration's candidates.
    pub initial: Initial,
    /// Candidates that take the place of the first ones drawn, `[S, N]`: what was good before.
    pub candidates: Vec<f32>,
}

impl From<Initial> for Start {
    fn from(initial: Initial) -> Self {
        Self { initial, candidates: Vec::new() }
    }
}

/// What all problems' candidates have in common.
#[derive(Clone, Debug, PartialEq)]
pub struct Space {
    /// The box that they are clipped to.
    pub bounds: Bounds,
    /// How their values depend on each other over time, if they do.
    pub noise: Option<Coloured>,
}

impl From<Bounds> for Space {
    fn from(bounds: Bounds) -> Self {
        Self { bounds, noise: None }
    }
}

/// A Gaussian, whose dimensions are independent unless it has correlations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussian {
    /// Means, `[N]`.
    pub mean: Vec<f32>,
    /// Standard deviations, `[N]`.
    pub std: Vec<f32>,
    /// Correlations, if any are kept.
    pub correlation: Option<Correlation>,
}

impl Gaussian {
    /// The maximum-likelihood fit of independent dimensions to the rows of `elites`, `[E, N]`, that
    /// count by `weights`, `[E]` (variance divided by their sum). Sums run over the rows in order
    /// and in double precision.
    pub fn fit(elites: &[f32], weights: &[f64], dimensions: usize) -> Self {
        let (mean, variance) = moments(elites, weights, dimensions);
        Self {
            mean: mean.iter().map(|&mean| mean as f32).collect(),
            std: variance.iter().map(|&variance| variance.sqrt() as f32).collect(),
            correlation: None,
        }
    }

    /// What `config` makes of this distribution once the elites, `[E, N]`, and their costs, best
    /// first, are known.
    pub(super) fn refitted(&self, config: &CemConfig, elites: &[f32], costs: &[f32]) -> Self {
        let dimensions = elites.len() / costs.len();
        let weights = weights(costs, config.temperature);
        let mut fit = Self::fit(elites, &weights, dimensions);
        if let Covariance::Full { shrinkage } = config.covariance {
            let covariance = covariance(elites, &weights, dimensions);
            fit.correlation = Correlation::of(&covariance, shrinkage)
                .and_then(|new| new.blended(self.correlation.as_ref(), config.momentum));
        }
        if config.momentum > 0.0 {
            let blend = |old: &[f32], new: &mut [f32]| {
                for (&old, new) in old.iter().zip(new) {
                    let (before, after) = (f64::from(old), f64::from(*new));
                    *new = (config.momentum * before + (1.0 - config.momentum) * after) as f32;
                }
            };
            blend(&self.mean, &mut fit.mean);
            blend(&self.std, &mut fit.std);
        }
        let least = config.min_std as f32;
        fit.std.iter_mut().for_each(|std| *std = std.max(least));
        fit
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

/// How much each of the elites counts, by costs that are sorted: the best 1, all 1 without a
/// temperature (Williams et al., "Information theoretic MPC", ICRA 2017, equation 34).
fn weights(costs: &[f32], temperature: Option<f64>) -> Vec<f64> {
    let best = costs[0];
    let weight = |&cost: &f32| match temperature {
        // Infinite costs, too, are as good as each other.
        Some(temperature) if cost != best => {
            libm::exp((f64::from(best) - f64::from(cost)) / temperature)
        }
        _ => 1.0,
    };
    costs.iter().map(weight).collect()
}

/// Weighted means and variances of the rows of `elites`, `[N]` each.
fn moments(elites: &[f32], weights: &[f64], dimensions: usize) -> (Vec<f64>, Vec<f64>) {
    let total: f64 = weights.iter().sum();
    let mut mean = vec![0.0_f64; dimensions];
    for (row, &weight) in elites.chunks_exact(dimensions).zip(weights) {
        for (sum, &value) in mean.iter_mut().zip(row) {
            *sum += weight * f64::from(value);
        }
    }
    mean.iter_mut().for_each(|sum| *sum /= total);
    let mut variance = vec![0.0_f64; dimensions];
    for (row, &weight) in elites.chunks_exact(dimensions).zip(weights) {
        for ((sum, &value), &mean) in variance.iter_mut().zip(row).zip(&mean) {
            let deviation = f64::from(value) - mean;
            *sum += weight * (deviation * deviation);
        }
    }
    variance.iter_mut().for_each(|sum| *sum /= total);
    (mean, variance)
}

/// Weighted covariance of the rows of `elites`, `[N, N]`.
fn covariance(elites: &[f32], weights: &[f64], dimensions: usize) -> DMatrix<f64> {
    let (mean, _) = moments(elites, weights, dimensions);
    let total: f64 = weights.iter().sum();
    let mut sums = DMatrix::zeros(dimensions, dimensions);
    let mut deviation = vec![0.0_f64; dimensions];
    for (row, &weight) in elites.chunks_exact(dimensions).zip(weights) {
        for ((deviation, &value), &mean) in deviation.iter_mut().zip(row).zip(&mean) {
            *deviation = f64::from(value) - mean;
        }
        for column in 0..dimensions {
            for row in 0..=column {
                sums[(row, column)] += weight * deviation[row] * deviation[column];
            }
        }
    }
    sums.fill_lower_triangle_with_upper_triangle();
    sums / total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fit_gives_mean_and_population_deviation() {
        let fit = Gaussian::fit(&[1.0, 10.0, 3.0, 10.0, 5.0, 10.0], &[1.0; 3], 2);
        assert_eq!(fit.mean, [3.0, 10.0]);
        let expected = (8.0_f32 / 3.0).sqrt();
        assert_eq!(fit.std, [expected, 0.0]);
        assert_eq!(fit.max_std(), expected);
    }

    #[test]
    fn fit_is_exact_far_from_zero() {
        let fit = Gaussian::fit(&[1e6, 1e6 + 1.0], &[1.0; 2], 1);
        assert_eq!(fit.std, [0.5]);
    }
}
