//! Budget and options of the cross-entropy method.

use crate::planner::sampler;
use crate::{Error, Result};

/// Most values of one problem's candidates: 1 GiB.
pub(in crate::planner) const MAX_VALUES: usize = 1 << 28;

/// Which iterations the answer may come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum BestOf {
    /// All: the candidate with the lowest cost that was ever seen.
    #[default]
    All,
    /// The last that was run, kept elites included: what the authors' released code answers.
    Last,
}

/// Budget and options of one optimisation.
///
/// More may come: outside this crate, change the fields of a [`default`](Self::default).
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct CemConfig {
    /// Candidates per iteration and problem, `D` (subgoal search: `M`).
    pub samples: usize,
    /// Candidates that the distribution is refitted to, `E` (`D*`, `M*`).
    pub elites: usize,
    /// Most iterations.
    pub iterations: usize,
    /// A problem is done when no variance is left above this (squared units of a candidate).
    pub min_variance: f64,
    /// Best candidates that compete again in the next iteration, with the cost they had.
    pub keep_elites: usize,
    /// Which iterations the answer may come from.
    pub best: BestOf,
    /// Share of the old mean, deviations and correlations that a refit keeps, from 0 (none) to
    /// below 1 (iCEM's `alpha`).
    pub momentum: f64,
    /// By how much each iteration has fewer samples than the one before, from 1 (as many): `D
    /// decay^-i`, but at least twice the elites (iCEM's `gamma`).
    pub samples_decay: f64,
    /// Elites count by `exp((best - cost) / temperature)` in the refit (MPPI's `lambda`, in units of
    /// a cost); all alike where there is none.
    pub temperature: Option<f64>,
    /// Least standard deviation of a refitted dimension (units of a candidate).
    pub min_std: f64,
    /// What of the elites' covariance the refit keeps.
    pub covariance: Covariance,
}

/// What of the elites' covariance a refit keeps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Covariance {
    /// The variances: dimensions are drawn independently of each other.
    #[default]
    Diagonal,
    /// The correlations, too, shrunk towards none: `(1 - shrinkage) R + shrinkage I`. For few
    /// dimensions that depend on each other, such as the latents of subgoals on one way.
    Full {
        /// From above 0 to 1, which draws from the same distribution as [`Self::Diagonal`].
        shrinkage: f64,
    },
}

/// Most dimensions of a candidate whose correlations are kept: each draw takes their square.
pub const MAX_CORRELATED: usize = 256;

impl Default for CemConfig {
    /// The paper's maze: 200 samples, 40 elites, 5 iterations, variance 1e-3.
    fn default() -> Self {
        Self {
            samples: 200,
            elites: 40,
            iterations: 5,
            min_variance: 1e-3,
            keep_elites: 0,
            best: BestOf::All,
            momentum: 0.0,
            samples_decay: 1.0,
            temperature: None,
            min_std: 0.0,
            covariance: Covariance::Diagonal,
        }
    }
}

impl CemConfig {
    /// Checks the ranges of all fields.
    ///
    /// # Errors
    /// Names the field that is out of range.
    pub fn validate(&self) -> Result<()> {
        if self.samples == 0 || self.samples > MAX_VALUES {
            return Err(Error::invalid(
                "samples",
                format!("must be between 1 and {MAX_VALUES}, got {}", self.samples),
            ));
        }
        if self.elites == 0 || self.elites > self.samples {
            return Err(Error::invalid(
                "elites",
                format!("must be between 1 and samples ({}), got {}", self.samples, self.elites),
            ));
        }
        if self.iterations == 0 || self.iterations > sampler::MAX_ITERATIONS {
            let most = sampler::MAX_ITERATIONS;
            return Err(Error::invalid(
                "iterations",
                format!("must be between 1 and {most}, got {}", self.iterations),
            ));
        }
        if !(self.min_variance >= 0.0 && self.min_variance.is_finite()) {
            return Err(Error::invalid(
                "min_variance",
                format!("must be finite and not negative, got {}", self.min_variance),
            ));
        }
        if self.keep_elites > self.elites {
            return Err(Error::invalid(
                "keep_elites",
                format!("must be at most elites ({}), got {}", self.elites, self.keep_elites),
            ));
        }
        self.validate_refit()
    }

    fn validate_refit(&self) -> Result<()> {
        let check = |fits: bool, argument, expected: &str, found: f64| match fits {
            true => Ok(()),
            false => Err(Error::invalid(argument, format!("must be {expected}, got {found}"))),
        };
        check((0.0..1.0).contains(&self.momentum), "momentum", "from 0 to below 1", self.momentum)?;
        check(
            self.samples_decay >= 1.0 && self.samples_decay.is_finite(),
            "samples_decay",
            "finite and at least 1",
            self.samples_decay,
        )?;
        if let Some(temperature) = self.temperature {
            let fits = temperature > 0.0 && temperature.is_finite();
            check(fits, "temperature", "finite and positive", temperature)?;
        }
        let longest = self.min_std as f32 * sampler::LONGEST_NORMAL;
        check(
            self.min_std >= 0.0 && longest.is_finite(),
            "min_std",
            "finite and not negative",
            self.min_std,
        )?;
        if let Covariance::Full { shrinkage } = self.covariance {
            // Below, a correlation matrix of few elites has no factor in double precision.
            let fits = (1e-6..=1.0).contains(&shrinkage);
            check(fits, "shrinkage", "from 1e-6 to 1", shrinkage)?;
        }
        Ok(())
    }

    /// Samples of one iteration, counted from 0.
    pub fn samples_in(&self, iteration: usize) -> usize {
        if self.samples_decay == 1.0 {
            return self.samples;
        }
        let least = self.elites.saturating_mul(2).min(self.samples);
        let mut samples = self.samples as f64;
        for _ in 0..iteration {
            samples /= self.samples_decay;
            if samples <= least as f64 {
                return least;
            }
        }
        samples as usize
    }
}
