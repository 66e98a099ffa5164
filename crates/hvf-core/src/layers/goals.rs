//! How far a drawn frame is from each of some goals.
//!
//! A frame differs from the start frame in some tiles, and so does its distance to a goal: the
//! distance of the still frame is known, and what changes is added. Blurred, the same holds for
//! images: a blur is linear, so the change is blurred and the rest is known.

use multiversion::multiversion;

use super::frames::LayerFrames;
use super::painter::{Canvas, Scene};
use super::tiles::{Tiles, BLOCK};
use crate::image::{squared_norm_f32, BlurScratch, GaussianBlur};

/// Goals that frames of one scene are compared with.
#[derive(Debug)]
pub struct Goals<'a> {
    tiles: Tiles,
    kind: Kind<'a>,
}

#[derive(Debug)]
enum Kind<'a> {
    Plain(Vec<Plain<'a>>),
    /// The blurred still frame less each blurred goal, in planes.
    Blurred(&'a GaussianBlur, Vec<Vec<f32>>),
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

/// Room for comparing a frame.
#[derive(Debug)]
pub struct Comparison {
    /// The change of a frame, in planes, and what is compared.
    change: Vec<f32>,
    apart: Vec<f32>,
    blur: Option<BlurScratch>,
}

impl<'a> Goals<'a> {
    /// The goals at `which` in `frames`, for candidates in `scene`.
    pub fn new(
        scene: &Scene<'_>,
        frames: &'a LayerFrames,
        which: impl Iterator<Item = usize>,
        tiles: Tiles,
        blur: Option<&'a GaussianBlur>,
    ) -> Self {
        let kind = match blur {
            None => Kind::Plain(
                which.map(|i| Plain::new(scene.still(), frames.tiles(i), tiles.values())).collect(),
            ),
            Some(blur) => {
                let apart = |i: usize| {
                    let apart: Vec<f32> = scene
                        .still()
                        .iter()
                        .zip(frames.tiles(i))
                        .map(|(still, goal)| still - f32::from(*goal))
                        .collect();
                    let mut planes = vec![0.0; apart.len()];
                    for (tile, values) in apart.chunks_exact(tiles.values()).enumerate() {
                        tiles.place_planes(tile, values, &mut planes);
                    }
                    blur_planes(blur, &mut planes, tiles, &mut scratch(blur, tiles));
                    planes
                };
                Kind::Blurred(blur, which.map(apart).collect())
            }
        };
        Self { tiles, kind }
    }

    /// Room for comparing a frame.
    pub fn comparison(&self) -> Comparison {
        match self.kind {
            Kind::Plain(_) => Comparison { change: vec![], apart: vec![], blur: None },
            Kind::Blurred(blur, _) => {
                let length = self.tiles.count() * self.tiles.values();
                Comparison {
                    change: vec![0.0; length],
                    apart: vec![0.0; length],
                    blur: Some(scratch(blur, self.tiles)),
                }
            }
        }
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
        let mut visit = |goal: usize, sum: f64| visit(goal, (sum.max(0.0) * scale) as f32);
        match &self.kind {
            Kind::Plain(goals) => {
                for (number, goal) in goals.iter().enumerate() {
                    visit(number, goal.whole + changes(goal, canvas, self.tiles));
                }
            }
            Kind::Blurred(blur, goals) => {
                let values = self.tiles.values();
                let Comparison { change, apart, blur: scratch } = room;
                let Some(scratch) = scratch else { return };
                change.fill(0.0);
                for (tile, drawn) in canvas.drawn(self.tiles) {
                    let still = &scene.still()[tile * values..][..values];
                    let apart = &mut apart[..values];
                    for ((apart, drawn), still) in apart.iter_mut().zip(drawn).zip(still) {
                        *apart = drawn - still;
                    }
                    self.tiles.place_planes(tile, apart, change);
                }
                blur_planes(blur, change, self.tiles, scratch);
                for (number, goal) in goals.iter().enumerate() {
                    for ((apart, change), goal) in apart.iter_mut().zip(&*change).zip(goal) {
                        *apart = change + goal;
                    }
                    visit(number, squared_norm_f32(apart));
                }
            }
        }
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

fn scratch(blur: &GaussianBlur, tiles: Tiles) -> BlurScratch {
    blur.scratch(tiles.image_size(), tiles.image_size(), 1)
}

/// Blurs an image in planes, `[3][S, S]`.
fn blur_planes(blur: &GaussianBlur, planes: &mut [f32], tiles: Tiles, scratch: &mut BlurScratch) {
    let size = tiles.image_size();
    for plane in planes.chunks_exact_mut(size * size) {
        blur.apply(plane, size, size, 1, scratch);
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
