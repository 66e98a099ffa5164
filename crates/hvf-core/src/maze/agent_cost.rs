//! The pixel cost of frames that differ from their scene only where the agent is, in closed form.
//!
//! # How it works
//! A frame is its scene `b` plus a small patch `p` (the agent; at most 6 x 6 pixels of 64 x 64).
//! With `d = b - goal` its squared distance to the goal is
//!
//! ```text
//! |d + p|^2 = |d|^2 + 2 d.p + |p|^2                   exact, in integers
//! |G(d + p)|^2 = |G d|^2 + 2 (G'G d).p + p.(G'G p)    after the blur G
//! ```
//!
//! `d` and what depends on it alone are worked out once per start and goal ([`GoalTerms`]), what
//! depends on `p` alone once per rollout ([`Patch`]), so a candidate costs a hundred
//! multiplications instead of a frame. The blur is separable, hence so is its Gram matrix `G'G`:
//! one `[size, size]` matrix on each axis.

use std::ops::Range;

use super::agent_kernels::{
    add_scaled, blend_planes, floor_planes, inner_floats, inner_integers, weighted_products, LANES,
};
use super::geometry::{State, AGENT_HALF};
use super::ground::{Ground, Walls};
use super::pixels::Covered;
use super::render::{blend, Renderer, AGENT, FLOOR, VIEW};
use crate::image::{squared_distance_u8, squared_norm_f32, GaussianBlur};

/// Scores agents against goals, for one size of image and blur.
#[derive(Clone, Debug)]
pub(super) struct AgentCost {
    size: usize,
    /// Most pixels that the agent covers on one axis.
    reach: usize,
    /// Rows and columns without any wall ([`Renderer::open_lines`]).
    open: [Vec<bool>; 2],
    blur: Option<Blurred>,
}

#[derive(Clone, Debug)]
struct Blurred {
    blur: GaussianBlur,
    /// `G'G` of one axis, `[size]` rows of `stride`, zeros beyond `size`.
    gram: Vec<f32>,
    /// `size`, filled up so that a patch at the right border can be read beyond it.
    stride: usize,
    /// Rows and columns further apart than this do not meet in `gram`.
    band: usize,
    /// `gram` between the three kinds of rows of an agent on open floor, summed over its rows:
    /// `[first row][number of rows]`.
    floor: Vec<[f32; 9]>,
}

/// What is common to all candidates with one start scene and one goal.
pub(super) enum GoalTerms {
    /// `|d|^2` and `d`, interleaved channels, a row of a patch longer than the image.
    Sharp { base: i64, residual: Vec<i16> },
    /// `|G d|^2` and `G'G d`, one plane a channel.
    Blurred { base: f64, slope: [Vec<f32>; 3] },
}

/// The agent in a frame: what it changes about the scene, and the cost of that alone.
///
/// The rows of an agent on open floor are of three kinds: the first, the last, and those between.
/// So rows are kept once per kind; beside walls every row is a kind of its own.
#[derive(Clone, Debug, Default)]
pub(super) struct Patch {
    top: usize,
    left: usize,
    /// Kind of each row.
    kinds: Vec<usize>,
    /// Without blur: change of colour, `[kinds]` rows of `3 * reach` values filled up with zeros.
    change: Vec<i16>,
    /// With blur: the same as `[kinds, 3]` rows of `reach` values.
    planes: Vec<f32>,
    /// `|p|^2`, or `p.(G'G p)`.
    own: f64,
    /// Room for the parts of a row's pixels that agent and walls cover.
    parts: Vec<f64>,
    walls: Vec<f64>,
}

