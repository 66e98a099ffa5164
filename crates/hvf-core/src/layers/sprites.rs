//! The images of the parts that roam, pasted at any place.
//!
//! The twin of `hvf.models.layers.perception.LayerPerception.paste`: sprites are read bilinearly,
//! and are nothing outside.

use ndarray::ArrayView4;

use super::tiles::Tiles;
use crate::{Error, Result};

/// Opacity, then colours.
const CHANNELS: usize = 4;

/// Opacity, and colour times opacity, of each part.
#[derive(Clone, Debug)]
pub struct Sprites {
    width: usize,
    count: usize,
    /// `[R][4][W + 2][W + 2]`, with a border of zeros; colours from 0 to 255.
    images: Vec<f32>,
}

/// A part at a place between pixels, read at whole pixels, with room around it.
#[derive(Clone, Debug)]
pub struct Stamp {
    /// Row and column of its first pixel in the frame.
    corner: [i64; 2],
    /// Pixels on each side that are not empty: W + 1.
    inside: usize,
    /// Empty pixels around them: a tile's.
    margin: usize,
    /// `[4][rows][rows]` with `rows = inside + 2 margin`.
    values: Vec<f32>,
}

impl Sprites {
    /// From `images[R, 4, W, W]`, `W` odd.
    ///
    /// # Errors
    /// No sprite, another shape, or numbers that are not finite.
    pub fn new(images: ArrayView4<'_, f32>) -> Result<Self> {
        let (count, channels, height, width) = images.dim();
        if count == 0 || channels != CHANNELS || height != width || width % 2 == 0 {
            return Err(Error::invalid(
                "sprites",
                format!("expected shape [R, 4, W, W] with W odd, got {:?}", images.shape()),
            ));
        }
        if images.iter().any(|x| !x.is_finite()) {
            return Err(Error::invalid("sprites", "must be finite"));
        }
        let side = width + 2;
        let mut padded = vec![0.0; count * CHANNELS * side * side];
        for ((part, channel, row, column), &value) in images.indexed_iter() {
            let scale = if channel == 0 { 1.0 } else { 255.0 };
            let at = ((part * CHANNELS + channel) * side + row + 1) * side + column + 1;
            padded[at] = scale * value;
        }
        Ok(Self { width, count, images: padded })
    }

    /// Number of sprites, `R`.
    pub fn count(&self) -> usize {
        self.count
    }

    /// A stamp of nothing.
    pub fn stamp(&self, tiles: Tiles) -> Stamp {
        let (inside, margin) = (self.width + 1, tiles.tile_size());
        let rows = inside + 2 * margin;
        Stamp { corner: [0; 2], inside, margin, values: vec![0.0; CHANNELS * rows * rows] }
    }

    /// Makes `stamp` that of `part`, `presence` of it, at (row, column).
    #[inline(always)]
    pub fn read(&self, part: usize, at: [f32; 2], presence: f32, stamp: &mut Stamp) {
        let side = self.width + 2;
        // The last whole pixel that lies outside the sprite, and how far the sprite is beyond.
        let outside = at.map(|x| (x - (self.width / 2 + 1) as f32).floor());
        let beyond = [0, 1].map(|axis| at[axis] - (self.width / 2 + 1) as f32 - outside[axis]);
        // However far away: it is beyond all images.
        stamp.corner = outside.map(|x| x.clamp(-1e9, 1e9) as i64 + 1);
        // Pixel `corner + i` reads the sprite at `i + 1 - beyond` of its padded rows.
        let (down, right) = (1.0 - beyond[0], 1.0 - beyond[1]);
        let weights = [
            presence * (1.0 - down) * (1.0 - right),
            presence * (1.0 - down) * right,
            presence * down * (1.0 - right),
            presence * down * right,
        ];
        let rows = stamp.inside + 2 * stamp.margin;
        for channel in 0..CHANNELS {
            let image = &self.images[(part * CHANNELS + channel) * side * side..][..side * side];
            for y in 0..stamp.inside {
                let first = (channel * rows + stamp.margin + y) * rows + stamp.margin;
                let out = &mut stamp.values[first..][..stamp.inside];
                let upper = &image[y * side..][..side];
                let lower = &image[(y + 1) * side..][..side];
                for (x, out) in out.iter_mut().enumerate() {
                    let above = weights[1].mul_add(upper[x + 1], weights[0] * upper[x]);
                    let below = weights[3].mul_add(lower[x + 1], weights[2] * lower[x]);
                    *out = above + below;
                }
            }
        }
    }
}

