//! A predicted frame: the start frame without its arm, changed, with the arm before it.
//!
//! The twin of `hvf.models.layers.perception.LayerPerception.draw`. What is drawn are the tiles of
//! the start frame that change, about a third of them: where the backdrop's images differ, where a
//! part was or is that moved, and where the arm is.

use multiversion::multiversion;

use super::backdrop::{Backdrop, Corners};
use super::cell::SLIDERS;
use super::gallery::{Around, Gallery, DIMENSIONS};
use super::sprites::{Sprites, Stamp};
use super::tiles::Tiles;
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

/// A start frame.
#[derive(Clone, Copy, Debug)]
pub struct Start<'a> {
    /// The frame without its arm, in tiles, from 0 to 255.
    pub clean: &'a [f32],
    /// Where each part is in it, 0 or 1: `[R][tiles][T * T]`.
    pub regions: &'a [u8],
    /// The frame's state, `[X]`.
    pub state: &'a [f32],
}

/// A start frame, ready to be changed.
#[derive(Clone, Debug)]
pub struct Scene<'a> {
    start: Start<'a>,
    /// The frame without its arm, in the colours of a screen.
    still: Vec<f32>,
    /// The frame without arm and backdrop.
    residual: Vec<f32>,
    corners: Corners,
    /// Whether a part is in a tile: `[R][tiles]`.
    inhabited: Vec<bool>,
}

/// Room for drawing a candidate, and what is drawn of it.
#[derive(Clone, Debug)]
pub struct Canvas {
    around: Around,
    before: Corners,
    corners: Corners,
    /// Number and stamp of parts that moved.
    moved: Vec<usize>,
    stamps: Vec<Stamp>,
    /// Where the backdrop, a part, or the arm has to be drawn.
    slid: Vec<bool>,
    pushed: Vec<bool>,
    armed: Vec<u64>,
    behind: Vec<f32>,
    backdrop: Vec<f32>,
    arm: Vec<f32>,
    /// Numbers of tiles that differ from the still frame.
    drawn: Vec<usize>,
    /// These tiles, `[drawn][3][T * T]`.
    values: Vec<f32>,
    /// Numbers of tiles that differ from the still frame without the arm, too.
    changed: Vec<usize>,
    /// These tiles without the arm, `[changed][3][T * T]`; no room where nobody asks for them.
    changes: Vec<f32>,
}

impl Scene<'_> {
    /// The start frame without its arm, in tiles, from 0 to 255.
    pub fn still(&self) -> &[f32] {
        &self.still
    }

    /// The start frame's state, `[X]`.
    pub fn state(&self) -> &[f32] {
        self.start.state
    }
}

impl Canvas {
    /// Tiles that differ from the still frame, with what is in them: `[3][T * T]`, 0 to 255.
    #[inline(always)]
    pub fn drawn(&self, tiles: Tiles) -> impl Iterator<Item = (usize, &[f32])> {
        self.drawn.iter().copied().zip(self.values.chunks_exact(tiles.values()))
    }

    /// Tiles in which something moved behind the arm, without it: `[3][T * T]`, 0 to 255.
    #[inline(always)]
    pub fn behind(&self, tiles: Tiles) -> impl Iterator<Item = (usize, &[f32])> {
        self.changed.iter().copied().zip(self.changes.chunks_exact(tiles.values()))
    }
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

