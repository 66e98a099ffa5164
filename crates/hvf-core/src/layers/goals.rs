//! How far a drawn frame is from each of some goals.
//!
//! A frame differs from the start frame in some tiles, and so does its distance to a goal: the
//! distance of the still frame is known, and what changes is added. With a blur `G`, which is linear
//! and symmetric, `e` the still frame less the goal and `d` the change of the frame,
//! `|G (e + d)|^2 = |G e|^2 + 2 (G G e) d + |G d|^2`: the first is a number of the goal, the second
//! an image of the goal, and the third does not depend on the goal.

use multiversion::multiversion;
use rayon::prelude::*;

use super::frames::LayerFrames;
use super::painter::{Canvas, Scene};
use super::scenery::Scenery;
use super::smoother::{Scratch, Smoother};
use super::tiles::Tiles;
use crate::image::{squared_norm_f32, GaussianBlur};

/// Values that are summed at once.
const BLOCK: usize = 16;

/// A blur in both of its forms: of whole images, and of what changes in them.
#[derive(Clone, Debug)]
pub struct Blur {
    whole: GaussianBlur,
    changes: Smoother,
}

/// Goals that frames of one scene are compared with.
#[derive(Debug)]
pub struct Goals<'a> {
    tiles: Tiles,
    kind: Kind<'a>,
    /// Weight of what is behind the arm, and each goal of it.
    scenery: Option<(f64, Vec<Scenery<'a>>)>,
}

#[derive(Debug)]
enum Kind<'a> {
    Plain(Vec<Plain<'a>>),
    Blurred(&'a Blur, Vec<Blurred>),
}

#[derive(Debug)]
struct Plain<'a> {
    /// In tiles.
    bytes: &'a [u8],
    /// Squared distance of each tile of the still frame.
    still: Vec<f64>,
    /// The sum of these.
    whole: f64,
}

#[derive(Debug)]
struct Blurred {
    /// Squared distance of the still frame.
    whole: f64,
    /// What a change costs, to first order; in tiles.
    slope: Vec<f32>,
}

/// Room for comparing a frame.
#[derive(Debug)]
pub struct Comparison(Option<Room>);

#[derive(Debug)]
struct Room {
    /// The change of a frame, in tiles.
    change: Vec<f32>,
    scratch: Scratch,
}

impl Blur {
    /// `blur`, of images cut into `tiles`.
    pub fn new(blur: GaussianBlur, tiles: Tiles) -> Self {
        Self { changes: Smoother::new(&blur, tiles), whole: blur }
    }
}

impl<'a> Goals<'a> {
    /// The goals at `which` in `frames`, for candidates in `scene`; what is behind the arm counts
    /// `scene_weight` times, beside the whole.
    pub fn new(
        scene: &Scene<'_>,
        frames: &'a LayerFrames,
        which: std::ops::Range<usize>,
        tiles: Tiles,
        blur: Option<&'a Blur>,
        scene_weight: f64,
    ) -> Self {
        let which = which.into_par_iter();
        let scenery = (scene_weight > 0.0).then(|| {
            let goals = which.clone().map(|i| Scenery::new(scene, frames, i, tiles));
            (scene_weight, goals.collect())
        });
        let kind = match blur {
            None => Kind::Plain(
                which.map(|i| Plain::new(scene.still(), frames.tiles(i), tiles.values())).collect(),
            ),
            Some(blur) => Kind::Blurred(
                blur,
                which
                    .map(|i| Blurred::new(scene.still(), frames.tiles(i), &blur.whole, tiles))
                    .collect(),
            ),
        };
        Self { tiles, kind, scenery }
    }

    /// Room for comparing a frame.
    pub fn comparison(&self) -> Comparison {
        Comparison(match self.kind {
            Kind::Plain(_) => None,
            Kind::Blurred(blur, _) => Some(Room {
                change: vec![0.0; self.tiles.count() * self.tiles.values()],
                scratch: blur.changes.scratch(),
            }),
        })
    }

    /// Shows `visit(goal, cost)` how far what is on the canvas is from each goal, per pixel.
    pub fn compare(
        &self,
        scene: &Scene<'_>,
        canvas: &Canvas,
        room: &mut Comparison,
        mut visit: impl FnMut(usize, f32),
    ) {
        let pixels = self.tiles.count() * self.tiles.plane();
        let scale = 1.0 / (255.0 * 255.0 * pixels as f64);
        let mut visit = |goal: usize, sum: f64| {
            let sum = match &self.scenery {
                Some((weight, goals)) => sum + weight * goals[goal].distance(canvas, self.tiles),
                None => sum,
            };
            visit(goal, ((if sum < 0.0 { 0.0 } else { sum }) * scale) as f32)
        };
        match (&self.kind, &mut room.0) {
            (Kind::Blurred(blur, goals), Some(Room { change, scratch })) => {
                let values = self.tiles.values();
                blur.changes.begin(scratch);
                for ((tile, drawn), change) in
                    canvas.drawn(self.tiles).zip(change.chunks_exact_mut(values))
                {
                    let still = &scene.still()[tile * values..][..values];
                    for ((change, drawn), still) in change.iter_mut().zip(drawn).zip(still) {
                        *change = drawn - still;
                    }
                    blur.changes.change(tile, change, scratch);
                }
                let squares = blur.changes.squared_norm(scratch);
                for (number, goal) in goals.iter().enumerate() {
                    let linear = first_order(goal, canvas, change, self.tiles);
                    visit(number, goal.whole + linear + squares);
                }
            }
            (Kind::Plain(goals), _) => {
                for (number, goal) in goals.iter().enumerate() {
                    visit(number, goal.whole + changes(goal, canvas, self.tiles));
                }
            }
            (Kind::Blurred(..), None) => unreachable!("room for blurs is made by `comparison`"),
        }
    }
}

