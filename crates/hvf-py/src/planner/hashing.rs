//! Hashes of the planners' settings, so that equal planners are one key of a dictionary.
//!
//! Every struct is taken apart by name: a new field does not compile until it is thought of.

use std::hash::{Hash, Hasher};

use hvf_core_rs::planner::{ActionInitial, CemConfig, HvfConfig, MpcConfig, Reduction};

use super::hvf::PyHvf;
use super::visual_mpc::PyVisualMpc;

impl Hash for PyVisualMpc {
    fn hash<S: Hasher>(&self, state: &mut S) {
        hash_mpc(&self.config, state);
    }
}

impl Hash for PyHvf {
    fn hash<S: Hasher>(&self, state: &mut S) {
        let HvfConfig { mpc, subgoals, cem, reduction, segment_cost, prune, share_rollouts } =
            &self.config;
        hash_mpc(mpc, state);
        hash_cem(cem, state);
        let mean = *reduction == Reduction::Mean;
        (subgoals, mean, segment_cost, prune, share_rollouts).hash(state);
    }
}

fn hash_mpc<S: Hasher>(config: &MpcConfig, state: &mut S) {
    let MpcConfig { horizon, action_repeat, initial, warm_start_std, clip, cem } = config;
    hash_cem(cem, state);
    (horizon, action_repeat, number(*warm_start_std), clip).hash(state);
    match initial {
        ActionInitial::Uniform { low, high } => (corner(low), corner(high)).hash(state),
        ActionInitial::Normal { mean, std } => (number(*mean), number(*std)).hash(state),
    }
}

fn hash_cem<S: Hasher>(config: &CemConfig, state: &mut S) {
    let CemConfig { samples, elites, iterations, min_variance, keep_elites, best } = config;
    (samples, elites, iterations, number(*min_variance), keep_elites, best).hash(state);
}

fn corner(corner: &Option<Vec<f64>>) -> Option<Vec<u64>> {
    corner.as_ref().map(|values| values.iter().copied().map(number).collect())
}

/// The bits of a number, the same for both zeros since these are equal.
fn number(value: f64) -> u64 {
    (value + 0.0).to_bits()
}
