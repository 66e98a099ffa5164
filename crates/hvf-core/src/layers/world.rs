//! The desk's learned dynamics model as a [`WorldModel`].

use std::sync::Arc;

use ndarray::{Array2, Array4, Array5, ArrayView2, ArrayView3, ArrayView4, ArrayViewMut2, Axis};
use rayon::prelude::*;

use super::cell::{Cell, Moving, Scratch};
use super::frames::LayerFrames;
use super::gallery::DIMENSIONS;
use super::goals::{Blur, Comparison, Goals};
use super::painter::{Canvas, Painter, Scene};
use crate::image::{GaussianBlur, OverHorizon};
use crate::lanes::{Lanes, LANES};
use crate::planner::{ActionSpace, Candidates, Frames, SharedCandidates, WorldModel};
use crate::{Error, Result};

/// Blocks of lanes that are rolled out together.
const BLOCKS: usize = 4;
/// Candidates of as many blocks.
const CHUNK: usize = BLOCKS * LANES;

/// Learned dynamics whose planning cost is the pixel cost of the predicted frame.
///
/// # How it works
/// 1. The cell moves hand, sliders and parts of the start frame by each action in turn
///    ([`Cell`]).
/// 2. The predicted frame is the start frame without its arm, changed, with the arm before it
///    ([`Painter`]).
/// 3. Its squared distance to the goal image, per pixel, is the cost.
///
/// Candidates go in blocks of 64; what one costs does not depend on its block, on the other
/// goals it is compared with, or on the number of threads.
///
/// Actions beyond the action box are taken as they are: the cell, which was trained within it,
/// extrapolates.
#[derive(Clone, Debug)]
pub struct LayerWorld {
    cell: Cell,
    painter: Arc<Painter>,
    actions: ActionSpace,
    blur: Option<Blur>,
    over_horizon: OverHorizon,
    hold: usize,
    scene_weight: f64,
}

/// Room for one chunk of candidates.
struct Room {
    cell: Scratch,
    actions: Vec<Vec<Lanes>>,
    canvas: Canvas,
    state: Vec<f32>,
}

impl LayerWorld {
    /// A world with actions in [-1, 1] of frames seen through a Gaussian blur of `blur_sigma`
    /// pixels (0 for none).
    ///
    /// # Errors
    /// A cell and a painter of different states, or a blur that is negative or not finite.
    pub fn new(
        cell: Cell,
        painter: Painter,
        blur_sigma: f64,
        over_horizon: OverHorizon,
    ) -> Result<Self> {
        if cell.action_dim() != DIMENSIONS {
            return Err(Error::invalid(
                "hand",
                format!("expected {DIMENSIONS} outputs, got {}", cell.action_dim()),
            ));
        }
        if cell.state_size() != painter.state_size() {
            return Err(Error::invalid(
                "sprites",
                format!("expected {} parts, got {}", cell.roaming(), painter.roaming()),
            ));
        }
        let limit = vec![1.0; cell.action_dim()];
        let actions = ActionSpace::new(limit.iter().map(|x| -x).collect(), limit)?;
        let tiles = painter.tiles();
        let blur = GaussianBlur::new(blur_sigma, "blur")?.map(|blur| Blur::new(blur, tiles));
        Ok(Self {
            cell,
            painter: Arc::new(painter),
            actions,
            blur,
            over_horizon,
            hold: 1,
            scene_weight: 0.0,
        })
    }

    /// The same world for actions that are held for `hold` steps each: of the frames of a
    /// rollout only those after a held action count, the last among them.
    ///
    /// # Errors
    /// A hold of 0.
    pub fn holding(self, hold: usize) -> Result<Self> {
        match hold {
            0 => Err(Error::invalid("hold", "must be at least 1, got 0")),
            _ => Ok(Self { hold, ..self }),
        }
    }