impl AgentCost {
    /// For the frames of a renderer.
    pub fn new(renderer: &Renderer, blur: Option<GaussianBlur>) -> Self {
        let size = renderer.size();
        let pixels = size as f64 * AGENT_HALF / VIEW;
        let reach = pixels.ceil() as usize + 1;
        let blur = blur.map(|blur| {
            let stride = size + reach.next_multiple_of(LANES);
            let mut gram = vec![0.0; size * stride];
            for (wide, row) in gram.chunks_exact_mut(stride).zip(blur.gram_matrix(size).rows()) {
                for (entry, value) in wide.iter_mut().zip(row) {
                    *entry = *value;
                }
            }
            let floor = (0..size)
                .flat_map(|top| (0..=reach).map(move |rows| (top, rows.min(size - top))))
                .map(|(top, rows)| {
                    let mut weights = [0.0_f32; 9];
                    for row in 0..rows {
                        for other in 0..rows {
                            let pair = 3 * floor_kind(row, rows) + floor_kind(other, rows);
                            weights[pair] += gram[(top + row) * stride + top + other];
                        }
                    }
                    weights
                })
                .collect();
            Blurred { band: 2 * blur.radius(), blur, gram, stride, floor }
        });
        Self { size, reach, open: renderer.open_lines(), blur }
    }

    /// Values of a row of [`Patch::change`].
    fn change_stride(&self) -> usize {
        (3 * self.reach).next_multiple_of(LANES)
    }

    /// Values of a row of [`Patch::planes`].
    fn plane_stride(&self) -> usize {
        self.reach.next_multiple_of(LANES)
    }

    /// What the agent of `state` changes about `scene`, the image of its scene.
    pub fn patch<S: Ground>(
        &self,
        renderer: &Renderer,
        scene: &[u8],
        state: &State<S>,
        patch: &mut Patch,
    ) {
        let agent = renderer.agent_box(state.position);
        let walls = state.scene.walls_in(renderer);
        let on_floor = walls.are_absent(&self.open, &agent.rows, &agent.columns);
        let Some(blurred) = &self.blur else {
            if on_floor {
                self.patch_on_floor(&agent, patch);
            } else {
                self.patch_anywhere(renderer, scene, state, patch);
            }
            let stride = self.change_stride();
            let squares = |kind: usize| {
                let row = &patch.change[kind * stride..][..stride];
                row.iter().map(|&c| i64::from(c) * i64::from(c)).sum::<i64>()
            };
            patch.own = patch.kinds.iter().map(|&kind| squares(kind)).sum::<i64>() as f64;
            return;
        };
        let stride = self.plane_stride();
        let (columns, weights) = if on_floor {
            self.place_on_floor(&agent, patch);
            let parts = |ends: [f64; 2]| [ends[0], 1.0, ends[1]];
            let (rows, columns) = (agent.rows.len(), agent.columns.len());
            patch.planes.resize(3 * 3 * stride, 0.0);
            let (row_parts, column_parts) = (parts(agent.row_ends), parts(agent.column_ends));
            floor_planes(row_parts, column_parts, columns, stride, &mut patch.planes);
            let weights = &blurred.floor[patch.top * (self.reach + 1) + rows];
            (columns, (&weights[..], 3))
        } else {
            self.planes_anywhere(&walls, scene, &agent, patch);
            // Every row is a kind of its own.
            let rows = &blurred.gram[patch.top * (blurred.stride + 1)..];
            (agent.columns.len(), (rows, blurred.stride))
        };
        let gram = &blurred.gram[patch.left * (blurred.stride + 1)..];
        let gram = (gram, blurred.stride);
        patch.own = f64::from(weighted_products(&patch.planes, (stride, columns), weights, gram));
    }

    /// First pixel and kinds of rows away from walls.
    fn place_on_floor(&self, agent: &Covered, patch: &mut Patch) {
        (patch.top, patch.left) = (agent.rows.start, agent.columns.start);
        let rows = agent.rows.len();
        patch.kinds.clear();
        patch.kinds.extend((0..rows).map(|row| floor_kind(row, rows)));
    }

    /// Away from walls colours depend on the covered part of a pixel only.
    fn patch_on_floor(&self, agent: &Covered, patch: &mut Patch) {
        self.place_on_floor(agent, patch);
        let stride = self.change_stride();
        let columns = agent.columns.len();
        patch.change.clear();
        patch.change.resize(3 * stride, 0);
        let parts = [agent.row_ends[0], 1.0, agent.row_ends[1]];
        for (row, part) in patch.change.chunks_exact_mut(stride).zip(parts) {
            let change = |part: f64| {
                let colour = if part >= 1.0 { AGENT } else { blend(0.0, part) };
                [0, 1, 2].map(|c: usize| i16::from(colour[c]) - i16::from(FLOOR[c]))
            };
            let (pixels, _) = row[..3 * columns].as_chunks_mut::<3>();
            pixels.fill(change(part));
            if let Some(last) = pixels.last_mut() {
                *last = change(part * agent.column_ends[1]);
            }
            if let Some(first) = pixels.first_mut() {
                *first = change(part * agent.column_ends[0]);
            }
        }
    }

