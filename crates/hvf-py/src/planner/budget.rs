//! The budget and the options that both searches have, for actions and for subgoals.

use hvf_core_rs::planner::{BestOf, CemConfig, Covariance};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arguments::{Real, Text, Whole};

/// A default that no argument but the core's own fixes: of correlations that are kept.
pub const SHRINKAGE: f64 = 0.1;

/// What these arguments mean, as a part of the documentation of both classes.
macro_rules! budget_doc {
    () => {
        "    samples: Samples per iteration: candidate plans (`D`), or sets of subgoals (`M`).
    elites: Samples that the distribution is refitted to (`D*`, `M*`), at most `samples`.
    iterations: Most iterations.
    min_variance: Variance below which a problem is done, in squared units of an action or a
        latent.
    keep_elites: Best samples that compete again in the next iteration, with the cost they had;
        at most `elites`.
    best: Where the answer comes from: 'all', the sample with the lowest cost of all
        iterations, or 'last', that of the last iteration that was run (kept elites included),
        as in the authors' released code.
    momentum: Share of the old mean, deviations and correlations that a refit keeps, from 0 to
        below 1 (iCEM's alpha).
    samples_decay: By how much each iteration has fewer samples than the one before, at least
        1: `samples / samples_decay**i`, but no fewer than twice the elites (iCEM's gamma).
    temperature: Elites count by `exp((best - cost) / temperature)` in the refit (MPPI's
        lambda, in units of a cost); None for all alike.
    min_std: Least standard deviation of the refitted distribution, in units of an action
        or a latent. Above the root of `min_variance` no problem is done early.
    covariance: What the refit keeps of the elites' covariance: 'diagonal', the variances, or
        'full', the correlations, too, for samples of at most 256 dimensions.
    shrinkage: How far the correlations of 'full' are shrunk towards none, from 1e-6 to 1; 1
        draws as 'diagonal' does."
    };
}
pub(super) use budget_doc;

/// Attributes by which both classes give these arguments back.
macro_rules! budget_getters {
    ($class:ident) => {
        #[pymethods]
        impl $class {
            /// The argument of this name.
            #[getter]
            fn samples(&self) -> usize {
                self.config.cem.samples
            }
            /// The argument of this name.
            #[getter]
            fn elites(&self) -> usize {
                self.config.cem.elites
            }
            /// The argument of this name.
            #[getter]
            fn iterations(&self) -> usize {
                self.config.cem.iterations
            }
            /// The argument of this name.
            #[getter]
            fn min_variance(&self) -> f64 {
                self.config.cem.min_variance
            }
            /// The argument of this name.
            #[getter]
            fn keep_elites(&self) -> usize {
                self.config.cem.keep_elites
            }
            /// The argument of this name.
            #[getter]
            fn best(&self) -> &'static str {
                $crate::planner::budget::best_name(&self.config.cem)
            }
            /// The argument of this name.
            #[getter]
            fn momentum(&self) -> f64 {
                self.config.cem.momentum
            }
            /// The argument of this name.
            #[getter]
            fn samples_decay(&self) -> f64 {
                self.config.cem.samples_decay
            }
            /// The argument of this name.
            #[getter]
            fn temperature(&self) -> Option<f64> {
                self.config.cem.temperature
            }
            /// The argument of this name.
            #[getter]
            fn min_std(&self) -> f64 {
                self.config.cem.min_std
            }
            /// The argument of this name.
            #[getter]
            fn covariance(&self) -> &'static str {
                $crate::planner::budget::covariance_name(&self.config.cem)
            }
            /// The argument of this name; its default where no correlations are kept.
            #[getter]
            fn shrinkage(&self) -> f64 {
                $crate::planner::budget::shrinkage(&self.config.cem)
            }
        }
    };
}
pub(super) use budget_getters;

/// The arguments that `VisualMPC` and `HVF` share, as they were given.
pub struct Budget<'a, 'py> {
    pub samples: Whole,
    pub elites: Whole,
    pub iterations: Whole,
    pub min_variance: Real,
    pub keep_elites: Whole,
    pub best: Text,
    pub momentum: Real,
    pub samples_decay: Real,
    pub temperature: Option<&'a Bound<'py, PyAny>>,
    pub min_std: Real,
    pub covariance: Text,
    pub shrinkage: Real,
}

impl Budget<'_, '_> {
    /// The settings; what is out of range is the core's to say.
    ///
    /// # Errors
    /// Names the argument that is of the wrong kind, or no name that is known.
    pub fn config(self) -> PyResult<CemConfig> {
        let mut config = CemConfig::default();
        config.samples = self.samples.count("samples")?;
        config.elites = self.elites.count("elites")?;
        config.iterations = self.iterations.count("iterations")?;
        config.min_variance = self.min_variance.get("min_variance")?;
        config.keep_elites = self.keep_elites.count("keep_elites")?;
        config.best = match &*self.best.get("best")? {
            "all" => BestOf::All,
            "last" => BestOf::Last,
            other => return Err(unknown("best", "'all' or 'last'", other)),
        };
        config.momentum = self.momentum.get("momentum")?;
        config.samples_decay = self.samples_decay.get("samples_decay")?;
        let temperature = self.temperature.map(|given| given.extract::<Real>()?.get("temperature"));
        config.temperature = temperature.transpose()?;
        config.min_std = self.min_std.get("min_std")?;
        let shrinkage = self.shrinkage.get("shrinkage")?;
        // Checked even where it counts for nothing.
        config.covariance = Covariance::Full { shrinkage };
        config.validate().map_err(crate::error::to_py)?;
        match &*self.covariance.get("covariance")? {
            "full" => {}
            "diagonal" => config.covariance = Covariance::Diagonal,
            other => return Err(unknown("covariance", "'diagonal' or 'full'", other)),
        }
        Ok(config)
    }
}

fn unknown(argument: &str, expected: &str, found: &str) -> PyErr {
    PyValueError::new_err(format!("{argument}: must be {expected}, got '{found}'"))
}

/// The name of where an answer comes from.
pub fn best_name(config: &CemConfig) -> &'static str {
    match config.best {
        BestOf::All => "all",
        BestOf::Last => "last",
    }
}

/// The name of what a refit keeps of the covariance.
pub fn covariance_name(config: &CemConfig) -> &'static str {
    match config.covariance {
        Covariance::Diagonal => "diagonal",
        Covariance::Full { .. } => "full",
    }
}

/// How much correlations are shrunk; the default where none are kept.
pub fn shrinkage(config: &CemConfig) -> f64 {
    match config.covariance {
        Covariance::Diagonal => SHRINKAGE,
        Covariance::Full { shrinkage } => shrinkage,
    }
}
