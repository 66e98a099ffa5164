//! Which predicted frames count: the last, all, or the best.

use crate::{Error, Result};

/// How the costs of the frames of one rollout become the cost of the rollout.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OverHorizon {
    /// The last frame alone (the paper's).
    #[default]
    Last,
    /// The sum over all predicted frames.
    Sum,
    /// The smallest over all predicted frames.
    Min,
}

impl OverHorizon {
    /// From its name: `"last"`, `"sum"` or `"min"`.
    ///
    /// # Errors
    /// Any other name.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "last" => Ok(Self::Last),
            "sum" => Ok(Self::Sum),
            "min" => Ok(Self::Min),
            other => Err(Error::invalid(
                "over_horizon",
                format!("expected 'last', 'sum' or 'min', got '{other}'"),
            )),
        }
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Last => "last",
            Self::Sum => "sum",
            Self::Min => "min",
        }
    }

    /// The tally before any frame.
    pub fn start(self) -> f32 {
        match self {
            Self::Min => f32::INFINITY,
            Self::Last | Self::Sum => 0.0,
        }
    }

    /// Whether the frame after `step` (from 0) of `steps` counts.
    pub fn counts(self, step: usize, steps: usize) -> bool {
        self != Self::Last || step + 1 == steps
    }

    /// The tally after a frame that counts and costs `cost`; NaN from the first NaN on.
    pub fn add(self, tally: f32, cost: f32) -> f32 {
        match self {
            Self::Min if cost < tally || cost.is_nan() => cost,
            Self::Min => tally,
            Self::Last | Self::Sum => tally + cost,
        }
    }
}
