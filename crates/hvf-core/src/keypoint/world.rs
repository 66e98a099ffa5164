//! The learned compact dynamics model as a [`WorldModel`].

use std::borrow::Cow;
use std::sync::Arc;

use ndarray::{Array2, Array4, ArrayView2, ArrayView3, ArrayView4, Axis};
use rayon::prelude::*;

use super::cell::{Cell, Scratch};
use super::cost::{Footprint, GoalTerms, SpriteCost};
use super::field::SceneField;
use super::frames::KeypointFrames;
use super::sprite::Sprite;
use crate::image::{GaussianBlur, OverHorizon};
use crate::lanes::{Lanes, LANES};
use crate::planner::{ActionSpace, Candidates, Frames, SharedCandidates, WorldModel};
use crate::{Error, Result};

/// Largest image, as the maze's.
const LARGEST_IMAGE: usize = 2048;

/// Goals of one plan that are prepared at most, about 20 KB each; more work out what they
/// contribute in every iteration.
const MOST_PREPARED: usize = 1 << 12;

/// Learned dynamics whose planning cost is the pixel cost of the predicted frame.
///
/// # How it works
/// 1. The cell moves the keypoint of the start frame by each action in turn
///    (about `substeps * hidden^2` multiply-adds per step and candidate).
/// 2. The predicted frame is the start frame with its sprite moved to the new keypoint.
/// 3. Its squared distance to the goal image, per pixel, has a closed form (`cost.rs`), so no
///    frame is decoded.
///
/// Actions beyond the action box are taken as they are: the cell, which was trained within it,
/// extrapolates.
#[derive(Clone, Debug)]
pub struct KeypointWorld {
    cell: Arc<Cell>,
    cost: SpriteCost,
    size: usize,
    actions: ActionSpace,
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
        let cost = SpriteCost::new(sprite, size, gram);
        Ok(Self { cell: Arc::new(cell), cost, size, actions, over_horizon })
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

    /// What start `s` and goal `g` contribute to costs, if need be worked out now.
    fn terms<'f>(
        &self,
        starts: &KeypointFrames,
        s: usize,
        goals: &'f KeypointFrames,
        g: usize,
    ) -> Cow<'f, GoalTerms> {
        match goals.terms(g) {
            Some(terms) => Cow::Borrowed(terms),
            None => Cow::Owned(self.cost.goal_terms(
                starts.image(s),
                starts.keypoint(s),
                goals.image(g),
            )),
        }
    }

    /// Rolls out the candidates `first..first + count` of `actions[D, H, A]` and hands the block
    /// of keypoints after every step to `visit(step, keypoints)`.
    fn roll(
        &self,
        keypoint: [f32; 2],
        field: &SceneField,
        actions: ArrayView3<'_, f32>,
        (first, count): (usize, usize),
        (action, scratch): (&mut [f32], &mut Scratch),
        mut visit: impl FnMut(usize, &[Lanes; 2]),
    ) {
        let mut block = keypoint.map(|x| [x; LANES]);
        for step in 0..actions.len_of(Axis(1)) {
            for (lane, action) in action.chunks_exact_mut(self.actions.dim()).enumerate() {
                if lane < count {
                    for (dimension, value) in action.iter_mut().enumerate() {
                        *value = actions[[first + lane, step, dimension]];
                    }
                }
            }
            self.cell.advance(field, &mut block, count, action, scratch);
            visit(step, &block);
        }
    }

    fn scratch(&self) -> Room {
        Room {
            action: vec![0.0; LANES * self.actions.dim()],
            cell: self.cell.scratch(),
            footprint: self.cost.room(),
            under: self.cost.under(),
        }
    }

    /// The tallies with one more frame that counts and costs `costs`.
    fn add(&self, tally: &mut Lanes, costs: &Lanes) {
        for (tally, cost) in tally.iter_mut().zip(costs) {
            *tally = self.over_horizon.add(*tally, *cost);
        }
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
                |Room { action, cell, .. }, (block, mut out)| {
                    let those = (block * LANES, out.len_of(Axis(0)));
                    let room = (&mut action[..], cell);
                    self.roll(starts.keypoint(b), field, mine, those, room, |step, at| {
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
    /// `[LANES][A]`.
    action: Vec<f32>,
    cell: Scratch,
    footprint: Footprint,
    under: Vec<Lanes>,
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

    /// Goals with what they and their starts contribute to the costs of all candidates.
    fn prepare(
        &self,
        starts: &KeypointFrames,
        goals: &KeypointFrames,
    ) -> Result<Option<(KeypointFrames, KeypointFrames)>> {
        self.check("starts", starts)?;
        self.check("goals", goals)?;
        if goals.len() > MOST_PREPARED {
            return Ok(None);
        }
        let start = |g: usize| if starts.len() == 1 { 0 } else { g };
        let terms: Vec<GoalTerms> = (0..goals.len())
            .into_par_iter()
            .map(|g| self.terms(starts, start(g), goals, g).into_owned())
            .collect();
        Ok(Some((starts.clone(), goals.with_terms(terms))))
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
                    let mut tally = [self.over_horizon.start(); LANES];
                    let those = (block * LANES, out.len());
                    let Room { action, cell, footprint, under } = scratch;
                    let room = (&mut action[..], cell);
                    self.roll(starts.keypoint(b), field, mine, those, room, |step, at| {
                        if self.over_horizon.counts(step, steps) {
                            self.cost.footprint(at, footprint, under);
                            self.add(&mut tally, &self.cost.costs(&terms, footprint, under));
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
        let footprints = self.footprints(start, actions)?;
        let mut costs = Array2::zeros((goals.len(), actions.len_of(Axis(0))));
        costs.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each_init(
            || self.cost.under(),
            |under, (g, mut row)| {
                let terms = self.terms(start, 0, goals, g);
                for (mut out, footprints) in
                    row.axis_chunks_iter_mut(Axis(0), LANES).zip(&footprints)
                {
                    let mut tally = [self.over_horizon.start(); LANES];
                    for footprint in footprints {
                        self.add(&mut tally, &self.cost.costs(&terms, footprint, under));
                    }
                    for (cost, sum) in out.iter_mut().zip(tally) {
                        *cost = sum;
                    }
                }
            },
        );
        Ok(costs)
    }

    /// Where the sprites are in all frames that count: for every block of candidates, one
    /// footprint a frame.
    fn footprints(
        &self,
        start: &KeypointFrames,
        actions: ArrayView3<'_, f32>,
    ) -> Result<Vec<Vec<Footprint>>> {
        self.check("start", start)?;
        let (candidates, steps, dim) = actions.dim();
        check_actions(1, start.len(), dim, self.actions.dim())?;
        let field = start.field(0);
        let blocks = (0..candidates.div_ceil(LANES)).into_par_iter().map_init(
            || self.scratch(),
            |Room { action, cell, under, .. }, block| {
                let those = (block * LANES, LANES.min(candidates - block * LANES));
                let mut footprints = Vec::new();
                let room = (&mut action[..], cell);
                self.roll(start.keypoint(0), field, actions, those, room, |step, at| {
                    if self.over_horizon.counts(step, steps) {
                        let mut footprint = self.cost.room();
                        self.cost.footprint(at, &mut footprint, under);
                        footprints.push(footprint);
                    }
                });
                footprints
            },
        );
        Ok(blocks.collect())
    }
}
