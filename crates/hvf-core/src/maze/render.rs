//! The camera: frames of the maze, anti-aliased by exact area coverage, and back.
//!
//! Frames are `[size, size, 3]`, uint8, row 0 at the top (`y = +VIEW`). Everything in the scene
//! is an axis-aligned rectangle, so the covered part of a pixel is a product of an interval in
//! `x` and one in `y`, and a pixel's colour is the mean over its area: exact, hence linear in
//! motions far below a pixel.

use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use super::geometry::{
    Scene, State, AGENT_HALF, ARENA, BORDER, GAP_HALF, GAP_RANGE, WALL_HALF, WALL_X,
};
use super::ground::{Ground, Walls};
use super::pixels::{Axis, Covered};
use crate::{Error, Result};

/// Frames show `[-VIEW, VIEW]` on both axes, m.
pub const VIEW: f64 = 0.32;
/// Size of a frame if nothing else is asked for, pixels.
pub const IMAGE_SIZE: usize = 64;
/// Smallest and largest size of a frame, pixels.
pub const IMAGE_SIZES: [usize; 2] = [8, 2048];
/// Renderers that [`Renderer::shared`] keeps.
const SIZES_KEPT: usize = 8;
/// Colour of the floor, RGB.
pub const FLOOR: [u8; 3] = [24, 36, 92];
/// Colour of the walls, RGB.
pub const WALL: [u8; 3] = [130, 180, 235];
/// Colour of the agent, RGB.
pub const AGENT: [u8; 3] = [60, 200, 90];

/// Draws states, and finds them again in frames. Made once for a size.
#[derive(Clone, Debug)]
pub struct Renderer {
    size: usize,
    /// The scene with both gaps closed and without the agent, `[size, size, 3]`.
    closed: Vec<u8>,
    /// The part of each pixel that walls cover in it, `[size, size]`.
    closed_walls: Vec<f64>,
    /// The part of each column that each inner wall covers, `[2][size]`.
    wall_columns: [Vec<f64>; 2],
}

impl Renderer {
    /// A renderer of `[size, size, 3]` frames.
    ///
    /// # Errors
    /// A size outside [`IMAGE_SIZES`].
    pub fn new(size: usize) -> Result<Self> {
        let [smallest, largest] = IMAGE_SIZES;
        if !(smallest..=largest).contains(&size) {
            return Err(Error::invalid(
                "size",
                format!("must be from {smallest} to {largest} pixels, got {size}"),
            ));
        }
        let axis = Axis::new(size);
        let column =
            |low, high| (0..size).map(|pixel| axis.covered(pixel, low, high)).collect::<Vec<_>>();
        // Symmetric about 0, so rows and columns are covered alike.
        let outer = column(-ARENA - BORDER, ARENA + BORDER);
        let inner = column(-ARENA, ARENA);
        let wall_columns = WALL_X.map(|x| column(x - WALL_HALF, x + WALL_HALF));
        let mut closed = Vec::with_capacity(size * size * 3);
        let mut closed_walls = Vec::with_capacity(size * size);
        for row in 0..size {
            for col in 0..size {
                let inside = wall_columns[0][col] + wall_columns[1][col];
                let walls = outer[row] * outer[col] - inner[row] * (inner[col] - inside);
                closed_walls.push(walls);
                closed.extend(blend(walls, 0.0));
            }
        }
        Ok(Self { size, closed, closed_walls, wall_columns })
    }