    /// The same world in whose cost what is behind the arm counts once more, `weight` times: the
    /// squared distance of frames without their arms, where the goal's hides nothing, per pixel and
    /// without a blur.
    ///
    /// # Errors
    /// A weight that is negative or not finite.
    pub fn weighing_scene(self, weight: f64) -> Result<Self> {
        match weight >= 0.0 && weight.is_finite() {
            false => Err(Error::invalid(
                "scene_weight",
                format!("must be finite and not negative, got {weight}"),
            )),
            true => Ok(Self { scene_weight: weight, ..self }),
        }
    }

    /// Whether the frame after `step` (from 0) of `steps` counts.
    fn counts(&self, step: usize, steps: usize) -> bool {
        self.over_horizon.counts(step, steps) && (steps - 1 - step).is_multiple_of(self.hold)
    }

    /// Frames of this world from `images[N, S, S, 3]`, the same without the arm (`clean`, in
    /// [0, 1]), where each part is in them (`regions[N, R, S, S]`) and `states[N, X]`.
    ///
    /// # Errors
    /// Shapes that do not fit each other or the world, or numbers that are not finite.
    pub fn frames(
        &self,
        images: ArrayView4<'_, u8>,
        clean: ArrayView4<'_, f32>,
        regions: ArrayView4<'_, bool>,
        states: ArrayView2<'_, f32>,
    ) -> Result<LayerFrames> {
        LayerFrames::new(Arc::clone(&self.painter), images, clean, regions, states)
    }

    fn check(&self, argument: &'static str, frames: &LayerFrames) -> Result<()> {
        if frames.belong_to(&self.painter) {
            Ok(())
        } else {
            Err(Error::invalid(argument, "are frames of another world"))
        }
    }

    fn check_actions(&self, problems: usize, expected: usize, dim: usize) -> Result<()> {
        if problems != expected {
            return Err(Error::invalid(
                "actions",
                format!("expected {expected} problems, got {problems}"),
            ));
        }
        if dim != self.actions.dim() {
            return Err(Error::invalid(
                "actions",
                format!("expected {} action dimensions, got {dim}", self.actions.dim()),
            ));
        }
        Ok(())
    }

    fn room(&self) -> Room {
        Room {
            cell: self.cell.scratch(BLOCKS),
            actions: vec![vec![[0.0; LANES]; self.actions.dim()]; BLOCKS],
            canvas: self.painter.canvas(self.scene_weight > 0.0),
            state: vec![0.0; self.cell.state_size()],
        }
    }

    /// Rolls out up to [`CHUNK`] candidates, `actions[D, H, A]`, and hands what moves to
    /// `visit(step, moving, canvas)` after every step.
    fn roll(
        &self,
        state: &[f32],
        actions: ArrayView3<'_, f32>,
        cell: &mut Scratch,
        lanes: &mut [Vec<Lanes>],
        mut visit: impl FnMut(usize, &Moving),
    ) {
        let (candidates, steps, _) = actions.dim();
        let blocks = candidates.div_ceil(LANES);
        let mut moving = self.cell.start(state, blocks);
        for step in 0..steps {
            for (block, lanes) in lanes[..blocks].iter_mut().enumerate() {
                for (dimension, lanes) in lanes.iter_mut().enumerate() {
                    for (lane, action) in lanes.iter_mut().enumerate() {
                        let candidate = (block * LANES + lane).min(candidates - 1);
                        *action = actions[[candidate, step, dimension]].clamp(-1.0, 1.0);
                    }
                }
            }
            self.cell.advance(&mut moving, lanes, cell);
            visit(step, &moving);
        }
    }

