//! A batch of planning problems, and what has to hold of it.

use ndarray::{Array3, Array4};

use super::MpcConfig;
use crate::planner::cem::MAX_VALUES;
use crate::planner::model::{ActionSpace, Frames};
use crate::planner::sampler::{Stream, MAX_DIMENSIONS};
use crate::{Error, Result};

/// The last plans of `B` problems, as they were before the step that has been acted since.
#[derive(Clone, Copy, Debug)]
pub struct WarmStart<'a> {
    /// Actions, `[B, H, A]`.
    pub actions: &'a Array3<f32>,
    /// The best candidates of each plan ([`Plan::elites`](super::Plan::elites)), `[B, S, H, A]`,
    /// at most [`MpcConfig::shift_elites`] of them.
    pub elites: Option<&'a Array4<f32>>,
}

impl<'a> From<&'a Array3<f32>> for WarmStart<'a> {
    fn from(actions: &'a Array3<f32>) -> Self {
        Self { actions, elites: None }
    }
}

/// `B` planning problems.
pub struct Problems<'a, F> {
    /// Where each starts, `[B]`, or one frame for all.
    pub starts: &'a F,
    /// What each should reach, `[B]`.
    pub goals: &'a F,
    /// Random numbers of each, `[B]`.
    pub streams: &'a [Stream],
    /// Plans to start from, as they were before the step that has been acted since.
    pub warm_start: Option<WarmStart<'a>>,
    /// Whether problems with one start and one seed may share their first iteration's rollouts.
    pub share_rollouts: bool,
    /// What to call a problem in an error.
    pub describe: &'a dyn Fn(usize) -> String,
}

/// Refuses a start or goal that is not one frame.
pub(in crate::planner) fn check_single<F: Frames>(start: &F, goal: &F) -> Result<()> {
    for (argument, frames) in [("start", start), ("goal", goal)] {
        if frames.len() != 1 {
            return Err(Error::invalid(
                argument,
                format!("must be one frame, got {}", frames.len()),
            ));
        }
    }
    Ok(())
}

pub(super) fn check_problems<F: Frames>(
    config: &MpcConfig,
    space: &ActionSpace,
    problems: &Problems<'_, F>,
) -> Result<()> {
    let count = problems.goals.len();
    if count == 0 {
        return Err(Error::invalid("goals", "must hold at least one frame"));
    }
    if problems.starts.len() != count && problems.starts.len() != 1 {
        return Err(Error::invalid(
            "starts",
            format!(
                "must hold one frame or as many as goals ({count}), got {}",
                problems.starts.len()
            ),
        ));
    }
    if problems.streams.len() != count {
        return Err(Error::invalid(
            "seeds",
            format!("must be as many as goals ({count}), got {}", problems.streams.len()),
        ));
    }
    if config.decisions() * space.dim() > MAX_DIMENSIONS {
        let most = MAX_DIMENSIONS / space.dim();
        return Err(Error::invalid(
            "horizon",
            format!("must be at most {most} actions, got {}", config.decisions()),
        ));
    }
    let values = config.horizon.saturating_mul(space.dim()).saturating_mul(config.cem.samples);
    if values > MAX_VALUES {
        return Err(Error::invalid(
            "samples",
            format!(
                "samples x horizon x action dimensions must be at most {MAX_VALUES}, got {} x {} x {}",
                config.cem.samples,
                config.horizon,
                space.dim()
            ),
        ));
    }
    match problems.warm_start {
        Some(warm_start) => {
            check_warm_start(config, (count, config.horizon, space.dim()), warm_start)
        }
        None => Ok(()),
    }
}

fn check_warm_start(
    config: &MpcConfig,
    expected: (usize, usize, usize),
    WarmStart { actions, elites }: WarmStart<'_>,
) -> Result<()> {
    if actions.dim() != expected {
        return Err(Error::invalid(
            "warm_start",
            format!("must have shape {expected:?}, got {:?}", actions.dim()),
        ));
    }
    if actions.iter().any(|value| !value.is_finite()) {
        return Err(Error::invalid("warm_start", "must be finite"));
    }
    let Some(elites) = elites else {
        return Ok(());
    };
    let (count, kept, horizon, dim) = elites.dim();
    if (count, horizon, dim) != expected || kept > config.shift_elites {
        let (count, horizon, dim) = expected;
        return Err(Error::invalid(
            "warm_elites",
            format!(
                "must have shape [{count}, S, {horizon}, {dim}] with S up to shift_elites ({}), \
                 got {:?}",
                config.shift_elites,
                elites.shape()
            ),
        ));
    }
    if elites.iter().any(|value| !value.is_finite()) {
        return Err(Error::invalid("warm_elites", "must be finite"));
    }
    Ok(())
}
