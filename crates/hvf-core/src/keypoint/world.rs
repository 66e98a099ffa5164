//! The learned compact dynamics model as a [`WorldModel`].

use std::sync::Arc;

use ndarray::{Array2, Array4, ArrayView2, ArrayView3, ArrayView4, Axis};
use rayon::prelude::*;

use super::cell::{Cell, Scratch};
use super::field::SceneField;
use super::frames::KeypointFrames;
use super::sprite::{GoalTerms, Sprite};
use crate::image::{GaussianBlur, OverHorizon};
use crate::lanes::{Lanes, LANES};
use crate::planner::{ActionSpace, Candidates, Frames, SharedCandidates, WorldModel};
use crate::{Error, Result};

/// Largest image, as the maze's.
const LARGEST_IMAGE: usize = 2048;

/// Learned dynamics whose planning cost is the pixel cost of the predicted frame.
///
/// # How it works
/// 1. The cell moves the keypoint of the start frame by each action in turn
///    (about `substeps * hidden^2` multiply-adds per step and candidate).
/// 2. The predicted frame is the start frame with its sprite moved to the new keypoint.
/// 3. Its squared distance to the goal image, per pixel, has a closed form ([`Sprite`]), so no
///    frame is decoded.
///
/// Actions beyond the action box are taken as they are: the cell, which was trained within it,
/// extrapolates.
#[derive(Clone, Debug)]
pub struct KeypointWorld {
    cell: Arc<Cell>,
    sprite: Sprite,
    size: usize,
    actions: ActionSpace,
    gram: Option<Array2<f32>>,
    over_horizon: OverHorizon,
}

impl KeypointWorld {
    /// A world of images of `size` pixels, seen through a Gaussian blur of `blur_sigma` pixels
    /// (0 for none).
    ///
    /// # Errors
    /// An action space of another dimension than the cell's, a sprite that cannot be drawn, an
    /// image size below 2 or above 2048, or a blur that is negative or not finite.
    pub fn new(
        cell: Cell,
        sprite: Sprite,
        actions: ActionSpace,
        size: usize,
        blur_sigma: f64,
        over_horizon: OverHorizon,
    ) -> Result<Self> {
        sprite.validate()?;
        if !(2..=LARGEST_IMAGE).contains(&size) {
            return Err(Error::invalid(
                "image_size",
                format!("must be at least 2 and at most {LARGEST_IMAGE}, got {size}"),
            ));
        }
        if cell.action_dim() != actions.dim() {
            return Err(Error::invalid(
                "action_low",
                format!("expected {} dimensions, got {}", cell.action_dim(), actions.dim()),
            ));
        }
        let gram = GaussianBlur::new(blur_sigma, "blur")?.map(|blur| blur.gram_matrix(size));
        Ok(Self { cell: Arc::new(cell), sprite, size, actions, gram, over_horizon })
    }

    /// Frames of this world from `images[N, S, S, 3]`, `keypoints[N, 2]` (row, column in pixels)
    /// and scene `maps[N, S, S]`: what the cell's patches look at.
    ///
    /// # Errors
    /// Shapes that do not fit each other or the world's image size, or numbers that are not
    /// finite.
    pub fn frames(
        &self,
        images: ArrayView4<'_, u8>,
        keypoints: ArrayView2<'_, f32>,
        maps: ArrayView3<'_, f32>,
    ) -> Result<KeypointFrames> {
        KeypointFrames::new(Arc::clone(&self.cell), self.size, images, keypoints, maps)
    }

    fn check(&self, argument: &'static str, frames: &KeypointFrames) -> Result<()> {
        if frames.belong_to(&self.cell) {
            Ok(())
        } else {
            Err(Error::invalid(argument, "are frames of another world"))
        }
    }

    fn terms(
        &self,
        starts: &KeypointFrames,
        s: usize,
        goals: &KeypointFrames,
        g: usize,
    ) -> GoalTerms {
        let mut residual: Vec<f32> = starts
            .image(s)
            .iter()
            .zip(goals.image(g))
            .map(|(&a, &b)| (f32::from(a) - f32::from(b)) / 255.0)
            .collect();
        self.sprite.draw(starts.keypoint(s), -1.0, &mut residual, self.size);
        self.sprite.goal_terms(&residual, self.size, self.gram.as_ref())
    }

    /// Rolls out the candidates `first..first + LANES` of `actions[D, H, A]` and hands the block
    /// of keypoints after every step to `visit(step, keypoints)`.
    fn roll(
        &self,
        keypoint: [f32; 2],
        field: &SceneField,
        actions: ArrayView3<'_, f32>,
        first: usize,
        scratch: &mut Room,
        mut visit: impl FnMut(usize, &[Lanes; 2]),
    ) {
        let last = actions.len_of(Axis(0)) - 1;
        let mut block = keypoint.map(|x| [x; LANES]);
        for step in 0..actions.len_of(Axis(1)) {
            for (dimension, lanes) in scratch.action.iter_mut().enumerate() {
                for (lane, value) in lanes.iter_mut().enumerate() {
                    *value = actions[[(first + lane).min(last), step, dimension]];
                }
            }
            self.cell.advance(field, &mut block, &scratch.action, &mut scratch.cell);
            visit(step, &block);
        }
    }

    fn scratch(&self) -> Room {
        Room { action: vec![[0.0; LANES]; self.actions.dim()], cell: self.cell.scratch() }
    }

