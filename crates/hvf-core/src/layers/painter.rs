//! A predicted frame: the start frame without its arm, changed, with the arm before it.
//!
//! The twin of `hvf.models.desk.perception.DeskPerception.draw`. Frames are drawn tile by tile, a
//! block of candidates at a time.

use multiversion::multiversion;

use super::backdrop::{Backdrop, Corners};
use super::cell::SLIDERS;
use super::gallery::{Around, Gallery, DIMENSIONS};
use super::sprites::Sprites;
use super::tiles::Tiles;
use crate::lanes::{Lanes, LANES};
use crate::{Error, Result};

/// Pixels by which a part has to move for its image to be drawn anew.
const MOVED: f32 = 0.5;
/// Change of its presence for the same.
const APPEARED: f32 = 0.5;

/// Everything that is needed to draw.
#[derive(Clone, Debug)]
pub struct Painter {
    tiles: Tiles,
    backdrop: Backdrop,
    sprites: Sprites,
    gallery: Gallery,
}

/// A start frame, ready to be changed.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// The frame without its arm, in tiles, in [0, 1].
    pub clean: &'a [f32],
    /// Where each part is in it, 0 or 1: `[R][tiles][T * T]`.
    pub regions: &'a [u8],
    /// The frame's state, `[X]`.
    pub state: &'a [f32],
}

/// One candidate's frame, but for the arm.
#[derive(Clone, Debug)]
struct Change {
    around: Around,
    corners: Corners,
    /// Number, (row, column) and presence of parts that moved.
    moved: Vec<(usize, [f32; 2], f32)>,
}

/// Room for drawing candidates.
#[derive(Clone, Debug)]
pub struct Canvas {
    changes: Vec<Change>,
    arm: Vec<f32>,
    behind: Vec<f32>,
    backdrop: Vec<f32>,
    /// The last tile, for each candidate: `[candidates][3][T * T]`.
    tile: Vec<f32>,
}

impl Painter {
    /// Puts the layers together.
    ///
    /// # Errors
    /// Layers of different sizes.
    pub fn new(backdrop: Backdrop, sprites: Sprites, gallery: Gallery) -> Result<Self> {
        if backdrop.tiles() != gallery.tiles() {
            return Err(Error::invalid("table", "expected images of the arm's size"));
        }
        Ok(Self { tiles: gallery.tiles(), backdrop, sprites, gallery })
    }

    /// How images are cut.
    pub fn tiles(&self) -> Tiles {
        self.tiles
    }

    /// Parts that roam, `R`.
    pub fn roaming(&self) -> usize {
        self.sprites.count()
    }

    /// Length of a state, `X`.
    pub fn state_size(&self) -> usize {
        DIMENSIONS + SLIDERS + 3 * self.sprites.count()
    }

    /// Room for up to `blocks` blocks of candidates.
    pub fn canvas(&self, blocks: usize) -> Canvas {
        let values = 3 * self.tiles.plane();
        Canvas {
            changes: Vec::with_capacity(blocks * LANES),
            arm: vec![0.0; 4 * self.tiles.plane()],
            behind: vec![0.0; values],
            backdrop: vec![0.0; values],
            tile: vec![0.0; blocks * LANES * values],
        }
    }

    /// Draws what `scene` looks like at the first `count` of `states[blocks][X]`, tile by tile, and
    /// shows `visit(tile, frames[count][3][T * T])` each.
    pub fn paint(
        &self,
        scene: Scene<'_>,
        states: &[Vec<Lanes>],
        count: usize,
        canvas: &mut Canvas,
        mut visit: impl FnMut(usize, &[f32]),
    ) {
        canvas.changes.clear();
        canvas
            .changes
            .extend((0..count).map(|candidate| {
                self.change(scene, &states[candidate / LANES], candidate % LANES)
            }));
        for tile in 0..self.tiles.count() {
            paint_tile(self, scene, tile, canvas);
            visit(tile, &canvas.tile[..count * 3 * self.tiles.plane()]);
        }
    }

    fn change(&self, scene: Scene<'_>, state: &[Lanes], lane: usize) -> Change {
        let first = DIMENSIONS + SLIDERS;
        let sliders: [f32; SLIDERS] = std::array::from_fn(|i| state[DIMENSIONS + i][lane]);
        let part = |part: usize| {
            let at: [f32; 3] = std::array::from_fn(|i| state[first + 3 * part + i][lane]);
            let was = &scene.state[first + 3 * part..][..3];
            let way = [at[0] - was[0], at[1] - was[1]];
            let moved = (way[0] * way[0] + way[1] * way[1]).sqrt() > MOVED
                || (at[2] - was[2]).abs() > APPEARED;
            moved.then_some((part, [at[0], at[1]], at[2]))
        };
        Change {
            around: self.gallery.around(std::array::from_fn(|i| state[i][lane])),
            corners: self.backdrop.corners(&sliders),
            moved: (0..self.sprites.count()).filter_map(part).collect(),
        }
    }
}

#[multiversion(targets("x86_64+avx2+fma"))]
fn paint_tile(painter: &Painter, scene: Scene<'_>, tile: usize, canvas: &mut Canvas) {
    let Painter { tiles, backdrop, sprites, gallery } = painter;
    let plane = tiles.plane();
    let values = 3 * plane;
    let clean = &scene.clean[tile * values..][..values];
    let before = backdrop.corners(&scene.state[DIMENSIONS..][..SLIDERS]);
    let mut still = vec![0.0; values];
    backdrop.draw(&before, tile, &mut still);
    for (change, out) in canvas.changes.iter().zip(canvas.tile.chunks_exact_mut(values)) {
        backdrop.draw(&change.corners, tile, &mut canvas.backdrop);
        for (((out, clean), after), before) in
            canvas.behind.iter_mut().zip(clean).zip(&canvas.backdrop).zip(&still)
        {
            *out = clean + after - before;
        }
        for (part, ..) in &change.moved {
            let region = &scene.regions[(part * tiles.count() + tile) * plane..][..plane];
            for (behind, backdrop) in
                canvas.behind.chunks_exact_mut(plane).zip(canvas.backdrop.chunks_exact(plane))
            {
                for ((behind, backdrop), inside) in behind.iter_mut().zip(backdrop).zip(region) {
                    *behind = if *inside != 0 { *backdrop } else { *behind };
                }
            }
        }
        for &(part, at, presence) in &change.moved {
            if sprites.touches(at, *tiles, tile) {
                sprites.paste(part, at, presence, *tiles, tile, &mut canvas.behind);
            }
        }
        if !gallery.draw(&change.around, tile, &mut canvas.arm) {
            for (out, behind) in out.iter_mut().zip(&canvas.behind) {
                *out = behind.clamp(0.0, 1.0);
            }
            continue;
        }
        let (opacity, colours) = canvas.arm.split_at(plane);
        for ((out, behind), colour) in out
            .chunks_exact_mut(plane)
            .zip(canvas.behind.chunks_exact(plane))
            .zip(colours.chunks_exact(plane))
        {
            for (((out, behind), colour), opacity) in
                out.iter_mut().zip(behind).zip(colour).zip(opacity)
            {
                *out = behind.mul_add(1.0 - opacity, *colour).clamp(0.0, 1.0);
            }
        }
    }
}
