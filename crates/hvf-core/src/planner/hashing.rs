//! Hashes of settings, so that equal ones are one key of a dictionary.
//!
//! Every struct is taken apart by name: a new field does not compile until it is thought of.

use std::hash::{Hash, Hasher};

use super::{ActionInitial, CemConfig, Covariance, HvfConfig, MpcConfig};

impl Hash for HvfConfig {
    fn hash<S: Hasher>(&self, state: &mut S) {
        let Self { mpc, subgoals, cem, reduction, segment_cost, prune, share_rollouts } = self;
        (mpc, subgoals, cem, reduction, segment_cost, prune, share_rollouts).hash(state);
    }
}

impl Hash for MpcConfig {
    fn hash<S: Hasher>(&self, state: &mut S) {
        let Self {
            horizon,
            action_repeat,
            initial,
            warm_start_std,
            clip,
            noise_beta,
            shift_elites,
            cem,
        } = self;
        (horizon, action_repeat, initial, number(*warm_start_std), clip).hash(state);
        (number(*noise_beta), shift_elites, cem).hash(state);
    }
}

impl Hash for ActionInitial {
    fn hash<S: Hasher>(&self, state: &mut S) {
        match self {
            Self::Uniform { low, high } => (corner(low), corner(high)).hash(state),
            Self::Normal { mean, std } => (number(*mean), number(*std)).hash(state),
        }
    }
}

impl Hash for CemConfig {
    fn hash<S: Hasher>(&self, state: &mut S) {
        let Self {
            samples,
            elites,
            iterations,
            min_variance,
            keep_elites,
            best,
            momentum,
            samples_decay,
            temperature,
            min_std,
            covariance,
        } = self;
        (samples, elites, iterations, number(*min_variance), keep_elites, best).hash(state);
        (number(*momentum), number(*samples_decay), temperature.map(number)).hash(state);
        (number(*min_std), covariance).hash(state);
    }
}

impl Hash for Covariance {
    fn hash<S: Hasher>(&self, state: &mut S) {
        match self {
            Self::Diagonal => None,
            Self::Full { shrinkage } => Some(number(*shrinkage)),
        }
        .hash(state);
    }
}

fn corner(corner: &Option<Vec<f64>>) -> Option<Vec<u64>> {
    corner.as_ref().map(|values| values.iter().copied().map(number).collect())
}

/// The bits of a number, the same for both zeros since these are equal.
fn number(value: f64) -> u64 {
    (value + 0.0).to_bits()
}
