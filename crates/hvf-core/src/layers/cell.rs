//! One step of the desk's dynamics: the hand, then what slides, then what is pushed.
//!
//! The twin of `hvf.models.layers.cell.Cell`, for a block of candidates. A part moves only where
//! the hand's way comes within reach of it, so its network runs for those alone: near pairs of a
//! candidate and a part are gathered into full blocks of [`LANES`].

use multiversion::multiversion;
use ndarray::ArrayView2;

use crate::lanes::{Lanes, LANES};
use crate::nn::{Linear, Mlp, MlpRoom};
use crate::{Error, Result};

/// Pixels that count as one in the inputs of the parts' network: motion, and place.
const PIXELS: f32 = 8.0;
const HALF_IMAGE: f32 = 32.0;
/// Part of a slider's whole way that an output of one is.
const SLIDE: f32 = 0.1;
/// What slides.
pub const SLIDERS: usize = 2;

/// Weights of the cell; networks as lists of layers.
#[derive(Clone, Debug)]
pub struct CellWeights<'a> {
    /// From hand, action and sliders (`2 A + G` inputs) to the hand's motion (`A`).
    pub hand: Vec<Linear<'a>>,
    /// For each slider, from sliders, hand, the hand's motion and action (`G + 3 A`) to its motion.
    pub sliders: Vec<Vec<Linear<'a>>>,
    /// From the hand beside the part, the hand's way, hand, motion, action, the part itself and
    /// its memory (`7 + 3 A + C` inputs) to motion, presence and memory (`3 + C`).
    pub parts: Vec<Linear<'a>>,
    /// Quadratic function of the hand's code that gives the pixel where it meets parts:
    /// `[1 + A + A (A + 1) / 2, 2]`.
    pub contact: ArrayView2<'a, f32>,
    /// Pixels from the hand's way beyond which a part does not move.
    pub reach: f32,
    /// Parts that roam, `R`.
    pub roaming: usize,
}

/// The cell, with its weights packed for blocks of candidates.
#[derive(Clone, Debug)]
pub struct Cell {
    action_dim: usize,
    roaming: usize,
    memory: usize,
    reach: f32,
    hand: Mlp,
    sliders: Vec<Mlp>,
    parts: Mlp,
    /// `[terms][2]`.
    contact: Vec<[f32; 2]>,
}

/// Candidates that move together: a multiple of [`LANES`].
#[derive(Clone, Debug)]
pub struct Moving {
    /// States of each block of lanes: `[blocks][X]`.
    pub states: Vec<Vec<Lanes>>,
    /// Memories of parts, `[blocks][R * C]`.
    memories: Vec<Vec<Lanes>>,
}

/// Room for the networks, and for what a step finds near.
#[derive(Clone, Debug)]
pub struct Scratch {
    hand_input: Vec<Lanes>,
    slider_input: Vec<Lanes>,
    part_input: Vec<Lanes>,
    hand: MlpRoom,
    sliders: Vec<MlpRoom>,
    parts: MlpRoom,
    /// What the parts' network takes of a block of candidates whatever the part.
    shared: Vec<Vec<Lanes>>,
    /// Block, lane and part of near pairs.
    near: Vec<(usize, usize, usize)>,
}