    /// Costs `[goals, candidates]` of up to [`CHUNK`] candidates.
    fn chunk_costs(
        &self,
        scene: &Scene<'_>,
        goals: &Goals<'_>,
        actions: ArrayView3<'_, f32>,
        (room, comparison): &mut (Room, Comparison),
        mut costs: ArrayViewMut2<'_, f32>,
    ) {
        let (candidates, steps, _) = actions.dim();
        costs.fill(self.over_horizon.start());
        let Room { cell, actions: lanes, canvas, state } = room;
        self.roll(scene.state(), actions, cell, lanes, |step, moving| {
            if !self.counts(step, steps) {
                return;
            }
            for candidate in 0..candidates {
                for (x, lanes) in state.iter_mut().zip(&moving.states[candidate / LANES]) {
                    *x = lanes[candidate % LANES];
                }
                // Rectified units and comparisons would lose what is not a number.
                let known = state.iter().all(|x| x.is_finite())
                    && actions.index_axis(Axis(0), candidate).iter().all(|x| x.is_finite());
                if !known {
                    costs.column_mut(candidate).fill(f32::NAN);
                    continue;
                }
                self.painter.paint(scene, state, canvas);
                goals.compare(scene, canvas, comparison, |goal, cost| {
                    let tally = &mut costs[[goal, candidate]];
                    *tally = self.over_horizon.add(*tally, cost);
                });
            }
        });
    }

    fn goals<'a>(
        &'a self,
        scene: &Scene<'_>,
        goals: &'a LayerFrames,
        which: std::ops::Range<usize>,
    ) -> Goals<'a> {
        Goals::new(scene, goals, which, self.painter.tiles(), self.blur.as_ref(), self.scene_weight)
    }

    /// States `[B, D, H, X]` that the cell predicts from each of `B` frames for
    /// `actions[B, D, H, A]`.
    ///
    /// # Errors
    /// Frames or actions of another model, or not as many of one as of the other.
    pub fn rollout(
        &self,
        starts: &LayerFrames,
        actions: ArrayView4<'_, f32>,
    ) -> Result<Array4<f32>> {
        self.check("starts", starts)?;
        let (problems, candidates, steps, dim) = actions.dim();
        self.check_actions(problems, starts.len(), dim)?;
        let mut paths = Array4::zeros((problems, candidates, steps, self.cell.state_size()));
        paths.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(b, mut path)| {
            path.axis_chunks_iter_mut(Axis(0), CHUNK)
                .into_par_iter()
                .zip(actions.index_axis(Axis(0), b).axis_chunks_iter(Axis(0), CHUNK))
                .for_each_init(
                    || self.room(),
                    |room, (mut out, actions)| {
                        let Room { cell, actions: lanes, .. } = room;
                        self.roll(starts.state(b), actions, cell, lanes, |step, moving| {
                            for ((candidate, x), to) in
                                out.index_axis_mut(Axis(1), step).indexed_iter_mut()
                            {
                                *to = moving.states[candidate / LANES][x][candidate % LANES];
                            }
                        });
                    },
                );
        });
        Ok(paths)
    }

    /// Frames `[N, H, S, S, 3]` that are predicted from each of `N` frames for `actions[N, H, A]`.
    ///
    /// # Errors
    /// Frames or actions of another model, or not as many of one as of the other.
    pub fn predict(
        &self,
        starts: &LayerFrames,
        actions: ArrayView3<'_, f32>,
    ) -> Result<Array5<u8>> {
        let paths = self.rollout(starts, actions.insert_axis(Axis(1)))?;
        let paths = paths.index_axis_move(Axis(1), 0);
        let (steps, size) = (actions.dim().1, self.painter.tiles().image_size());
        let mut frames = Array5::zeros((starts.len(), steps, size, size, 3));
        for step in 0..steps {
            let drawn = self.draw(starts, paths.index_axis(Axis(1), step))?;
            frames
                .index_axis_mut(Axis(1), step)
                .assign(&drawn.mapv(|value| (value * 255.0).round_ties_even() as u8));
        }
        Ok(frames)
    }

    /// Frames `[N, S, S, 3]` in [0, 1] of what `starts` look like at `states[N, X]`.
    ///
    /// # Errors
    /// Frames of another world, or states of another shape.
    pub fn draw(&self, starts: &LayerFrames, states: ArrayView2<'_, f32>) -> Result<Array4<f32>> {
        self.check("starts", starts)?;
        let (count, size) = (starts.len(), self.painter.tiles().image_size());
        if states.dim() != (count, self.cell.state_size()) {
            return Err(Error::invalid(
                "states",
                format!(
                    "expected shape [{count}, {}], got {:?}",
                    self.cell.state_size(),
                    states.shape()
                ),
            ));
        }
        let tiles = self.painter.tiles();
        let mut images = vec![0.0; count * size * size * 3];
        images.par_chunks_exact_mut(size * size * 3).enumerate().for_each_init(
            || self.painter.canvas(false),
            |canvas, (i, image)| {
                let scene = self.painter.scene(starts.start(i));
                self.painter.paint(&scene, &states.row(i).to_vec(), canvas);
                for (tile, values) in scene.still().chunks_exact(tiles.values()).enumerate() {
                    tiles.place(tile, values, image);
                }
                for (tile, values) in canvas.drawn(tiles) {
                    tiles.place(tile, values, image);
                }
                for value in image {
                    *value /= 255.0;
                }
            },
        );
        Ok(Array4::from_shape_vec((count, size, size, 3), images)
            .expect("as many values as N frames have"))
    }

    /// Costs `[B, D]` of `actions[D, H, A]` from the one frame in `start` to each of `goals[B]`.
    ///
    /// # Errors
    /// Frames or actions of another model, or more or less than one start.
    pub fn shared_costs(
        &self,
        start: &LayerFrames,
        goals: &LayerFrames,
        actions: ArrayView3<'_, f32>,
    ) -> Result<Array2<f32>> {
        self.check("start", start)?;
        self.check("goals", goals)?;
        if start.len() != 1 {
            return Err(Error::invalid("start", format!("expected 1 frame, got {}", start.len())));
        }
        let (candidates, _, dim) = actions.dim();
        self.check_actions(1, 1, dim)?;
        let scene = self.painter.scene(start.start(0));
        let prepared = self.goals(&scene, goals, 0..goals.len());
        let mut costs = Array2::zeros((goals.len(), candidates));
        costs
            .axis_chunks_iter_mut(Axis(1), CHUNK)
            .into_par_iter()
            .zip(actions.axis_chunks_iter(Axis(0), CHUNK))
            .for_each_init(
                || (self.room(), prepared.comparison()),
                |room, (out, actions)| {
                    self.chunk_costs(&scene, &prepared, actions, room, out);
                },
            );
        Ok(costs)
    }
}

