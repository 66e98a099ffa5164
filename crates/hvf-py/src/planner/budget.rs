//! The budget and the options that both searches have, for actions and for subgoals.

use hvf_core_rs::planner::{BestOf, CemConfig, Covariance};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arguments::{Real, Text, Whole};

/// A default that no argument but the core's own fixes: of correlations that are kept.
pub const SHRINKAGE: f64 = 0.1;

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