impl Stamp {
    /// Where a tile begins in the stamp, if they have pixels in common.
    #[inline(always)]
    fn offset(&self, tiles: Tiles, tile: usize) -> Option<[usize; 2]> {
        let corner = tiles.corner(tile);
        let mut offset = [0; 2];
        for axis in 0..2 {
            let from = corner[axis] as i64 - (self.corner[axis] - self.margin as i64);
            offset[axis] = usize::try_from(from).ok()?;
            // The tile above or left of the first pixel, or beyond the last, has none in common.
            if offset[axis] == 0 || offset[axis] >= self.margin + self.inside {
                return None;
            }
        }
        Some(offset)
    }

    /// Whether a tile has pixels in common with the stamp.
    #[inline(always)]
    pub fn touches(&self, tiles: Tiles, tile: usize) -> bool {
        self.offset(tiles, tile).is_some()
    }

    /// Pastes the stamp onto a tile of an image, `[3][T * T]`.
    #[inline(always)]
    pub fn paste(&self, tiles: Tiles, tile: usize, image: &mut [f32]) {
        let Some([top, left]) = self.offset(tiles, tile) else { return };
        let (size, plane) = (tiles.tile_size(), tiles.plane());
        let rows = self.inside + 2 * self.margin;
        for y in 0..size {
            let row =
                |channel: usize| &self.values[(channel * rows + top + y) * rows + left..][..size];
            let opacity = row(0);
            for colour in 0..3 {
                let out = &mut image[colour * plane + y * size..][..size];
                for ((out, opacity), drawn) in out.iter_mut().zip(opacity).zip(row(1 + colour)) {
                    *out = out.mul_add(1.0 - opacity, *drawn);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use proptest::prelude::*;

    use super::super::toys::{sprite_images, Draws, SIZE, SPRITE};
    use super::*;

    proptest! {
        #[test]
        fn pasted_sprites_are_read_bilinearly(
            seed in 0_u64..100,
            at in prop::array::uniform2(-12.0_f32..36.0),
            whole in any::<bool>(),
            presence in 0.0_f32..=1.0,
        ) {
            let at = if whole { at.map(f32::round) } else { at };
            let images = sprite_images(seed);
            let sprites = Sprites::new(images.view()).unwrap();
            let tiles = Tiles::new(SIZE, 8).unwrap();
            let mut draws = Draws::new(seed);
            let before = tiles.cut(|_, _, _| 255.0 * draws.unit());
            let mut after = before.clone();
            let mut stamp = sprites.stamp(tiles);
            // What was in the stamp before does not matter.
            sprites.read(0, [5.3, 2.1], 1.0, &mut stamp);
            sprites.read(1, at, presence, &mut stamp);
            for (tile, image) in after.chunks_exact_mut(tiles.values()).enumerate() {
                let untouched = image.to_vec();
                stamp.paste(tiles, tile, image);
                prop_assert!(stamp.touches(tiles, tile) || image == untouched);
            }
            let share = |pixel: usize, axis: usize, i: usize| {
                let place = at[axis] + i as f32 - (SPRITE / 2) as f32;
                (1.0 - (pixel as f32 - place).abs()).max(0.0)
            };
            let read = |channel: usize, row: usize, column: usize| {
                let mut sum = 0.0;
                for i in 0..SPRITE {
                    for j in 0..SPRITE {
                        sum += share(row, 0, i) * share(column, 1, j) * images[[1, channel, i, j]];
                    }
                }
                presence * sum
            };
            let mut values = before.iter();
            let expected = tiles.cut(|row, column, colour| {
                let behind = values.next().unwrap();
                behind * (1.0 - read(0, row, column)) + 255.0 * read(1 + colour, row, column)
            });
            for (found, expected) in after.iter().zip(&expected) {
                prop_assert!((found - expected).abs() < 1e-2, "{found}, not {expected}");
            }
        }
    }

    #[test]
    fn a_part_however_far_away_touches_nothing() {
        let tiles = Tiles::new(SIZE, 8).unwrap();
        let sprites = Sprites::new(sprite_images(1).view()).unwrap();
        let mut stamp = sprites.stamp(tiles);
        for far in [-20.0, 50.0, 1e12, -1e30, f32::INFINITY] {
            for at in [[far, 8.0], [8.0, far]] {
                sprites.read(0, at, 1.0, &mut stamp);
                assert!((0..tiles.count()).all(|tile| !stamp.touches(tiles, tile)), "{at:?}");
            }
        }
    }
}