    /// [`Patch::change`] beside walls.
    fn patch_anywhere<S: Ground>(
        &self,
        renderer: &Renderer,
        scene: &[u8],
        state: &State<S>,
        patch: &mut Patch,
    ) {
        let (stride, size) = (self.change_stride(), self.size);
        patch.change.clear();
        patch.kinds.clear();
        let mut row_end = 0;
        renderer.render_agent(state, |pixel, colour| {
            if patch.kinds.is_empty() {
                (patch.top, patch.left) = (pixel / size, pixel % size);
                row_end = patch.top * size;
            }
            while pixel >= row_end {
                row_end += size;
                patch.kinds.push(patch.kinds.len());
                patch.change.resize(patch.kinds.len() * stride, 0);
            }
            let column = pixel + size - row_end - patch.left;
            let at = patch.change.len() - stride + 3 * column;
            for channel in 0..3 {
                patch.change[at + channel] =
                    i16::from(colour[channel]) - i16::from(scene[3 * pixel + channel]);
            }
        });
    }

    /// [`Patch::planes`] beside walls.
    fn planes_anywhere(
        &self,
        walls: &impl Walls,
        scene: &[u8],
        agent: &Covered,
        patch: &mut Patch,
    ) {
        let (stride, columns) = (self.plane_stride(), agent.columns.len());
        (patch.top, patch.left) = (agent.rows.start, agent.columns.start);
        patch.kinds.clear();
        patch.kinds.extend(0..agent.rows.len());
        patch.planes.resize(agent.rows.len() * 3 * stride, 0.0);
        patch.parts.clear();
        patch.parts.resize(stride, 0.0);
        patch.walls.resize(stride, 0.0);
        for (row, planes) in agent.rows.clone().zip(patch.planes.chunks_exact_mut(3 * stride)) {
            let in_row = Covered::part(row, &agent.rows, agent.row_ends);
            for (part, column) in patch.parts.iter_mut().zip(agent.columns.clone()) {
                *part = in_row * Covered::part(column, &agent.columns, agent.column_ends);
            }
            walls.in_row(row, &agent.columns, &mut patch.walls);
            let under = &scene[3 * (row * self.size + agent.columns.start)..][..3 * columns];
            blend_planes(&patch.parts, &patch.walls, under, planes);
        }
    }

    /// What candidates in the scene of image `scene` and with goal image `goal` have in common.
    pub fn goal_terms(&self, scene: &[u8], goal: &[u8]) -> GoalTerms {
        match &self.blur {
            None => {
                let mut residual = Vec::with_capacity(scene.len() + self.change_stride());
                residual.extend(scene.iter().zip(goal).map(|(&b, &g)| i16::from(b) - i16::from(g)));
                residual.resize(scene.len() + self.change_stride(), 0);
                GoalTerms::Sharp { base: squared_distance_u8(scene, goal) as i64, residual }
            }
            Some(blurred) => {
                let (rows, columns) = differing_box(scene, goal, self.size);
                // A rendered goal differs from its scene only where the agent is.
                if 8 * rows.len() * columns.len() <= self.size * self.size {
                    blurred.terms_of_box(scene, goal, self.size, rows, columns)
                } else {
                    blurred.terms(scene, goal, self.size)
                }
            }
        }
    }

