//! The camera: frames of the maze, anti-aliased by exact area coverage, and back.
//!
//! Frames are `[size, size, 3]`, uint8, row 0 at the top (`y = +VIEW`). Everything in the scene
//! is an axis-aligned rectangle, so the covered part of a pixel is a product of an interval in
//! `x` and one in `y`, and a pixel's colour is the mean over its area: exact, hence linear in
//! motions far below a pixel.

use super::geometry::{
    Scene, State, AGENT_HALF, ARENA, BORDER, GAP_HALF, GAP_RANGE, WALL_HALF, WALL_X,
};
use crate::{Error, Result};

/// Frames show `[-VIEW, VIEW]` on both axes, m.
pub const VIEW: f64 = 0.32;
/// Size of a frame if nothing else is asked for, pixels.
pub const IMAGE_SIZE: usize = 64;
/// Smallest and largest size of a frame, pixels.
pub const IMAGE_SIZES: [usize; 2] = [8, 2048];
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
        let axis = Axis { size };
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
    pub fn render(&self, state: &State, frame: &mut [u8]) {
        self.render_scene(&state.scene, frame);
        self.render_agent(state, |pixel, colour| {
            frame[3 * pixel..3 * pixel + 3].copy_from_slice(&colour);
        });
    }

    /// Draws a scene without the agent into `frame`, `[size, size, 3]`.
    ///
    /// # Panics
    /// If `frame` does not have [`frame_len`](Self::frame_len) bytes.
    pub fn render_scene(&self, scene: &Scene, frame: &mut [u8]) {
        frame.copy_from_slice(&self.closed);
        let axis = Axis { size: self.size };
        for wall in 0..2 {
            let columns = axis.pixels(WALL_X[wall] - WALL_HALF, WALL_X[wall] + WALL_HALF);
            let y = scene.gap_y[wall];
            // Rows count downwards, so the axis of rows is -y.
            for row in axis.pixels(-y - GAP_HALF, -y + GAP_HALF) {
                for col in columns.clone() {
                    let pixel = row * self.size + col;
                    let colour = blend(self.walls_at(scene, row, col), 0.0);
                    frame[3 * pixel..3 * pixel + 3].copy_from_slice(&colour);
                }
            }
        }
    }

    /// Colours of the pixels that the agent covers, wholly or in part: `visit(pixel, colour)` for
    /// each, where `pixel` is `row * size + column`, in ascending order. All other pixels are as
    /// in [`render_scene`](Self::render_scene).
    #[inline]
    pub fn render_agent(&self, state: &State, mut visit: impl FnMut(usize, [u8; 3])) {
        let axis = Axis { size: self.size };
        let [x, y] = state.position;
        let columns = axis.pixels(x - AGENT_HALF, x + AGENT_HALF);
        for row in axis.pixels(-y - AGENT_HALF, -y + AGENT_HALF) {
            let in_row = axis.covered(row, -y - AGENT_HALF, -y + AGENT_HALF);
            for col in columns.clone() {
                let agent = in_row * axis.covered(col, x - AGENT_HALF, x + AGENT_HALF);
                if agent >= 1.0 {
                    visit(row * self.size + col, AGENT);
                } else if agent > 0.0 {
                    let walls = self.walls_at(&state.scene, row, col);
                    visit(row * self.size + col, blend(walls, agent));
                }
            }
        }
    }

    /// The part of a pixel that walls cover.
    #[inline]
    fn walls_at(&self, scene: &Scene, row: usize, col: usize) -> f64 {
        let mut walls = self.closed_walls[row * self.size + col];
        for (columns, y) in self.wall_columns.iter().zip(scene.gap_y) {
            if columns[col] > 0.0 {
                let axis = Axis { size: self.size };
                walls -= columns[col] * axis.covered(row, -y - GAP_HALF, -y + GAP_HALF);
            }
        }
        walls
    }

    /// The state that a frame `[size, size, 3]` shows: where the agent and the gaps are.
    ///
    /// On rendered frames of 32 pixels or more it is right to 0.1 mm. In other frames (blurred,
    /// noisy, generated) it finds the window of the agent's size that is greenest and the windows
    /// of the gaps' size with the least wall; gaps are clipped to `+-GAP_RANGE` and the agent is
    /// put where it can stand, so the result is always a legal state.
    ///
    /// # Panics
    /// If `frame` does not have [`frame_len`](Self::frame_len) bytes.
    pub fn locate(&self, frame: &[u8]) -> State {
        assert_eq!(frame.len(), self.frame_len());
        let size = self.size;
        let mut agent_rows = vec![0.0; size];
        let mut wall_rows = [vec![0.0; size], vec![0.0; size]];
        let mut agent = vec![0.0; size * size];
        let weights = self.wall_columns.each_ref().map(|columns| {
            let squares: f64 = columns.iter().map(|c| c * c).sum();
            columns.iter().map(|c| c / squares).collect::<Vec<_>>()
        });
        for row in 0..size {
            for col in 0..size {
                let pixel = row * size + col;
                let (walls, green) = unmix(&frame[3 * pixel..3 * pixel + 3]);
                agent[pixel] = green.clamp(0.0, 1.0);
                for (rows, weights) in wall_rows.iter_mut().zip(&weights) {
                    rows[row] += weights[col] * walls;
                }
            }
        }
        let axis = Axis { size };
        let gap_y = wall_rows.map(|rows| {
            let inside = axis.pixels(-ARENA, ARENA);
            let open: Vec<f64> =
                (0..size)
                    .map(|row| {
                        if inside.contains(&row) {
                            (1.0 - rows[row]).clamp(0.0, 1.0)
                        } else {
                            0.0
                        }
                    })
                    .collect();
            (-axis.centre(&open, GAP_HALF)).clamp(-GAP_RANGE, GAP_RANGE)
        });
        // Rows first; then columns, looking only at the rows where the agent is.
        let (top, left) = axis.brightest_window(&agent, AGENT_HALF);
        let mut agent_columns = vec![0.0; size];
        let reach = axis.window(AGENT_HALF) + 1;
        for row in top.saturating_sub(1)..(top + reach).min(size) {
            for col in left.saturating_sub(1)..(left + reach).min(size) {
                agent_rows[row] += agent[row * size + col];
                agent_columns[col] += agent[row * size + col];
            }
        }
        let position =
            [axis.centre(&agent_columns, AGENT_HALF), -axis.centre(&agent_rows, AGENT_HALF)];
        let scene = Scene { gap_y };
        State { scene, position: scene.free_space().push_out(position) }
    }
}