impl Cell {
    /// Packs `weights`.
    ///
    /// # Errors
    /// Shapes that do not fit each other, weights that are not finite, or a reach that is not
    /// positive.
    pub fn new(weights: &CellWeights<'_>) -> Result<Self> {
        let action_dim = weights.hand.last().map_or(0, |(last, _)| last.nrows());
        let outputs = weights.parts.last().map_or(0, |(last, _)| last.nrows());
        let (a, g) = (action_dim, SLIDERS);
        if a == 0 {
            return Err(Error::invalid("hand", "must have an output for each action dimension"));
        }
        if outputs < 3 {
            return Err(Error::invalid(
                "parts",
                format!("expected at least 3 outputs, got {outputs}"),
            ));
        }
        if weights.sliders.len() != g {
            return Err(Error::invalid(
                "sliders",
                format!("expected {g} networks, got {}", weights.sliders.len()),
            ));
        }
        if !(weights.reach.is_finite() && weights.reach > 0.0) {
            return Err(Error::invalid("reach", "must be positive and finite"));
        }
        if weights.roaming == 0 {
            return Err(Error::invalid("roaming", "must be at least 1"));
        }
        let memory = outputs - 3;
        let slider = |layers: &Vec<Linear<'_>>| Mlp::new("sliders", layers, g + 3 * a, 1);
        let hand = Mlp::new("hand", &weights.hand, 2 * a + g, a)?;
        let sliders = weights.sliders.iter().map(slider).collect::<Result<_>>()?;
        let parts = Mlp::new("parts", &weights.parts, 7 + 3 * a + memory, outputs)?;
        let terms = 1 + a + a * (a + 1) / 2;
        if weights.contact.dim() != (terms, 2) {
            return Err(Error::invalid(
                "contact",
                format!("expected shape [{terms}, 2], got {:?}", weights.contact.shape()),
            ));
        }
        if weights.contact.iter().any(|x| !x.is_finite()) {
            return Err(Error::invalid("contact", "must be finite"));
        }
        Ok(Self {
            action_dim,
            roaming: weights.roaming,
            memory,
            reach: weights.reach,
            hand,
            sliders,
            parts,
            contact: weights.contact.rows().into_iter().map(|row| [row[0], row[1]]).collect(),
        })
    }

    /// Action dimensions, `A`.
    pub fn action_dim(&self) -> usize {
        self.action_dim
    }

    /// Parts that roam, `R`.
    pub fn roaming(&self) -> usize {
        self.roaming
    }

    /// Length of a state, `X`.
    pub fn state_size(&self) -> usize {
        self.action_dim + SLIDERS + 3 * self.roaming
    }

    /// Candidates in `blocks` blocks of lanes that all begin at `state`, with empty memories.
    pub fn start(&self, state: &[f32], blocks: usize) -> Moving {
        let states = state.iter().map(|&x| [x; LANES]).collect();
        let memory = vec![[0.0; LANES]; self.roaming * self.memory];
        Moving { states: vec![states; blocks], memories: vec![memory; blocks] }
    }

    /// Room for `blocks` blocks of lanes.
    pub fn scratch(&self, blocks: usize) -> Scratch {
        let (a, g) = (self.action_dim, SLIDERS);
        let room = |inputs: usize| vec![[0.0; LANES]; inputs];
        Scratch {
            hand_input: room(2 * a + g),
            slider_input: room(g + 3 * a),
            part_input: room(7 + 3 * a + self.memory),
            hand: self.hand.room(),
            sliders: self.sliders.iter().map(Mlp::room).collect(),
            parts: self.parts.room(),
            // The hand's place before and after, hand, motion, action.
            shared: vec![room(4 + 3 * a); blocks],
            near: Vec::new(),
        }
    }

    /// Moves candidates by one action each: `actions[blocks][A]`.
    pub fn advance(&self, moving: &mut Moving, actions: &[Vec<Lanes>], scratch: &mut Scratch) {
        advance(self, moving, actions, scratch);
    }
}