    /// Cost per pixel of the frame with this patch.
    pub fn cost(&self, terms: &GoalTerms, patch: &Patch) -> f32 {
        let sum = match (terms, &self.blur) {
            (GoalTerms::Sharp { base, residual }, _) => {
                let at = 3 * (patch.top * self.size + patch.left);
                let stride = self.change_stride();
                let (kinds, change) = (&patch.kinds, &patch.change);
                let cross = inner_integers(kinds, change, stride, &residual[at..], 3 * self.size);
                (base + 2 * cross + patch.own as i64) as f64
            }
            (GoalTerms::Blurred { base, slope }, Some(blurred)) => {
                let at = patch.top * blurred.stride + patch.left;
                let slope = slope.each_ref().map(|slope| &slope[at..]);
                let (kinds, planes) = (&patch.kinds, &patch.planes);
                let cross = inner_floats(kinds, planes, self.plane_stride(), slope, blurred.stride);
                (base + 2.0 * f64::from(cross) + patch.own).max(0.0)
            }
            (GoalTerms::Blurred { .. }, None) => f64::NAN,
        };
        (sum / (255.0 * 255.0 * (self.size * self.size) as f64)) as f32
    }
}

impl Blurred {
    /// Terms for any goal: two blurs of the difference (the blur's matrix is symmetric).
    fn terms(&self, scene: &[u8], goal: &[u8], size: usize) -> GoalTerms {
        let mut scratch = self.blur.scratch(size, size, 1);
        let mut base = 0.0;
        let slope = std::array::from_fn(|channel| {
            let values = scene.iter().zip(goal).skip(channel).step_by(3);
            let mut plane: Vec<f32> =
                values.map(|(&b, &g)| f32::from(i16::from(b) - i16::from(g))).collect();
            self.blur.apply(&mut plane, size, size, 1, &mut scratch);
            base += squared_norm_f32(&plane);
            self.blur.apply(&mut plane, size, size, 1, &mut scratch);
            let mut slope = vec![0.0; size * self.stride];
            for (wide, row) in slope.chunks_exact_mut(self.stride).zip(plane.chunks_exact(size)) {
                wide[..size].copy_from_slice(row);
            }
            slope
        });
        GoalTerms::Blurred { base, slope }
    }

    /// The same where the difference is confined to a box.
    fn terms_of_box(
        &self,
        scene: &[u8],
        goal: &[u8],
        size: usize,
        rows: Range<usize>,
        columns: Range<usize>,
    ) -> GoalTerms {
        let mut base = 0.0;
        let slope = std::array::from_fn(|channel| {
            let difference = |row: usize, column: usize| {
                let at = 3 * (row * size + column) + channel;
                f32::from(i16::from(scene[at]) - i16::from(goal[at]))
            };
            let mut slope = vec![0.0; size * self.stride];
            let near = rows.start.saturating_sub(self.band)..(rows.end + self.band).min(size);
            let mut across = vec![0.0; self.stride];
            for row in rows.clone() {
                across.fill(0.0);
                for column in columns.clone() {
                    let gram = &self.gram[column * self.stride..][..self.stride];
                    add_scaled(&mut across, difference(row, column), gram);
                }
                for to in near.clone() {
                    let weight = self.gram[to * self.stride + row];
                    add_scaled(&mut slope[to * self.stride..][..self.stride], weight, &across);
                }
            }
            for row in rows.clone() {
                for column in columns.clone() {
                    let slope = slope[row * self.stride + column];
                    base += f64::from(difference(row, column)) * f64::from(slope);
                }
            }
            slope
        });
        GoalTerms::Blurred { base: f64::max(base, 0.0), slope }
    }
}

/// Kind of a row of an agent on open floor: the first (0), those between (1) and the last (2).
fn floor_kind(row: usize, rows: usize) -> usize {
    if row == 0 {
        0
    } else if row + 1 == rows {
        2
    } else {
        1
    }
}

/// The smallest box of rows and columns outside of which two images `[size, size, 3]` agree.
fn differing_box(a: &[u8], b: &[u8], size: usize) -> (Range<usize>, Range<usize>) {
    let row = |y: usize| 3 * y * size..3 * (y + 1) * size;
    let differ = |y: &usize| a[row(*y)] != b[row(*y)];
    let Some(first) = (0..size).find(differ) else {
        return (0..0, 0..0);
    };
    let last = (0..size).rev().find(differ).unwrap_or(first);
    let (mut left, mut right) = (size, 0);
    for y in first..=last {
        let (a, b) = (a[row(y)].chunks_exact(3), b[row(y)].chunks_exact(3));
        for (x, (a, b)) in a.zip(b).enumerate() {
            if a != b {
                left = left.min(x);
                right = right.max(x + 1);
            }
        }
    }
    (first..last + 1, left..right)
}
