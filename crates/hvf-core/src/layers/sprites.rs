//! The images of the parts that roam, pasted at any place.
//!
//! The twin of `hvf.models.desk.perception.DeskPerception.paste`: sprites are read bilinearly, and
//! are nothing outside.

use ndarray::ArrayView4;

use super::tiles::Tiles;
use crate::{Error, Result};

/// Opacity, and colour times opacity, of each part.
#[derive(Clone, Debug)]
pub struct Sprites {
    width: usize,
    count: usize,
    /// `[R][4][W + 2][W + 2]`, with a border of zeros.
    images: Vec<f32>,
}

/// Where a line of pixels reads a sprite: the first of two neighbours, and the second's share.
type Reading = Option<(usize, f32)>;

impl Sprites {
    /// From `images[R, 4, W, W]`, `W` odd.
    ///
    /// # Errors
    /// No sprite, another shape, or numbers that are not finite.
    pub fn new(images: ArrayView4<'_, f32>) -> Result<Self> {
        let (count, channels, height, width) = images.dim();
        if count == 0 || channels != 4 || height != width || width % 2 == 0 {
            return Err(Error::invalid(
                "sprites",
                format!("expected shape [R, 4, W, W] with W odd, got {:?}", images.shape()),
            ));
        }
        if images.iter().any(|x| !x.is_finite()) {
            return Err(Error::invalid("sprites", "must be finite"));
        }
        let side = width + 2;
        let mut padded = vec![0.0; count * 4 * side * side];
        for ((part, channel, row, column), &value) in images.indexed_iter() {
            padded[((part * 4 + channel) * side + row + 1) * side + column + 1] = value;
        }
        Ok(Self { width, count, images: padded })
    }

    /// Number of sprites, `R`.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Which rows (or columns) of the padded sprite a pixel at `line` reads with the part `at`.
    #[inline(always)]
    fn reading(&self, line: usize, at: f32) -> Reading {
        let place = line as f32 - at + (self.width / 2 + 1) as f32;
        let inside = place > 0.0 && place < (self.width + 1) as f32;
        inside.then_some((place as usize, place - (place as usize) as f32))
    }

    /// Whether `part` at (row, column) touches a tile.
    #[inline(always)]
    pub fn touches(&self, at: [f32; 2], tiles: Tiles, tile: usize) -> bool {
        let reach = (self.width / 2 + 1) as f32;
        let corner = tiles.corner(tile);
        (0..2).all(|axis| {
            let (first, last) = (corner[axis], corner[axis] + tiles.tile_size() - 1);
            at[axis] + reach > first as f32 && at[axis] - reach < last as f32
        })
    }

    /// Pastes `part`, `presence` of it, at (row, column) onto a tile of an image.
    #[inline(always)]
    pub fn paste(
        &self,
        part: usize,
        at: [f32; 2],
        presence: f32,
        tiles: Tiles,
        tile: usize,
        image: &mut [f32],
    ) {
        let (side, plane, size) = (self.width + 2, tiles.plane(), tiles.tile_size());
        let [top, left] = tiles.corner(tile);
        for y in 0..size {
            let Some((row, down)) = self.reading(top + y, at[0]) else { continue };
            for x in 0..size {
                let Some((column, right)) = self.reading(left + x, at[1]) else { continue };
                let drawn: [f32; 4] = std::array::from_fn(|channel| {
                    let first = ((part * 4 + channel) * side + row) * side + column;
                    let upper = &self.images[first..first + 2];
                    let lower = &self.images[first + side..first + side + 2];
                    let above = (1.0 - right) * upper[0] + right * upper[1];
                    let below = (1.0 - right) * lower[0] + right * lower[1];
                    ((1.0 - down) * above + down * below) * presence
                });
                for colour in 0..3 {
                    let value = &mut image[colour * plane + y * size + x];
                    *value = *value * (1.0 - drawn[0]) + drawn[1 + colour];
                }
            }
        }
    }
}
