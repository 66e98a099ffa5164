//! How far what is behind the arm is from what is behind it in a goal.
//!
//! In the distance of whole images a pushed part weighs less than an arm a few pixels off. Here the
//! arm does not count: predicted frames are compared without theirs, where the goal's does not hide
//! what is behind it.

use multiversion::multiversion;

use super::frames::LayerFrames;
use super::painter::{Canvas, Scene};
use super::tiles::Tiles;

/// Values that are summed at once; a tile has a multiple of them.
const BLOCK: usize = 16;
/// By how much, of 255, a goal with its arm differs from the goal without where that hides it.
const HIDDEN: f32 = 8.0;

/// What is behind the arm in a goal.
#[derive(Debug)]
pub struct Scenery<'a> {
    /// The goal without its arm, in tiles, from 0 to 255.
    clean: &'a [f32],
    /// 1 where it is seen, 0 where the arm hides it, in tiles.
    seen: Vec<f32>,
    /// Squared distance of each tile of the still frame.
    still: Vec<f64>,
    /// The sum of these.
    whole: f64,
}

impl<'a> Scenery<'a> {
    /// That of goal `i` in `frames`, for candidates in `scene`.
    pub fn new(scene: &Scene<'_>, frames: &'a LayerFrames, i: usize, tiles: Tiles) -> Self {
        let (clean, values) = (frames.start(i).clean, tiles.values());
        let seen = seen(clean, frames.tiles(i), tiles);
        let still: Vec<f64> = scene
            .still()
            .chunks_exact(values)
            .zip(clean.chunks_exact(values))
            .zip(seen.chunks_exact(values))
            .map(|((still, clean), seen)| squared_distance(still, clean, seen))
            .collect();
        let whole = still.iter().sum();
        Self { clean, seen, still, whole }
    }

    /// Squared distance of what is on the canvas behind the arm.
    pub fn distance(&self, canvas: &Canvas, tiles: Tiles) -> f64 {
        let values = tiles.values();
        let mut sum = self.whole;
        for (tile, behind) in canvas.behind(tiles) {
            let (clean, seen) =
                (&self.clean[tile * values..][..values], &self.seen[tile * values..][..values]);
            sum += squared_distance(behind, clean, seen) - self.still[tile];
        }
        sum.max(0.0)
    }
}

/// Where an image is the same with its arm as without: 1, elsewhere 0, in tiles.
fn seen(clean: &[f32], image: &[u8], tiles: Tiles) -> Vec<f32> {
    let (values, plane) = (tiles.values(), tiles.plane());
    let mut seen = vec![0.0; clean.len()];
    let both = clean.chunks_exact(values).zip(image.chunks_exact(values));
    for (seen, (clean, image)) in seen.chunks_exact_mut(values).zip(both) {
        for pixel in 0..plane {
            let differs =
                |at: usize| (clean[at].clamp(0.0, 255.0) - f32::from(image[at])).abs() > HIDDEN;
            let colours = [pixel, plane + pixel, 2 * plane + pixel];
            if !colours.into_iter().any(differs) {
                colours.into_iter().for_each(|at| seen[at] = 1.0);
            }
        }
    }
    seen
}

#[multiversion(targets("x86_64+avx2+fma"))]
fn squared_distance(drawn: &[f32], clean: &[f32], seen: &[f32]) -> f64 {
    let mut sums = [0.0_f32; BLOCK];
    let goal = clean.as_chunks::<BLOCK>().0.iter().zip(seen.as_chunks::<BLOCK>().0);
    for (drawn, (clean, seen)) in drawn.as_chunks::<BLOCK>().0.iter().zip(goal) {
        for i in 0..BLOCK {
            let apart = (drawn[i] - clean[i].clamp(0.0, 255.0)) * seen[i];
            sums[i] = apart.mul_add(apart, sums[i]);
        }
    }
    sums.iter().map(|&sum| f64::from(sum)).sum()
}