#[multiversion(targets("x86_64+avx2+fma"))]
fn advance(cell: &Cell, moving: &mut Moving, actions: &[Vec<Lanes>], scratch: &mut Scratch) {
    let (a, g) = (cell.action_dim, SLIDERS);
    scratch.near.clear();
    for (block, ((state, actions), shared)) in
        moving.states.iter_mut().zip(actions).zip(&mut scratch.shared).enumerate()
    {
        let (hand, rest) = state.split_at_mut(a);
        let (sliders, parts) = rest.split_at_mut(g);
        scratch.hand_input[..a].copy_from_slice(hand);
        scratch.hand_input[a..2 * a].copy_from_slice(actions);
        scratch.hand_input[2 * a..].copy_from_slice(sliders);
        let change = cell.hand.apply(&scratch.hand_input, &mut scratch.hand);

        let (places, seen) = shared.split_at_mut(4);
        place(&cell.contact, hand, &mut places[..2]);
        seen[..a].copy_from_slice(hand);
        for dimension in 0..a {
            for lane in 0..LANES {
                let before = hand[dimension][lane];
                let after = before + change[dimension][lane];
                hand[dimension][lane] = after;
                seen[a + dimension][lane] = after - before;
            }
        }
        seen[2 * a..].copy_from_slice(actions);
        place(&cell.contact, hand, &mut places[2..]);

        scratch.slider_input[..g].copy_from_slice(sliders);
        scratch.slider_input[g..].copy_from_slice(seen);
        for ((slider, network), room) in
            sliders.iter_mut().zip(&cell.sliders).zip(&mut scratch.sliders)
        {
            let change = network.apply(&scratch.slider_input, room);
            for lane in 0..LANES {
                slider[lane] = SLIDE.mul_add(change[0][lane], slider[lane]).clamp(0.0, 1.0);
            }
        }
        for (part, at) in parts.chunks_exact(3).enumerate() {
            let distance = distance(places, at);
            for (lane, squared) in distance.iter().enumerate() {
                if *squared < cell.reach * cell.reach {
                    scratch.near.push((block, lane, part));
                }
            }
        }
    }
    for near in scratch.near.chunks(LANES) {
        push(cell, near, moving, &scratch.shared, &mut scratch.part_input, &mut scratch.parts);
    }
}

/// Where a hand meets parts: row and column.
#[inline(always)]
fn place(contact: &[[f32; 2]], hand: &[Lanes], out: &mut [Lanes]) {
    let a = hand.len();
    for (axis, out) in out.iter_mut().enumerate() {
        let mut sum = [contact[0][axis]; LANES];
        for (term, code) in contact[1..].iter().zip(hand) {
            for lane in 0..LANES {
                sum[lane] = term[axis].mul_add(code[lane], sum[lane]);
            }
        }
        let pairs = (0..a).flat_map(|i| (i..a).map(move |j| (i, j)));
        for (term, (i, j)) in contact[1 + a..].iter().zip(pairs) {
            for lane in 0..LANES {
                sum[lane] = term[axis].mul_add(hand[i][lane] * hand[j][lane], sum[lane]);
            }
        }
        *out = sum;
    }
}

/// Squared distance of a part `at` a place from the way between two `places`, pixels.
#[inline(always)]
fn distance(places: &[Lanes], at: &[Lanes]) -> Lanes {
    let mut squared = [0.0; LANES];
    for lane in 0..LANES {
        let beside = [places[0][lane] - at[0][lane], places[1][lane] - at[1][lane]];
        let way = [places[2][lane] - places[0][lane], places[3][lane] - places[1][lane]];
        let along = beside[0] * way[0] + beside[1] * way[1];
        let length = (way[0] * way[0] + way[1] * way[1]).max(1e-6);
        let share = (-along / length).clamp(0.0, 1.0);
        let apart = [share.mul_add(way[0], beside[0]), share.mul_add(way[1], beside[1])];
        squared[lane] = apart[0] * apart[0] + apart[1] * apart[1];
    }
    squared
}

