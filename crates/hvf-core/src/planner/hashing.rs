//! Hashes of settings, so that equal ones are one key of a dictionary.
//!
//! Every struct is taken apart by name: a new field does not compile until it is thought of.

use std::hash::{Hash, Hasher};

use super::{ActionInitial, CemConfig, Covariance, HvfConfig, MpcConfig};

impl Hash for HvfConfig {
    fn hash<S: Hasher>(&self, state: &mut S) {
        let Self { mpc, subgoals, cem, reduction, segment_cost, prune, chunk, share_rollouts } =
            self;
        (mpc, subgoals, cem, reduction, segment_cost, prune, chunk, share_rollouts).hash(state);
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

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::hash::{DefaultHasher, Hasher};

    use super::*;

    fn hashed(config: &impl Hash) -> u64 {
        let mut state = DefaultHasher::new();
        config.hash(&mut state);
        state.finish()
    }

    #[test]
    fn every_option_counts_and_both_zeros_are_one() {
        let cem = |change: fn(&mut CemConfig)| {
            let mut config = CemConfig::default();
            change(&mut config);
            hashed(&config)
        };
        let hashes = [
            cem(|_| ()),
            cem(|config| config.samples = 201),
            cem(|config| config.elites = 39),
            cem(|config| config.iterations = 4),
            cem(|config| config.min_variance = 0.5),
            cem(|config| config.keep_elites = 1),
            cem(|config| config.best = super::super::BestOf::Last),
            cem(|config| config.momentum = 0.5),
            cem(|config| config.samples_decay = 2.0),
            cem(|config| config.temperature = Some(0.5)),
            cem(|config| config.min_std = 0.5),
            cem(|config| config.covariance = Covariance::Full { shrinkage: 0.5 }),
            cem(|config| config.covariance = Covariance::Full { shrinkage: 0.25 }),
        ];
        assert_eq!(HashSet::from(hashes).len(), hashes.len());
        assert_eq!(cem(|config| config.momentum = -0.0), hashes[0]);
    }
}
