//! Episodes: where they start and aim at, ground-truth subgoals, and random interaction.
//!
//! Episode `i` of a seed is drawn from a counter-based generator keyed by `(seed, i)`: it does
//! not depend on which other episodes are drawn, in what order or by how many threads.

use std::str::FromStr;

use super::geometry::{Scene, State, GAP_RANGE, REACH, WALL_X};
use super::physics::ACTION_LIMIT;
use crate::{Error, Result};

/// An episode has succeeded when the agent's centre is this close to the target, m.
pub const SUCCESS_DISTANCE: f64 = 0.05;

/// How many gaps lie between start and target: none, one or two.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Difficulty {
    /// Start in the right section.
    Easy,
    /// Start in the middle section.
    Medium,
    /// Start in the left section.
    Hard,
}

impl Difficulty {
    /// Where starts are drawn from: `[low, high]` of `x`, m.
    fn start_x(self) -> [f64; 2] {
        match self {
            Difficulty::Easy => [0.15, 0.27],
            Difficulty::Medium => [-0.15, 0.15],
            Difficulty::Hard => [-0.27, -0.15],
        }
    }
}

impl FromStr for Difficulty {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name {
            "easy" => Ok(Difficulty::Easy),
            "medium" => Ok(Difficulty::Medium),
            "hard" => Ok(Difficulty::Hard),
            other => Err(Error::invalid(
                "difficulty",
                format!("must be 'easy', 'medium' or 'hard', got '{other}'"),
            )),
        }
    }
}

/// A task: reach `target` from `start`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Episode<S = Scene> {
    /// Scene and start.
    pub start: State<S>,
    /// Where the agent's centre shall be, m; the agent can stand there.
    pub target: [f64; 2],
}

impl Episode {
    /// Episode `index` of `seed`.
    pub fn new(seed: u64, index: u64, difficulty: Difficulty) -> Self {
        let mut draws = Draws::new(seed, index, Purpose::Task);
        let scene = draws.scene();
        let start = draws.free(&scene, difficulty.start_x(), [-0.27, 0.27]);
        let target = [draws.uniform(0.2, 0.28), draws.uniform(-0.28, 0.28)];
        let target = scene.free_space().push_out(target);
        Self { start: State { scene, position: start }, target }
    }

    /// `count` ground-truth subgoals: the agent centred in the gaps that it has to pass, in
    /// order, each gap for an equal part of them; without gaps, points on the straight line.
    ///
    /// Hard: the first gap for one, both gaps for two. Medium: the second gap, for two twice.
    pub fn subgoals(&self, count: usize) -> Vec<State> {
        let scene = self.start.scene;
        let ahead: Vec<[f64; 2]> = (0..2)
            .filter(|&wall| self.start.position[0] < WALL_X[wall])
            .map(|wall| [WALL_X[wall], scene.gap_y[wall]])
            .collect();
        (0..count)
            .map(|index| {
                let position = if ahead.is_empty() {
                    let part = (index + 1) as f64 / (count + 1) as f64;
                    let [from, to] = [self.start.position, self.target];
                    let on_line = [0, 1].map(|axis| from[axis] + part * (to[axis] - from[axis]));
                    scene.free_space().push_out(on_line)
                } else {
                    ahead[index * ahead.len() / count]
                };
                State { scene, position }
            })
            .collect()
    }
}

impl<S: Clone> Episode<S> {
    /// The state to be reached: the same scene with the agent at the target. Its image is the
    /// goal image.
    pub fn goal(&self) -> State<S> {
        State { scene: self.start.scene.clone(), position: self.target }
    }
}

/// Whether the agent is within [`SUCCESS_DISTANCE`] of the target.
pub fn success<S>(state: &State<S>, target: [f64; 2]) -> bool {
    let [x, y] = state.position;
    (x - target[0]).hypot(y - target[1]) <= SUCCESS_DISTANCE
}

/// Random interaction for training: where episode `index` of `seed` starts (uniform over free
/// space, in a random scene) and its `steps` actions (uniform over the box).
pub fn random_interaction(seed: u64, index: u64, steps: usize) -> (State, Vec<[f32; 2]>) {
    let mut draws = Draws::new(seed, index, Purpose::Interaction);
    let scene = draws.scene();
    let position = draws.free(&scene, [-REACH, REACH], [-REACH, REACH]);
    let mut action = || draws.uniform(-ACTION_LIMIT, ACTION_LIMIT) as f32;
    let actions = (0..steps).map(|_| [action(), action()]).collect();
    (State { scene, position }, actions)
}

/// What is drawn: tasks and interaction of one seed have nothing in common.
#[derive(Clone, Copy)]
pub(super) enum Purpose {
    Task = 1,
    Interaction = 2,
}

/// Counter-based generator: draw `n` is a hash of (seed, episode, purpose, n). The hash is the
/// finaliser of SplitMix64 (Steele, Lea & Flood, 2014).
pub(super) struct Draws {
    key: u64,
    drawn: u64,
}

impl Draws {
    pub fn new(seed: u64, episode: u64, purpose: Purpose) -> Self {
        let key = mix(seed.wrapping_add(mix(purpose as u64)));
        Self { key: mix(key ^ mix(episode)), drawn: 0 }
    }

    /// Uniform in `[low, high)`.
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.drawn += 1;
        let bits = mix(self.key.wrapping_add(self.drawn.wrapping_mul(GOLDEN)));
        let unit = (bits >> 11) as f64 * (1.0 / (1u64 << 53) as f64);
        low + unit * (high - low)
    }

    fn scene(&mut self) -> Scene {
        let left = self.uniform(-GAP_RANGE, GAP_RANGE);
        Scene { gap_y: [left, self.uniform(-GAP_RANGE, GAP_RANGE)] }
    }

    /// Uniform over the part of a rectangle where the agent can stand.
    fn free(&mut self, scene: &Scene, x: [f64; 2], y: [f64; 2]) -> [f64; 2] {
        let space = scene.free_space();
        loop {
            let position = [self.uniform(x[0], x[1]), self.uniform(y[0], y[1])];
            if space.contains(position) {
                return position;
            }
        }
    }
}

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

fn mix(mut z: u64) -> u64 {
    z = z.wrapping_add(GOLDEN);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
