//! The oracle among subgoal generators: images of the scene with the agent where it can stand.

use std::sync::Arc;

use ndarray::{Array3, ArrayView1};

use super::frames::{MazeFrames, States};
use super::geometry::{Scene, State, AGENT_HALF, GAP_HALF, REACH, WALL_HALF, WALL_X};
use super::layout::{LayoutState, Obstacles};
use crate::planner::{Frames, SubgoalModel};
use crate::{Error, Result};

/// What a perfect generative model of the maze would do: latents from `N(0, I)` to states of the
/// scene, the agent uniform over where it can stand.
///
/// The first two latents are mapped through the normal distribution function and then through the
/// inverse distribution functions of `x`, and of `y` given `x`; the others are not used. The map
/// is continuous except at walls, so that neighbouring latents are neighbouring positions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MazeSubgoals {
    latent_dim: usize,
}

impl Default for MazeSubgoals {
    /// 8 latents, as the paper's generative model has.
    fn default() -> Self {
        Self { latent_dim: 8 }
    }
}

impl MazeSubgoals {
    /// A generator of `latent_dim` latents.
    ///
    /// # Errors
    /// Fewer than 2.
    pub fn new(latent_dim: usize) -> Result<Self> {
        if latent_dim < 2 {
            return Err(Error::invalid(
                "latent_dim",
                format!("must be at least 2, got {latent_dim}"),
            ));
        }
        Ok(Self { latent_dim })
    }

    /// The position of one latent, `[L]`.
    fn position(scene: &Scene, latent: ArrayView1<'_, f32>) -> [f64; 2] {
        let strips = strips(scene);
        let area = |strip: &Strip| (strip.x[1] - strip.x[0]) * (strip.y[1] - strip.y[0]);
        let total: f64 = strips.iter().map(area).sum();
        let mut left = total * normal_distribution(f64::from(latent[0]));
        let mut chosen = &strips[0];
        for strip in &strips {
            chosen = strip;
            if left <= area(strip) {
                break;
            }
            left -= area(strip);
        }
        let across = (left / area(chosen)).clamp(0.0, 1.0);
        let up = normal_distribution(f64::from(latent[1]));
        let within = |[low, high]: [f64; 2], part: f64| (low + part * (high - low)).min(high);
        [within(chosen.x, across), within(chosen.y, up)]
    }
}

impl SubgoalModel<MazeFrames> for MazeSubgoals {
    fn latent_dim(&self) -> usize {
        self.latent_dim
    }

    fn decode(&self, scene: &MazeFrames, latents: Array3<f32>) -> Result<MazeFrames> {
        if scene.len() != 1 {
            return Err(Error::invalid("scene", format!("must be one frame, got {}", scene.len())));
        }
        let (samples, subgoals, dim) = latents.dim();
        if dim != self.latent_dim {
            return Err(Error::invalid(
                "latents",
                format!("must be [M, K, {}], got [{samples}, {subgoals}, {dim}]", self.latent_dim),
            ));
        }
        if let Some(latent) = latents.iter().find(|latent| !latent.is_finite()) {
            return Err(Error::invalid("latents", format!("must be finite, got {latent}")));
        }
        let image_size = scene.image_size();
        Ok(match &scene.states() {
            States::Paper(states) => {
                let scene = states[0].scene;
                let space = scene.free_space();
                let place = |latent| space.push_out(Self::position(&scene, latent));
                let state = |latent| State { scene, position: place(latent) };
                let states: Vec<State> = latents.rows().into_iter().map(state).collect();
                MazeFrames::from_states(states, image_size)
            }
            States::Laid(states) => {
                let scene = &states[0].scene;
                let room = Room::of(scene.obstacles());
                let place = |latent: ArrayView1<'_, f32>| {
                    let [x, y] = [latent[0], latent[1]].map(|z| normal_distribution(f64::from(z)));
                    scene.obstacles().push_out(room.place(x, y))
                };
                let state =
                    |latent| LayoutState { scene: Arc::clone(scene), position: place(latent) };
                let states: Vec<LayoutState> = latents.rows().into_iter().map(state).collect();
                MazeFrames::from_states(states, image_size)
            }
        })
    }
}

/// A rectangle of free space.
struct Strip {
    x: [f64; 2],
    y: [f64; 2],
}

/// Free space, cut at the faces of the walls: five strips from left to right.
fn strips(scene: &Scene) -> [Strip; 5] {
    let [left, right] = WALL_X.map(|x| [x - WALL_HALF - AGENT_HALF, x + WALL_HALF + AGENT_HALF]);
    let gap = |wall: usize| {
        let (y, half) = (scene.gap_y[wall], GAP_HALF - AGENT_HALF);
        [(y - half).max(-REACH), (y + half).min(REACH)]
    };
    let open = [-REACH, REACH];
    [
        Strip { x: [-REACH, left[0]], y: open },
        Strip { x: left, y: gap(0) },
        Strip { x: [left[1], right[0]], y: open },
        Strip { x: right, y: gap(1) },
        Strip { x: [right[1], REACH], y: open },
    ]
}

/// The distribution function of `N(0, 1)`.
fn normal_distribution(z: f64) -> f64 {
    0.5 * libm::erfc(-z * std::f64::consts::FRAC_1_SQRT_2)
}

/// Free space of any layout in narrow columns, to a grid of [`Room::CELLS`] on each axis.
struct Room {
    reach: [f64; 2],
    /// Free cells of each column, from below, and of all columns up to and with it.
    columns: Vec<(Vec<usize>, usize)>,
}

impl Room {
    const CELLS: usize = 110;

    fn of(space: &Obstacles) -> Self {
        let reach = space.reach();
        let middle = |axis: usize, cell: usize| {
            reach[axis] * (2.0 * (cell as f64 + 0.5) / Self::CELLS as f64 - 1.0)
        };
        let mut total = 0;
        let columns = (0..Self::CELLS)
            .map(|column| {
                let free = |&row: &usize| space.contains([middle(0, column), middle(1, row)]);
                let rows: Vec<usize> = (0..Self::CELLS).filter(free).collect();
                total += rows.len();
                (rows, total)
            })
            .collect();
        Self { reach, columns }
    }

    /// The place at parts of the area from the left, and of the column there from below.
    fn place(&self, across: f64, up: f64) -> [f64; 2] {
        let total = self.columns.last().map_or(0, |(_, total)| *total);
        let wanted = across * total as f64;
        let column = self.columns.partition_point(|(_, upto)| (*upto as f64) < wanted);
        let Some((rows, upto)) = self.columns.get(column).filter(|(rows, _)| !rows.is_empty())
        else {
            return [0.0; 2];
        };
        let within = (wanted - (upto - rows.len()) as f64) / rows.len() as f64;
        let height = up * rows.len() as f64;
        let row = rows[(height as usize).min(rows.len() - 1)] as f64 + height.fract();
        let at =
            |axis: usize, cell: f64| self.reach[axis] * (2.0 * cell / Self::CELLS as f64 - 1.0);
        [at(0, column as f64 + within), at(1, row)]
    }
}
