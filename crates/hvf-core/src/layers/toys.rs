//! Random worlds for tests.

#![allow(clippy::unwrap_used)]

use ndarray::{Array1, Array2, Array4, Array5, ArrayD};

use super::*;
use crate::image::OverHorizon;
use crate::nn::Linear;

/// Size of images, sprites; parts that roam; places of the table and of the gallery.
pub const SIZE: usize = 24;
pub const SPRITE: usize = 7;
pub const PARTS: usize = 2;
pub const STATE: usize = 3 + 2 + 3 * PARTS;
pub const BINS: [usize; 2] = [4, 3];
pub const PLACES: [usize; 3] = [3, 4, 2];

/// Numbers from a linear congruential generator.
pub struct Draws(u64);

impl Draws {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ 0x5DEE_CE66)
    }

    /// In `[0, 1)`.
    pub fn unit(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 40) as f32 / (1_u64 << 24) as f32
    }

    pub fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    pub fn byte(&mut self) -> u8 {
        (256.0 * self.unit()) as u8
    }

    /// An array of numbers in `[-scale, scale)`.
    pub fn array<D: ndarray::Dimension>(
        &mut self,
        shape: impl ndarray::ShapeBuilder<Dim = D>,
        scale: f32,
    ) -> ndarray::Array<f32, D> {
        ndarray::Array::from_shape_simple_fn(shape, || self.between(-scale, scale))
    }
}

/// Layers of a network.
pub type Layers = Vec<(Array2<f32>, Array1<f32>)>;

pub fn layers(draws: &mut Draws, sizes: &[usize]) -> Layers {
    sizes
        .windows(2)
        .map(|pair| {
            let scale = 1.5 / (pair[0] as f32).sqrt();
            (draws.array((pair[1], pair[0]), scale), draws.array(pair[1], 0.3))
        })
        .collect()
}

pub fn views(layers: &Layers) -> Vec<Linear<'_>> {
    layers.iter().map(|(weights, bias)| (weights.view(), bias.view())).collect()
}

/// A cell in which the hand moves by about a step, and parts in the middle of the image are pushed.
pub fn cell(seed: u64) -> Cell {
    let mut draws = Draws::new(seed);
    let memory = 2;
    let hand = layers(&mut draws, &[8, 6, 9, 3]);
    let sliders = [layers(&mut draws, &[11, 5, 1]), layers(&mut draws, &[11, 5, 1])];
    let parts = layers(&mut draws, &[7 + 9 + memory, 10, 7, 3 + memory]);
    let mut contact = draws.array((10, 2), 0.5);
    contact.row_mut(0).fill(SIZE as f32 / 2.0);
    Cell::new(&CellWeights {
        hand: views(&hand),
        sliders: sliders.iter().map(views).collect(),
        parts: views(&parts),
        contact: contact.view(),
        reach: 4.0,
        roaming: PARTS,
    })
    .unwrap()
}

/// A table in which the right half of images is always the same.
pub fn table(seed: u64) -> Array5<u8> {
    let mut draws = Draws::new(seed);
    let always: Vec<u8> = (0..3 * SIZE * SIZE).map(|_| draws.byte()).collect();
    Array5::from_shape_fn((BINS[0], BINS[1], 3, SIZE, SIZE), |(.., colour, row, column)| {
        if column >= SIZE / 2 {
            always[(colour * SIZE + row) * SIZE + column]
        } else {
            draws.byte()
        }
    })
}

pub fn gallery(seed: u64, tile: usize) -> Gallery {
    gallery_of(gallery_images(seed, tile))
}

fn gallery_of((patches, index): (Array4<u8>, Array2<i32>)) -> Gallery {
    let images = GalleryImages {
        low: [-1.0, -0.8, -1.2],
        step: [1.1, 0.7, 2.0],
        places: PLACES,
        patches: patches.view(),
        index: index.view(),
    };
    Gallery::new(&images, SIZE).unwrap()
}

/// Patches, and where they are: two thirds of all tiles are empty.
pub fn gallery_images(seed: u64, tile: usize) -> (Array4<u8>, Array2<i32>) {
    let mut draws = Draws::new(seed);
    let count = 20;
    let mut patches = Array4::from_shape_simple_fn((count, 4, tile, tile), || draws.byte());
    patches.index_axis_mut(ndarray::Axis(0), 0).fill(0);
    let places = PLACES.iter().product();
    let index = Array2::from_shape_simple_fn((places, (SIZE / tile).pow(2)), || {
        (draws.between(-2.0, 1.0) * count as f32).max(0.0) as i32
    });
    (patches, index)
}

pub fn sprites(seed: u64) -> Sprites {
    Sprites::new(sprite_images(seed).view()).unwrap()
}

pub fn sprite_images(seed: u64) -> Array4<f32> {
    let mut draws = Draws::new(seed);
    Array4::from_shape_simple_fn((PARTS, 4, SPRITE, SPRITE), || draws.unit())
}

pub fn painter(seed: u64, tile: usize) -> Painter {
    painter_with(gallery(seed, tile), seed)
}

fn painter_with(gallery: Gallery, seed: u64) -> Painter {
    let backdrop = Backdrop::new(table(seed).view(), gallery.tiles()).unwrap();
    Painter::new(backdrop, sprites(seed), gallery).unwrap()
}

/// [`world`] with an arm that nobody sees.
pub fn world_without_arm(seed: u64, tile: usize) -> LayerWorld {
    let (mut patches, index) = gallery_images(seed, tile);
    patches.fill(0);
    let painter = painter_with(gallery_of((patches, index)), seed);
    LayerWorld::new(cell(seed), painter, 0.0, OverHorizon::Last).unwrap()
}

pub fn world(seed: u64, tile: usize, blur: f64, over_horizon: OverHorizon) -> LayerWorld {
    LayerWorld::new(cell(seed), painter(seed, tile), blur, over_horizon).unwrap()
}

pub fn state(draws: &mut Draws) -> Vec<f32> {
    let mut state: Vec<f32> = (0..3).map(|_| draws.between(-1.5, 1.5)).collect();
    // Sliders are often at an end.
    state.extend((0..2).map(|_| draws.between(-0.5, 1.5).clamp(0.0, 1.0)));
    for _ in 0..PARTS {
        state.extend((0..2).map(|_| draws.between(0.0, SIZE as f32)));
        state.push(draws.unit().round());
    }
    state
}

pub fn frames(world: &LayerWorld, count: usize, seed: u64) -> LayerFrames {
    let mut draws = Draws::new(seed);
    frames_at(world, &(0..count).map(|_| state(&mut draws)).collect::<Vec<_>>(), seed)
}

pub fn frames_at(world: &LayerWorld, states: &[Vec<f32>], seed: u64) -> LayerFrames {
    let (mut draws, count) = (Draws::new(seed), states.len());
    let images = Array4::from_shape_simple_fn((count, SIZE, SIZE, 3), || draws.byte());
    let clean = Array4::from_shape_simple_fn((count, SIZE, SIZE, 3), || draws.unit());
    let shape = (count, PARTS, SIZE, SIZE);
    let regions = Array4::from_shape_simple_fn(shape, || draws.unit() < 0.05);
    let states = Array2::from_shape_vec((count, STATE), states.concat()).unwrap();
    world.frames(images.view(), clean.view(), regions.view(), states.view()).unwrap()
}

pub fn actions(shape: &[usize], seed: u64) -> ArrayD<f32> {
    Draws::new(seed).array(shape, 1.2)
}
