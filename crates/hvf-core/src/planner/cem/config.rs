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

/// Budget of one optimisation.
#[derive(Clone, Debug, PartialEq)]
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
}

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
        Ok(())
    }
}
