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

use multiversion::multiversion;

use super::geometry::{State, AGENT_HALF};
use super::render::{blend, Covered, Renderer, AGENT, FLOOR, VIEW};
use crate::image::{squared_distance_u8, squared_norm_f32, GaussianBlur};

/// Rows of patches are filled up to whole vectors of this many values.
const LANES: usize = 8;

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
    /// Change of colour, `[kinds]` rows of `3 * reach` values filled up with zeros.
    change: Vec<i16>,
    /// The same as `[kinds, 3]` rows of `reach` values, for blurred costs.
    planes: Vec<f32>,
    /// `|p|^2`, or `p.(G'G p)`.
    own: f64,
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
            Blurred { band: 2 * blur.radius(), blur, gram, stride }
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
    pub fn patch(&self, renderer: &Renderer, scene: &[u8], state: &State, patch: &mut Patch) {
        let agent = renderer.agent_box(state.position);
        let [open_rows, open_columns] = &self.open;
        let all = |open: &[bool], pixels: &Range<usize>| open[pixels.clone()].iter().all(|&o| o);
        if all(open_rows, &agent.rows) && all(open_columns, &agent.columns) {
            self.patch_on_floor(&agent, patch);
        } else {
            self.patch_anywhere(renderer, scene, state, patch);
        }
        patch.own = match &self.blur {
            None => {
                let stride = self.change_stride();
                let squares = |kind: usize| {
                    let row = &patch.change[kind * stride..][..stride];
                    row.iter().map(|&c| i64::from(c) * i64::from(c)).sum::<i64>()
                };
                patch.kinds.iter().map(|&kind| squares(kind)).sum::<i64>() as f64
            }
            Some(blurred) => {
                self.split_channels(patch);
                f64::from(blurred.quadratic(patch, self.plane_stride()))
            }
        };
    }

    /// Away from walls colours depend on the covered part of a pixel only.
    fn patch_on_floor(&self, agent: &Covered, patch: &mut Patch) {
        (patch.top, patch.left) = (agent.rows.start, agent.columns.start);
        let stride = self.change_stride();
        let (rows, columns) = (agent.rows.len(), agent.columns.len());
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
        patch.kinds.clear();
        patch.kinds.resize(rows, 1);
        if let Some(last) = patch.kinds.last_mut() {
            *last = 2;
        }
        if let Some(first) = patch.kinds.first_mut() {
            *first = 0;
        }
    }

    fn patch_anywhere(&self, renderer: &Renderer, scene: &[u8], state: &State, patch: &mut Patch) {
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

    /// Fills [`Patch::planes`] from [`Patch::change`].
    fn split_channels(&self, patch: &mut Patch) {
        let (stride, plane_stride) = (self.change_stride(), self.plane_stride());
        patch.planes.clear();
        patch.planes.resize(patch.change.len() / stride * 3 * plane_stride, 0.0);
        let rows = patch.planes.chunks_exact_mut(3 * plane_stride);
        for (planes, change) in rows.zip(patch.change.chunks_exact(stride)) {
            let (pixels, _) = change.as_chunks::<3>();
            for (column, pixel) in pixels.iter().take(self.reach).enumerate() {
                for channel in 0..3 {
                    planes[channel * plane_stride + column] = f32::from(pixel[channel]);
                }
            }
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
    /// `p.(G'G p)`: over pairs of kinds of rows, the Gram matrix of the rows that are of these
    /// kinds, times the inner product of the kinds under the Gram matrix of the columns.
    fn quadratic(&self, patch: &Patch, plane_stride: usize) -> f32 {
        let kinds = patch.planes.len() / (3 * plane_stride);
        let mut weights = [0.0_f32; 16];
        let mut many = Vec::new();
        let weights = if kinds * kinds <= weights.len() {
            &mut weights[..kinds * kinds]
        } else {
            many.resize(kinds * kinds, 0.0);
            &mut many[..]
        };
        for (row, &kind) in patch.kinds.iter().enumerate() {
            let gram = &self.gram[(patch.top + row) * self.stride + patch.top..];
            for (weight, &other) in gram.iter().zip(&patch.kinds) {
                weights[kind * kinds + other] += weight;
            }
        }
        let columns = &self.gram[patch.left * self.stride + patch.left..];
        weighted_products(&patch.planes, plane_stride, weights, columns, self.stride)
    }

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

/// Inner product of a patch, whose rows of `stride` values are of these `kinds`, with `other` read
/// every `other_stride` values.
#[multiversion(targets("x86_64+avx2"))]
fn inner_integers(
    kinds: &[usize],
    change: &[i16],
    stride: usize,
    other: &[i16],
    other_stride: usize,
) -> i64 {
    let mut sum = 0;
    for (row, kind) in kinds.iter().enumerate() {
        let (patch, _) = change[kind * stride..][..stride].as_chunks::<LANES>();
        let (other, _) = other[row * other_stride..][..stride].as_chunks::<LANES>();
        let mut lanes = [0_i32; LANES];
        for (p, o) in patch.iter().zip(other) {
            for lane in 0..LANES {
                lanes[lane] += i32::from(p[lane]) * i32::from(o[lane]);
            }
        }
        sum += i64::from(lanes.iter().sum::<i32>());
    }
    sum
}

/// [`inner_integers`] of the three planes; the order of additions is fixed.
#[multiversion(targets("x86_64+avx2"))]
fn inner_floats(
    kinds: &[usize],
    planes: &[f32],
    stride: usize,
    other: [&[f32]; 3],
    other_stride: usize,
) -> f32 {
    let mut lanes = [0.0_f32; LANES];
    for (row, kind) in kinds.iter().enumerate() {
        let patch = &planes[kind * 3 * stride..][..3 * stride];
        for (patch, other) in patch.chunks_exact(stride).zip(other) {
            let (patch, _) = patch.as_chunks::<LANES>();
            let (other, _) = other[row * other_stride..][..stride].as_chunks::<LANES>();
            for (p, o) in patch.iter().zip(other) {
                for lane in 0..LANES {
                    lanes[lane] += p[lane] * o[lane];
                }
            }
        }
    }
    lanes.iter().sum()
}

/// Sum over pairs `(i, j)` of rows of `planes`, three channels of `stride` values each, of
/// `weights[i, j]` times their inner product under `gram`.
#[multiversion(targets("x86_64+avx2"))]
fn weighted_products(
    planes: &[f32],
    stride: usize,
    weights: &[f32],
    gram: &[f32],
    gram_stride: usize,
) -> f32 {
    let kinds = planes.len() / (3 * stride);
    let columns = stride.min(gram.len().div_ceil(gram_stride));
    let mut lanes = [0.0_f32; LANES];
    for (kind, row) in planes.chunks_exact(3 * stride).enumerate() {
        for channel in 0..3 {
            let values = &row[channel * stride..][..columns];
            for block in (0..stride).step_by(LANES) {
                let mut across = [0.0_f32; LANES];
                for (column, value) in values.iter().enumerate() {
                    let gram = &gram[column * gram_stride + block..][..LANES];
                    for lane in 0..LANES {
                        across[lane] += value * gram[lane];
                    }
                }
                for other in 0..kinds {
                    let weight = weights[kind * kinds + other];
                    let values = &planes[(other * 3 + channel) * stride + block..][..LANES];
                    for lane in 0..LANES {
                        lanes[lane] += weight * values[lane] * across[lane];
                    }
                }
            }
        }
    }
    lanes.iter().sum()
}

#[multiversion(targets("x86_64+avx2"))]
fn add_scaled(sum: &mut [f32], factor: f32, values: &[f32]) {
    for (sum, &value) in sum.iter_mut().zip(values) {
        *sum += factor * value;
    }
}
