//! What steps, frames and costs ask of a maze with its walls in place, whichever layout it has.

use std::ops::Range;
use std::sync::Arc;

use super::episodes::Episode;
use super::geometry::{FreeSpace, Scene, State};
use super::layout::{step_in, Backdrop, LayoutScene};
use super::physics::step_within;
use super::render::Renderer;

/// A maze with its walls in place: the paper's [`Scene`], which has a fast path of its own, or
/// any layout's.
pub trait Ground: Clone + PartialEq + Send + Sync + 'static {
    /// What steps in one scene share.
    type Space: Send + Sync;
    /// What a renderer knows of the scene's walls.
    type Walls<'a>: Walls + 'a
    where
        Self: 'a;

    /// Where the agent can be.
    fn space(&self) -> Self::Space;

    /// Where half a second of `action` leads from `position`; total, as
    /// [`step_within`].
    fn step_from(space: &Self::Space, position: [f64; 2], action: [f64; 2]) -> [f64; 2];

    /// Ground-truth subgoals of an episode.
    fn true_subgoals(episode: &Episode<Self>, count: usize) -> Vec<State<Self>>;

    /// What walls cover in the frames of a renderer.
    fn walls_in<'a>(&'a self, renderer: &'a Renderer) -> Self::Walls<'a>;

    /// Where the gaps are, m: what follows the agent's position in the row of a state.
    fn gaps(&self) -> &[f64];
}

/// What walls cover of the pixels of a frame.
pub trait Walls {
    /// Draws the scene without the agent into a frame `[size, size, 3]`.
    fn draw(&self, frame: &mut [u8]);

    /// The part of a pixel that walls cover.
    fn at(&self, row: usize, column: usize) -> f64;

    /// The parts of the pixels of a row, into the first numbers of `out`.
    fn in_row(&self, row: usize, columns: &Range<usize>, out: &mut [f64]);

    /// Whether there is no wall in these pixels. `lines` says which rows and columns have none
    /// in any of the paper's scenes.
    fn are_absent(
        &self,
        lines: &[Vec<bool>; 2],
        rows: &Range<usize>,
        columns: &Range<usize>,
    ) -> bool;
}

impl Ground for Scene {
    type Space = FreeSpace;
    type Walls<'a> = PaperWalls<'a>;

    fn space(&self) -> FreeSpace {
        self.free_space()
    }

    #[inline]
    fn step_from(space: &FreeSpace, position: [f64; 2], action: [f64; 2]) -> [f64; 2] {
        step_within(space, position, action)
    }

    fn true_subgoals(episode: &Episode, count: usize) -> Vec<State> {
        episode.subgoals(count)
    }

    #[inline]
    fn walls_in<'a>(&'a self, renderer: &'a Renderer) -> PaperWalls<'a> {
        PaperWalls { scene: self, renderer }
    }

    fn gaps(&self) -> &[f64] {
        &self.gap_y
    }
}

/// The paper's two walls.
pub struct PaperWalls<'a> {
    scene: &'a Scene,
    renderer: &'a Renderer,
}

impl Walls for PaperWalls<'_> {
    fn draw(&self, frame: &mut [u8]) {
        self.renderer.draw_two_walls(self.scene, frame);
    }

    #[inline]
    fn at(&self, row: usize, column: usize) -> f64 {
        self.renderer.walls_at(self.scene, row, column)
    }

    #[inline]
    fn in_row(&self, row: usize, columns: &Range<usize>, out: &mut [f64]) {
        self.renderer.walls_in_row(self.scene, row, columns, out);
    }

    #[inline]
    fn are_absent(
        &self,
        [open_rows, open_columns]: &[Vec<bool>; 2],
        rows: &Range<usize>,
        columns: &Range<usize>,
    ) -> bool {
        let all = |open: &[bool], pixels: &Range<usize>| open[pixels.clone()].iter().all(|&o| o);
        all(open_rows, rows) && all(open_columns, columns)
    }
}

impl Ground for Arc<LayoutScene> {
    type Space = Arc<LayoutScene>;
    type Walls<'a> = Arc<Backdrop>;

    fn space(&self) -> Self::Space {
        Arc::clone(self)
    }

    #[inline]
    fn step_from(space: &Self::Space, position: [f64; 2], action: [f64; 2]) -> [f64; 2] {
        step_in(space.obstacles(), position, action)
    }

    fn true_subgoals(episode: &Episode<Self>, count: usize) -> Vec<State<Self>> {
        episode.subgoals(count)
    }

    fn walls_in<'a>(&'a self, renderer: &'a Renderer) -> Arc<Backdrop> {
        self.backdrop(renderer)
    }

    fn gaps(&self) -> &[f64] {
        LayoutScene::gaps(self)
    }
}

impl Walls for Arc<Backdrop> {
    fn draw(&self, frame: &mut [u8]) {
        frame.copy_from_slice(Backdrop::frame(self));
    }

    #[inline]
    fn at(&self, row: usize, column: usize) -> f64 {
        self.cover()[row * self.size() + column]
    }

    #[inline]
    fn in_row(&self, row: usize, columns: &Range<usize>, out: &mut [f64]) {
        let row = &self.cover()[row * self.size()..][columns.clone()];
        out[..row.len()].copy_from_slice(row);
    }

    #[inline]
    fn are_absent(&self, _: &[Vec<bool>; 2], rows: &Range<usize>, columns: &Range<usize>) -> bool {
        let cover = |row: usize| &self.cover()[row * self.size()..][columns.clone()];
        rows.clone().all(|row| cover(row).iter().all(|&part| part == 0.0))
    }
}