impl Blurred {
    fn new(still: &[f32], bytes: &[u8], blur: &GaussianBlur, tiles: Tiles) -> Self {
        let (size, values) = (tiles.image_size(), tiles.values());
        let apart: Vec<f32> =
            still.iter().zip(bytes).map(|(still, goal)| still - f32::from(*goal)).collect();
        let mut image = vec![0.0; apart.len()];
        for (tile, values) in apart.chunks_exact(values).enumerate() {
            tiles.place(tile, values, &mut image);
        }
        let mut scratch = blur.scratch(size, size, 3);
        blur.apply(&mut image, size, size, 3, &mut scratch);
        let whole = squared_norm_f32(&image);
        blur.apply(&mut image, size, size, 3, &mut scratch);
        let slope =
            tiles.cut(|row, column, colour| 2.0 * image[(row * size + column) * 3 + colour]);
        Self { whole, slope }
    }
}

impl<'a> Plain<'a> {
    fn new(still: &[f32], bytes: &'a [u8], values: usize) -> Self {
        let still: Vec<f64> = still
            .chunks_exact(values)
            .zip(bytes.chunks_exact(values))
            .map(|(still, goal)| squared_distance(still, goal))
            .collect();
        let whole = still.iter().sum();
        Self { bytes, still, whole }
    }
}

/// By how much the squared distance of what is drawn differs from that of the still frame.
#[multiversion(targets("x86_64+avx2+fma"))]
fn changes(goal: &Plain<'_>, canvas: &Canvas, tiles: Tiles) -> f64 {
    let values = tiles.values();
    let mut sums = [[0.0; BLOCK]; 2];
    let mut known = 0.0;
    for (tile, drawn) in canvas.drawn(tiles) {
        known += goal.still[tile];
        add_squares(drawn, &goal.bytes[tile * values..][..values], &mut sums);
    }
    total(&sums) - known
}

/// What `change` of the tiles on the canvas costs, to first order.
#[multiversion(targets("x86_64+avx2+fma"))]
fn first_order(goal: &Blurred, canvas: &Canvas, change: &[f32], tiles: Tiles) -> f64 {
    let values = tiles.values();
    let mut sums = [0.0; BLOCK];
    for ((tile, _), change) in canvas.drawn(tiles).zip(change.chunks_exact(values)) {
        let slope = &goal.slope[tile * values..][..values];
        let blocks = change.as_chunks::<BLOCK>().0.iter().zip(slope.as_chunks::<BLOCK>().0);
        for (change, slope) in blocks {
            for i in 0..BLOCK {
                sums[i] = change[i].mul_add(slope[i], sums[i]);
            }
        }
    }
    sums.iter().map(|&sum| f64::from(sum)).sum()
}

#[multiversion(targets("x86_64+avx2+fma"))]
fn squared_distance(drawn: &[f32], goal: &[u8]) -> f64 {
    let mut sums = [[0.0; BLOCK]; 2];
    add_squares(drawn, goal, &mut sums);
    total(&sums)
}

/// Adds squared differences to partial sums, always in the same order.
#[inline(always)]
fn add_squares(drawn: &[f32], goal: &[u8], sums: &mut [[f32; BLOCK]; 2]) {
    let [even, odd] = sums;
    let (drawn_pairs, drawn_rest) = drawn.as_chunks::<{ 2 * BLOCK }>();
    let (goal_pairs, goal_rest) = goal.as_chunks::<{ 2 * BLOCK }>();
    for (drawn, goal) in drawn_pairs.iter().zip(goal_pairs) {
        add(even, &drawn[..BLOCK], &goal[..BLOCK]);
        add(odd, &drawn[BLOCK..], &goal[BLOCK..]);
    }
    if drawn_rest.len() == BLOCK && goal_rest.len() == BLOCK {
        add(even, drawn_rest, goal_rest);
    }
}

#[inline(always)]
fn add(sums: &mut [f32; BLOCK], drawn: &[f32], goal: &[u8]) {
    for i in 0..BLOCK {
        let apart = drawn[i] - f32::from(goal[i]);
        sums[i] = apart.mul_add(apart, sums[i]);
    }
}

#[inline(always)]
fn total(sums: &[[f32; BLOCK]; 2]) -> f64 {
    sums.as_flattened().iter().map(|&sum| f64::from(sum)).sum()
}