/// One axis of a frame: `size` pixels over `[-VIEW, VIEW]`.
#[derive(Clone, Copy)]
struct Axis {
    size: usize,
}

impl Axis {
    #[inline]
    fn pixel(self) -> f64 {
        2.0 * VIEW / self.size as f64
    }

    /// Where pixel `index` begins.
    #[inline]
    fn edge(self, index: usize) -> f64 {
        index as f64 * self.pixel() - VIEW
    }

    /// The pixels that `[low, high]` overlaps.
    #[inline]
    fn pixels(self, low: f64, high: f64) -> std::ops::Range<usize> {
        let scale = self.size as f64 / (2.0 * VIEW);
        let first = ((low + VIEW) * scale).floor().max(0.0) as usize;
        let last = ((high + VIEW) * scale).ceil().clamp(0.0, self.size as f64) as usize;
        first..last
    }

    /// The part of pixel `index` that `[low, high]` covers.
    #[inline]
    fn covered(self, index: usize, low: f64, high: f64) -> f64 {
        let scale = self.size as f64 / (2.0 * VIEW);
        let begin = (low + VIEW) * scale - index as f64;
        let end = (high + VIEW) * scale - index as f64;
        (end.min(1.0) - begin.max(0.0)).clamp(0.0, 1.0)
    }