    /// A renderer that is made once for all callers that ask for this size, as long as they ask
    /// for few sizes.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn shared(size: usize) -> Result<Arc<Self>> {
        static KEPT: Mutex<Vec<Arc<Renderer>>> = Mutex::new(Vec::new());
        let mut kept = KEPT.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(renderer) = kept.iter().find(|renderer| renderer.size == size) {
            return Ok(Arc::clone(renderer));
        }
        let renderer = Arc::new(Self::new(size)?);
        if kept.len() == SIZES_KEPT {
            kept.remove(0);
        }
        kept.push(Arc::clone(&renderer));
        Ok(renderer)
    }

    /// Width and height of a frame, pixels.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Bytes of a frame: `size * size * 3`.
    pub fn frame_len(&self) -> usize {
        self.size * self.size * 3
    }

    /// Draws `state` into `frame`, `[size, size, 3]`.
    ///
    /// # Panics
    /// If `frame` does not have [`frame_len`](Self::frame_len) bytes.
    pub fn render<S: Ground>(&self, state: &State<S>, frame: &mut [u8]) {
        self.render_scene(&state.scene, frame);
        self.render_agent(state, |pixel, colour| {
            frame[3 * pixel..3 * pixel + 3].copy_from_slice(&colour);
        });
    }

    /// Draws a scene without the agent into `frame`, `[size, size, 3]`.
    ///
    /// # Panics
    /// If `frame` does not have [`frame_len`](Self::frame_len) bytes.
    pub fn render_scene<S: Ground>(&self, scene: &S, frame: &mut [u8]) {
        scene.walls_in(self).draw(frame);
    }

    /// The paper's two walls.
    pub(super) fn draw_two_walls(&self, scene: &Scene, frame: &mut [u8]) {
        frame.copy_from_slice(&self.closed);
        let axis = Axis::new(self.size);
        for ((x, y), covered) in WALL_X.into_iter().zip(scene.gap_y).zip(&self.wall_columns) {
            let columns = axis.pixels(x - WALL_HALF, x + WALL_HALF);
            // Rows count downwards, so the axis of rows is -y.
            for row in axis.pixels(-y - GAP_HALF, -y + GAP_HALF) {
                let open = axis.covered(row, -y - GAP_HALF, -y + GAP_HALF);
                for col in columns.clone() {
                    let pixel = row * self.size + col;
                    let walls = self.closed_walls[pixel] - open * covered[col];
                    let colour = if walls == 0.0 { FLOOR } else { blend(walls, 0.0) };
                    frame[3 * pixel..3 * pixel + 3].copy_from_slice(&colour);
                }
            }
        }
    }

    /// Colours of the pixels that the agent covers, wholly or in part: `visit(pixel, colour)` for
    /// each, where `pixel` is `row * size + column`, in ascending order. All other pixels are as
    /// in [`render_scene`](Self::render_scene).
    #[inline]
    pub fn render_agent<S: Ground>(&self, state: &State<S>, mut visit: impl FnMut(usize, [u8; 3])) {
        let walls = state.scene.walls_in(self);
        let agent = self.agent_box(state.position);
        for row in agent.rows.clone() {
            let in_row = Covered::part(row, &agent.rows, agent.row_ends);
            for col in agent.columns.clone() {
                let pixel = row * self.size + col;
                let part = in_row * Covered::part(col, &agent.columns, agent.column_ends);
                if part >= 1.0 {
                    visit(pixel, AGENT);
                } else if part > 0.0 {
                    visit(pixel, blend(walls.at(row, col), part));
                }
            }
        }
    }

    /// The pixels that the agent at `position` covers, wholly or in part.
    #[inline]
    pub(super) fn agent_box(&self, [x, y]: [f64; 2]) -> Covered {
        let axis = Axis::new(self.size);
        let columns = axis.pixels(x - AGENT_HALF, x + AGENT_HALF);
        let rows = axis.pixels(-y - AGENT_HALF, -y + AGENT_HALF);
        // Only the first and the last pixel of an interval are covered in part.
        let ends = |pixels: &Range<usize>, centre: f64| {
            let covered = |pixel| axis.covered(pixel, centre - AGENT_HALF, centre + AGENT_HALF);
            [covered(pixels.start), covered(pixels.end.saturating_sub(1))]
        };
        Covered { column_ends: ends(&columns, x), row_ends: ends(&rows, -y), rows, columns }
    }

    /// Whether no scene has a wall in this row between the inner walls, and in this column apart
    /// from the border: rows, then columns, `[size]` each.
    pub(super) fn open_lines(&self) -> [Vec<bool>; 2] {
        let middle = self.size / 2;
        let open = |pixel: usize| self.closed_walls[pixel] == 0.0;
        let rows = (0..self.size).map(|row| open(row * self.size + middle)).collect();
        let columns = (0..self.size).map(|col| open(middle * self.size + col)).collect();
        [rows, columns]
    }

    /// The part of a pixel that walls cover.
    #[inline]
    pub(super) fn walls_at(&self, scene: &Scene, row: usize, col: usize) -> f64 {
        let mut walls = self.closed_walls[row * self.size + col];
        if walls == 0.0 {
            return 0.0;
        }
        for (columns, y) in self.wall_columns.iter().zip(scene.gap_y) {
            if columns[col] > 0.0 {
                let axis = Axis::new(self.size);
                walls -= columns[col] * axis.covered(row, -y - GAP_HALF, -y + GAP_HALF);
            }
        }
        walls
    }

    /// The parts that walls cover of the pixels of `row` in `columns`, into the first numbers of
    /// `out`.
    pub(super) fn walls_in_row(
        &self,
        scene: &Scene,
        row: usize,
        columns: &Range<usize>,
        out: &mut [f64],
    ) {
        let closed = &self.closed_walls[row * self.size..][columns.clone()];
        out[..closed.len()].copy_from_slice(closed);
        let axis = Axis::new(self.size);
        for (covered, y) in self.wall_columns.iter().zip(scene.gap_y) {
            let covered = &covered[columns.clone()];
            if covered.iter().any(|&part| part > 0.0) {
                let open = axis.covered(row, -y - GAP_HALF, -y + GAP_HALF);
                for ((walls, &closed), &part) in out.iter_mut().zip(closed).zip(covered) {
                    if closed != 0.0 && part > 0.0 {
                        *walls -= part * open;
                    }
                }
            }
        }
    }

    /// The state that a frame `[size, size, 3]` shows: where the agent and the gaps are.
    ///
    /// On rendered frames of 64 pixels it is right to about 0.1 mm (colours are rounded), on smaller
    /// ones to a hundredth of a pixel; below 16 pixels the agent may hide inside one pixel. In other frames (blurred,
    /// noisy, generated) it finds the window of the agent's size that is greenest and the windows
    /// of the gaps' size with the least wall; gaps are clipped to `+-GAP_RANGE` and the agent is
    /// put where it can stand, so the result is always a legal state.
    ///
    /// # Panics
    /// If `frame` does not have [`frame_len`](Self::frame_len) bytes.
    pub fn locate(&self, frame: &[u8]) -> State {
        assert_eq!(frame.len(), self.frame_len());
        let size = self.size;
        let axis = Axis::new(size);
        let gap_y = std::array::from_fn(|wall| {
            let columns = &self.wall_columns[wall];
            let squares: f64 = columns.iter().map(|column| column * column).sum();
            let mut open = vec![0.0; size];
            for row in axis.pixels(-ARENA, ARENA) {
                let mut covered = 0.0;
                for col in axis.pixels(WALL_X[wall] - WALL_HALF, WALL_X[wall] + WALL_HALF) {
                    let pixel = 3 * (row * size + col);
                    covered += columns[col] * unmix(&UNMIX_WALLS, &frame[pixel..pixel + 3]);
                }
                open[row] = (1.0 - covered / squares).clamp(0.0, 1.0);
            }
            (-axis.centre(&open, GAP_HALF)).clamp(-GAP_RANGE, GAP_RANGE)
        });
        let position = self.locate_agent(frame);
        let scene = Scene { gap_y };
        State { scene, position: scene.free_space().push_out(position) }
    }

    /// Where the agent is in a frame, m.
    pub(super) fn locate_agent(&self, frame: &[u8]) -> [f64; 2] {
        let (size, axis) = (self.size, Axis::new(self.size));
        let pixels = frame.chunks_exact(3);
        let agent: Vec<f64> =
            pixels.map(|colour| unmix(&UNMIX_AGENT, colour).clamp(0.0, 1.0)).collect();
        // Only the part of the frame where the agent is, and a pixel around it.
        let (top, left) = axis.brightest_window(&agent, AGENT_HALF);
        let (mut agent_rows, mut agent_columns) = (vec![0.0; size], vec![0.0; size]);
        let reach = axis.window(AGENT_HALF) + 1;
        for row in top.saturating_sub(1)..(top + reach).min(size) {
            for col in left.saturating_sub(1)..(left + reach).min(size) {
                agent_rows[row] += agent[row * size + col];
                agent_columns[col] += agent[row * size + col];
            }
        }
        [axis.centre(&agent_columns, AGENT_HALF), -axis.centre(&agent_rows, AGENT_HALF)]
    }
}