    /// Makes a start frame ready.
    pub fn scene<'a>(&self, start: Start<'a>) -> Scene<'a> {
        let corners = self.backdrop.corners(&start.state[DIMENSIONS..][..SLIDERS]);
        let mut residual = start.clean.to_vec();
        take_away(&self.backdrop, &corners, &mut residual);
        Scene {
            start,
            still: start.clean.iter().map(|value| value.clamp(0.0, 255.0)).collect(),
            residual,
            corners,
            inhabited: start
                .regions
                .chunks_exact(self.tiles.plane())
                .map(|region| region.iter().any(|&inside| inside != 0))
                .collect(),
        }
    }

    /// Room for drawing; `behind` to keep what moved behind the arm, too ([`Canvas::behind`]).
    pub fn canvas(&self, behind: bool) -> Canvas {
        let (count, values) = (self.tiles.count(), self.tiles.values());
        Canvas {
            around: Around::default(),
            before: Corners::default(),
            corners: Corners::default(),
            moved: Vec::with_capacity(self.roaming()),
            stamps: vec![self.sprites.stamp(self.tiles); self.roaming()],
            slid: vec![false; count],
            pushed: vec![false; count],
            armed: vec![0; self.tiles.words()],
            behind: vec![0.0; values],
            backdrop: vec![0.0; values],
            arm: vec![0.0; 4 * self.tiles.plane()],
            drawn: Vec::with_capacity(count),
            values: vec![0.0; count * values],
            changed: Vec::with_capacity(count),
            changes: vec![0.0; if behind { count * values } else { 0 }],
        }
    }

    /// Draws what `scene` looks like at `state[X]`.
    pub fn paint(&self, scene: &Scene<'_>, state: &[f32], canvas: &mut Canvas) {
        paint(self, scene, state, canvas);
    }

    /// Finds what moved.
    #[inline(always)]
    fn find(&self, scene: &Scene<'_>, state: &[f32], canvas: &mut Canvas) {
        let tiles = self.tiles;
        canvas.around = self.gallery.around([state[0], state[1], state[2]]);
        canvas.armed.fill(0);
        self.gallery.occupied(&canvas.around, &mut canvas.armed);
        let corners = self.backdrop.corners(&state[DIMENSIONS..][..SLIDERS]);
        // Sliders seldom go far: often the candidate before had the same images.
        if !(corners.are_those_of(&canvas.corners) && scene.corners.are_those_of(&canvas.before)) {
            self.backdrop.compare(&scene.corners, &corners, &mut canvas.slid);
        }
        (canvas.before, canvas.corners) = (scene.corners, corners);
        canvas.moved.clear();
        canvas.pushed.fill(false);
        let first = DIMENSIONS + SLIDERS;
        let parts = state[first..].chunks_exact(3).zip(scene.start.state[first..].chunks_exact(3));
        for (part, (now, before)) in parts.enumerate() {
            let way = [now[0] - before[0], now[1] - before[1]];
            let far = (way[0] * way[0] + way[1] * way[1]).sqrt() > MOVED;
            if !far && (now[2] - before[2]).abs() <= APPEARED {
                continue;
            }
            let stamp = &mut canvas.stamps[canvas.moved.len()];
            self.sprites.read(part, [now[0], now[1]], now[2], stamp);
            let inhabited = &scene.inhabited[part * tiles.count()..][..tiles.count()];
            for (tile, (pushed, inhabited)) in canvas.pushed.iter_mut().zip(inhabited).enumerate() {
                *pushed |= *inhabited || stamp.touches(tiles, tile);
            }
            canvas.moved.push(part);
        }
    }

    /// What is behind the arm where parts moved.
    #[inline(always)]
    fn push(&self, scene: &Scene<'_>, tile: usize, canvas: &mut Canvas) {
        let (tiles, plane) = (self.tiles, self.tiles.plane());
        for &part in &canvas.moved {
            if !scene.inhabited[part * tiles.count() + tile] {
                continue;
            }
            let region = &scene.start.regions[(part * tiles.count() + tile) * plane..][..plane];
            let colours = canvas.behind.chunks_exact_mut(plane);
            for (behind, backdrop) in colours.zip(canvas.backdrop.chunks_exact(plane)) {
                for ((behind, backdrop), inside) in behind.iter_mut().zip(backdrop).zip(region) {
                    *behind = if *inside != 0 { *backdrop } else { *behind };
                }
            }
        }
        for stamp in &canvas.stamps[..canvas.moved.len()] {
            stamp.paste(tiles, tile, &mut canvas.behind);
        }
    }
}

/// Subtracts a backdrop from an image.
#[multiversion(targets("x86_64+avx2+fma"))]
fn take_away(backdrop: &Backdrop, corners: &Corners, image: &mut [f32]) {
    let mut drawn = vec![0.0; backdrop.tiles().values()];
    for (tile, image) in image.chunks_exact_mut(drawn.len()).enumerate() {
        backdrop.draw(corners, tile, &mut drawn);
        for (value, drawn) in image.iter_mut().zip(&drawn) {
            *value -= drawn;
        }
    }
}

#[multiversion(targets("x86_64+avx2+fma"))]
fn paint(painter: &Painter, scene: &Scene<'_>, state: &[f32], canvas: &mut Canvas) {
    let values = painter.tiles.values();
    painter.find(scene, state, canvas);
    canvas.drawn.clear();
    canvas.changed.clear();
    for tile in 0..painter.tiles.count() {
        let (slid, pushed) = (canvas.slid[tile], canvas.pushed[tile]);
        let armed = canvas.armed[tile / 64] >> (tile % 64) & 1 != 0;
        if !(slid || pushed || armed) {
            continue;
        }
        if slid || pushed {
            painter.backdrop.draw(&canvas.corners, tile, &mut canvas.backdrop);
            let residual = &scene.residual[tile * values..][..values];
            for ((behind, residual), backdrop) in
                canvas.behind.iter_mut().zip(residual).zip(&canvas.backdrop)
            {
                *behind = residual + backdrop;
            }
        }
        if pushed {
            painter.push(scene, tile, canvas);
        }
        if (slid || pushed) && !canvas.changes.is_empty() {
            let changes = &mut canvas.changes[canvas.changed.len() * values..][..values];
            for (change, behind) in changes.iter_mut().zip(&canvas.behind) {
                *change = behind.clamp(0.0, 255.0);
            }
            canvas.changed.push(tile);
        }
        let out = &mut canvas.values[canvas.drawn.len() * values..][..values];
        let behind = if slid || pushed {
            &canvas.behind
        } else {
            &scene.start.clean[tile * values..][..values]
        };
        if armed {
            painter.gallery.draw(&canvas.around, tile, behind, &mut canvas.arm, out);
        } else {
            for (out, behind) in out.iter_mut().zip(behind) {
                *out = behind.clamp(0.0, 255.0);
            }
        }
        canvas.drawn.push(tile);
    }
}