    /// Whole pixels that an interval of `2 * half` fits into.
    fn window(self, half: f64) -> usize {
        ((2.0 * half / self.pixel() - 1e-9).ceil() as usize).clamp(1, self.size)
    }

    /// Centre of the interval of `2 * half` metres whose coverage of the pixels is `profile`, up
    /// to a factor.
    ///
    /// What lies on either side of a pixel edge inside the interval says how far the interval
    /// extends there.
    fn centre(self, profile: &[f64], half: f64) -> f64 {
        let window = self.window(half);
        let sums =
            |first: usize| profile[first..(first + window).min(self.size)].iter().sum::<f64>();
        let mut best = (f64::NEG_INFINITY, 0);
        for first in 0..=self.size - window {
            let sum = sums(first);
            if sum > best.0 + 1e-9 {
                best = (sum, first);
            }
        }
        let (low, high) = (best.1.saturating_sub(1), (best.1 + window + 1).min(self.size));
        let near = &profile[low..high];
        let total: f64 = near.iter().sum();
        if total <= 1e-6 {
            return 0.0;
        }
        // The edge with about half of the coverage on each side.
        let (mut before, mut split) = (0.0, 0);
        while split + 1 < near.len()
            && (before + near[split] - 0.5 * total).abs() <= (before - 0.5 * total).abs()
        {
            before += near[split];
            split += 1;
        }
        let balance = (total - 2.0 * before) / total;
        self.edge(low + split) + balance * half
    }

    /// First row and column of the square window of the size of an object of half-size `half`
    /// that holds most of `image`, `[size, size]`.
    fn brightest_window(self, image: &[f64], half: f64) -> (usize, usize) {
        let (size, window) = (self.size, self.window(half));
        let mut columns = vec![0.0; size];
        for row in 0..window {
            for col in 0..size {
                columns[col] += image[row * size + col];
            }
        }
        let mut best = (f64::NEG_INFINITY, 0, 0);
        for row in 0..=size - window {
            if row > 0 {
                for col in 0..size {
                    columns[col] +=
                        image[(row + window - 1) * size + col] - image[(row - 1) * size + col];
                }
            }
            let mut sum: f64 = columns[..window].iter().sum();
            for col in 0..=size - window {
                if col > 0 {
                    sum += columns[col + window - 1] - columns[col - 1];
                }
                if sum > best.0 + 1e-9 {
                    best = (sum, row, col);
                }
            }
        }
        (best.1, best.2)
    }
}

/// Colour of a pixel, `walls` of which is wall and `agent` of which is agent, the rest floor. The
/// agent is in front, should they overlap.
#[inline]
fn blend(walls: f64, agent: f64) -> [u8; 3] {
    let walls = walls.min(1.0 - agent);
    std::array::from_fn(|channel| {
        let [floor, wall, green] = [FLOOR, WALL, AGENT].map(|colour| f64::from(colour[channel]));
        let value = floor + (wall - floor) * walls + (green - floor) * agent;
        // Halves round up, also where 0.5 is met only up to rounding of the coverage.
        (value + 0.5 + 1e-9) as u8
    })
}

/// The parts of a pixel that walls and agent cover, by least squares over its channels.
#[inline]
fn unmix(colour: &[u8]) -> (f64, f64) {
    let (mut ww, mut wa, mut aa, mut wp, mut ap) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for channel in 0..3 {
        let [floor, wall, green] = [FLOOR, WALL, AGENT].map(|colour| f64::from(colour[channel]));
        let (wall, green, pixel) =
            (wall - floor, green - floor, f64::from(colour[channel]) - floor);
        ww += wall * wall;
        wa += wall * green;
        aa += green * green;
        wp += wall * pixel;
        ap += green * pixel;
    }
    let determinant = ww * aa - wa * wa;
    ((aa * wp - wa * ap) / determinant, (ww * ap - wa * wp) / determinant)
}