/// Colour of a pixel, `walls` of which is wall and `agent` of which is agent, the rest floor. The
/// agent is in front, should they overlap.
#[inline]
pub(super) fn blend(walls: f64, agent: f64) -> [u8; 3] {
    let walls = walls.min(1.0 - agent);
    std::array::from_fn(|channel| {
        let [floor, wall, green] = [FLOOR, WALL, AGENT].map(|colour| f64::from(colour[channel]));
        let value = floor + (wall - floor) * walls + (green - floor) * agent;
        // Halves round up, also where 0.5 is met only up to rounding of the coverage.
        (value + 0.5 + 1e-9) as u8
    })
}

/// The part of a pixel that walls or agent cover, by least squares over its channels.
#[inline]
fn unmix(weights: &[f64; 3], colour: &[u8]) -> f64 {
    (0..3).map(|i| weights[i] * (f64::from(colour[i]) - f64::from(FLOOR[i]))).sum()
}

/// The part of a pixel that walls cover, by its colour.
#[inline]
pub(super) fn wall_part(colour: &[u8]) -> f64 {
    unmix(&UNMIX_WALLS, colour)
}

const UNMIX_WALLS: [f64; 3] = unmixing(WALL, AGENT);
const UNMIX_AGENT: [f64; 3] = unmixing(AGENT, WALL);

/// Row of the pseudo-inverse of the two colours (less the floor's) that gives the part of `of`.
const fn unmixing(of: [u8; 3], other: [u8; 3]) -> [f64; 3] {
    let (mut a, mut b) = ([0.0; 3], [0.0; 3]);
    let (mut aa, mut ab, mut bb) = (0.0, 0.0, 0.0);
    let mut channel = 0;
    while channel < 3 {
        a[channel] = of[channel] as f64 - FLOOR[channel] as f64;
        b[channel] = other[channel] as f64 - FLOOR[channel] as f64;
        aa += a[channel] * a[channel];
        ab += a[channel] * b[channel];
        bb += b[channel] * b[channel];
        channel += 1;
    }
    let mut row = [0.0; 3];
    channel = 0;
    while channel < 3 {
        row[channel] = (bb * a[channel] - ab * b[channel]) / (aa * bb - ab * ab);
        channel += 1;
    }
    row
}