/// Moves up to [`LANES`] parts that the hand is near.
#[inline(always)]
fn push(
    cell: &Cell,
    near: &[(usize, usize, usize)],
    moving: &mut Moving,
    shared: &[Vec<Lanes>],
    input: &mut [Lanes],
    room: &mut MlpRoom,
) {
    let (first, c) = (cell.action_dim + SLIDERS, cell.memory);
    for (to, &(block, lane, part)) in near.iter().enumerate() {
        let seen = &shared[block];
        let at = &moving.states[block][first + 3 * part..][..3];
        for axis in 0..2 {
            let (before, after) = (seen[axis][lane], seen[2 + axis][lane]);
            input[axis][to] = (before - at[axis][lane]) / PIXELS;
            input[2 + axis][to] = (after - before) / PIXELS;
        }
        let (hand, part_itself) = input[4..].split_at_mut(seen.len() - 4);
        for (input, seen) in hand.iter_mut().zip(&seen[4..]) {
            input[to] = seen[lane];
        }
        part_itself[0][to] = at[0][lane] / HALF_IMAGE - 1.0;
        part_itself[1][to] = at[1][lane] / HALF_IMAGE - 1.0;
        part_itself[2][to] = at[2][lane];
        for (input, kept) in part_itself[3..].iter_mut().zip(&moving.memories[block][part * c..]) {
            input[to] = kept[lane];
        }
    }
    let pushed = cell.parts.apply(input, room);
    for (from, &(block, lane, part)) in near.iter().enumerate() {
        let at = &mut moving.states[block][first + 3 * part..][..3];
        at[0][lane] = PIXELS.mul_add(pushed[0][from], at[0][lane]);
        at[1][lane] = PIXELS.mul_add(pushed[1][from], at[1][lane]);
        at[2][lane] = (at[2][lane] + pushed[2][from]).clamp(0.0, 1.0);
        for (kept, change) in moving.memories[block][part * c..].iter_mut().zip(&pushed[3..]) {
            kept[lane] += change[from];
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::toys::{cell, state, Draws, SIZE};
    use super::*;

    /// States of each candidate after each step, `[steps][candidates][X]`.
    fn paths(cell: &Cell, state: &[f32], actions: &[Vec<[f32; 3]>]) -> Vec<Vec<Vec<f32>>> {
        let blocks = actions.len().div_ceil(LANES);
        let (mut moving, mut scratch) = (cell.start(state, blocks), cell.scratch(blocks));
        (0..actions[0].len())
            .map(|step| {
                let mut lanes = vec![vec![[0.0; LANES]; 3]; blocks];
                for (candidate, actions) in actions.iter().enumerate() {
                    for axis in 0..3 {
                        lanes[candidate / LANES][axis][candidate % LANES] = actions[step][axis];
                    }
                }
                cell.advance(&mut moving, &lanes, &mut scratch);
                let of = |candidate: usize| {
                    let block = &moving.states[candidate / LANES];
                    block.iter().map(|lanes| lanes[candidate % LANES]).collect()
                };
                (0..actions.len()).map(of).collect()
            })
            .collect()
    }

    fn actions(draws: &mut Draws, candidates: usize, steps: usize) -> Vec<Vec<[f32; 3]>> {
        let mut one = || (0..steps).map(|_| [0; 3].map(|_| draws.between(-1.0, 1.0))).collect();
        (0..candidates).map(|_| one()).collect()
    }

    #[test]
    fn a_candidate_moves_the_same_alone_and_among_others() {
        let cell = cell(1);
        let mut draws = Draws::new(2);
        let mut start = state(&mut draws);
        // The hand meets parts near the middle.
        start[5..7].fill(0.5 * SIZE as f32 + 1.0);
        let actions = actions(&mut draws, 45, 6);
        let together = paths(&cell, &start, &actions);
        let last = together.last().unwrap();
        assert!([0, 1, 2, 5, 6].iter().all(|&x| last.iter().any(|state| state[x] != start[x])));
        for candidate in [0, 17, 44] {
            let alone = paths(&cell, &start, &actions[candidate..=candidate]);
            for (alone, together) in alone.iter().zip(&together) {
                assert_eq!(alone[0], together[candidate]);
            }
        }
    }

    #[test]
    fn parts_out_of_reach_stay_where_they_are() {
        let cell = cell(1);
        let mut draws = Draws::new(3);
        let mut start = state(&mut draws);
        start[5..7].fill(10.0 * SIZE as f32);
        for states in paths(&cell, &start, &actions(&mut draws, 20, 8)) {
            assert!(states.iter().all(|state| state[5..8] == start[5..8]));
        }
    }

    #[test]
    fn what_is_near_is_near_the_whole_way() {
        let lanes = |x: f32| [x; LANES];
        let squared = |from: [f32; 2], to: [f32; 2], at: [f32; 2]| {
            let places = [from[0], from[1], to[0], to[1]].map(lanes);
            distance(&places, &at.map(lanes))[7]
        };
        assert_eq!(squared([0.0, 0.0], [0.0, 10.0], [3.0, 5.0]), 9.0);
        assert_eq!(squared([0.0, 0.0], [0.0, 10.0], [3.0, 14.0]), 25.0);
        assert_eq!(squared([0.0, 0.0], [0.0, 10.0], [0.0, -2.0]), 4.0);
        assert_eq!(squared([1.0, 1.0], [1.0, 1.0], [1.0, 4.0]), 9.0);
    }
}