    /// Cost of one candidate's keypoint, per pixel; NaN where that is no place.
    fn cost(&self, block: &[Lanes; 2], lane: usize, terms: &GoalTerms) -> f32 {
        let keypoint = [block[0][lane], block[1][lane]];
        // A sprite that is nowhere must not cost what a frame without it does.
        if !(keypoint[0].is_finite() && keypoint[1].is_finite()) {
            return f32::NAN;
        }
        let sum = self.sprite.squared_distance(keypoint, terms, self.gram.as_ref());
        // Below zero by rounding only; NaN stays NaN.
        let sum = if sum < 0.0 { 0.0 } else { sum };
        sum / (self.size * self.size) as f32
    }

    /// Keypoints `[B, D, H, 2]` (row, column in pixels) that the cell predicts from each of `B`
    /// frames for `actions[B, D, H, A]`.
    ///
    /// # Errors
    /// Frames or actions of another model, or not as many of one as of the other.
    pub fn rollout(
        &self,
        starts: &KeypointFrames,
        actions: ArrayView4<'_, f32>,
    ) -> Result<Array4<f32>> {
        self.check("starts", starts)?;
        let (problems, candidates, steps, dim) = actions.dim();
        check_actions(problems, starts.len(), dim, self.actions.dim())?;
        let mut paths = Array4::zeros((problems, candidates, steps, 2));
        paths.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(b, mut path)| {
            let field = starts.field(b);
            let mine = actions.index_axis(Axis(0), b);
            path.axis_chunks_iter_mut(Axis(0), LANES).into_par_iter().enumerate().for_each_init(
                || self.scratch(),
                |scratch, (block, mut out)| {
                    let first = block * LANES;
                    self.roll(starts.keypoint(b), field, mine, first, scratch, |step, at| {
                        for lane in 0..out.len_of(Axis(0)) {
                            out[[lane, step, 0]] = at[0][lane];
                            out[[lane, step, 1]] = at[1][lane];
                        }
                    });
                },
            );
        });
        Ok(paths)
    }
}

/// Room for one block: its actions, and the cell's.
struct Room {
    action: Vec<Lanes>,
    cell: Scratch,
}

fn check_actions(problems: usize, expected: usize, dim: usize, expected_dim: usize) -> Result<()> {
    if problems != expected {
        return Err(Error::invalid(
            "actions",
            format!("expected {expected} problems, got {problems}"),
        ));
    }
    if dim != expected_dim {
        return Err(Error::invalid(
            "actions",
            format!("expected {expected_dim} action dimensions, got {dim}"),
        ));
    }
    Ok(())
}

impl WorldModel for KeypointWorld {
    type Frames = KeypointFrames;

    fn action_space(&self) -> &ActionSpace {
        &self.actions
    }

    fn rollout_costs(
        &self,
        starts: &KeypointFrames,
        goals: &KeypointFrames,
        Candidates { actions, .. }: Candidates,
    ) -> Result<Array2<f32>> {
        self.check("starts", starts)?;
        self.check("goals", goals)?;
        let (problems, candidates, steps, dim) = actions.dim();
        check_actions(problems, starts.len(), dim, self.actions.dim())?;
        check_actions(problems, goals.len(), dim, self.actions.dim())?;
        let mut costs = Array2::zeros((problems, candidates));
        // Goal terms are as dear as a few dozen candidates, so blocks of one problem share them.
        costs.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(b, mut row)| {
            let terms = self.terms(starts, b, goals, b);
            let field = starts.field(b);
            let mine = actions.index_axis(Axis(0), b);
            row.axis_chunks_iter_mut(Axis(0), LANES).into_par_iter().enumerate().for_each_init(
                || self.scratch(),
                |scratch, (block, mut out)| {
                    let mut tally = vec![self.over_horizon.start(); out.len()];
                    let first = block * LANES;
                    self.roll(starts.keypoint(b), field, mine, first, scratch, |step, at| {
                        if self.over_horizon.counts(step, steps) {
                            for (lane, cost) in tally.iter_mut().enumerate() {
                                *cost = self.over_horizon.add(*cost, self.cost(at, lane, &terms));
                            }
                        }
                    });
                    for (cost, sum) in out.iter_mut().zip(tally) {
                        *cost = sum;
                    }
                },
            );
        });
        Ok(costs)
    }

    fn shared_rollout_costs(
        &self,
        start: &KeypointFrames,
        goals: &KeypointFrames,
        SharedCandidates { actions, .. }: SharedCandidates,
    ) -> Option<Result<Array2<f32>>> {
        Some(self.shared_costs(start, goals, actions.view()))
    }
}

impl KeypointWorld {
    fn shared_costs(
        &self,
        start: &KeypointFrames,
        goals: &KeypointFrames,
        actions: ArrayView3<'_, f32>,
    ) -> Result<Array2<f32>> {
        self.check("goals", goals)?;
        let path = self.rollout(start, actions.insert_axis(Axis(0)))?.index_axis_move(Axis(0), 0);
        let (candidates, steps, _) = path.dim();
        let mut costs = Array2::zeros((goals.len(), candidates));
        costs.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(g, mut row)| {
            let terms = self.terms(start, 0, goals, g);
            for (d, cost) in row.iter_mut().enumerate() {
                let mut sum = self.over_horizon.start();
                for step in (0..steps).filter(|&step| self.over_horizon.counts(step, steps)) {
                    let at = [[path[[d, step, 0]]; LANES], [path[[d, step, 1]]; LANES]];
                    sum = self.over_horizon.add(sum, self.cost(&at, 0, &terms));
                }
                *cost = sum;
            }
        });
        Ok(costs)
    }
}