impl WorldModel for LayerWorld {
    type Frames = LayerFrames;

    fn action_space(&self) -> &ActionSpace {
        &self.actions
    }

    fn max_candidates(&self) -> usize {
        1 << 14
    }

    fn rollout_costs(
        &self,
        starts: &LayerFrames,
        goals: &LayerFrames,
        Candidates { actions, .. }: Candidates,
    ) -> Result<Array2<f32>> {
        self.check("starts", starts)?;
        self.check("goals", goals)?;
        let (problems, candidates, _, dim) = actions.dim();
        self.check_actions(problems, starts.len(), dim)?;
        self.check_actions(problems, goals.len(), dim)?;
        let mut costs = Array2::zeros((problems, candidates));
        costs.axis_chunks_iter_mut(Axis(0), 1).into_par_iter().enumerate().for_each(
            |(b, mut row)| {
                let scene = self.painter.scene(starts.start(b));
                let prepared = self.goals(&scene, goals, b..b + 1);
                row.axis_chunks_iter_mut(Axis(1), CHUNK)
                    .into_par_iter()
                    .zip(actions.index_axis(Axis(0), b).axis_chunks_iter(Axis(0), CHUNK))
                    .for_each_init(
                        || (self.room(), prepared.comparison()),
                        |room, (out, actions)| {
                            self.chunk_costs(&scene, &prepared, actions, room, out);
                        },
                    );
            },
        );
        Ok(costs)
    }

    fn shared_rollout_costs(
        &self,
        start: &LayerFrames,
        goals: &LayerFrames,
        SharedCandidates { actions, .. }: SharedCandidates,
    ) -> Option<Result<Array2<f32>>> {
        Some(self.shared_costs(start, goals, actions.view()))
    }
}

#[cfg(test)]
#[path = "world_tests.rs"]
mod tests;
