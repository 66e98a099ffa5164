//! What is behind everything, for every place of what slides: a table of images.
//!
//! The twin of `hvf.models.desk.backdrop.Backdrop.draw`: bilinear interpolation in the table.

use ndarray::ArrayView5;

use super::cell::SLIDERS;
use super::tiles::Tiles;
use crate::{Error, Result};

/// Images over the coordinates of the sliders.
#[derive(Clone, Debug)]
pub struct Backdrop {
    bins: [usize; SLIDERS],
    tiles: Tiles,
    /// `[bins * bins]` images in tiles.
    table: Vec<u8>,
}

/// The four images of the table that a backdrop is made of, and how much of each.
pub type Corners = [(usize, f32); 4];

impl Backdrop {
    /// Height and width of the images of a table, `S`.
    ///
    /// # Errors
    /// Fewer than two places of a slider, or images that are not square.
    pub fn image_size(table: ArrayView5<'_, u8>) -> Result<usize> {
        let (first, second, colours, height, width) = table.dim();
        if first < 2 || second < 2 || colours != 3 || height != width {
            return Err(Error::invalid(
                "table",
                format!(
                    "expected shape [bins, bins, 3, S, S] with at least 2 bins, got {:?}",
                    table.shape()
                ),
            ));
        }
        Ok(height)
    }

    /// From `table[bins, bins, 3, S, S]`.
    ///
    /// # Errors
    /// Fewer than two places of a slider, or images of another size than `tiles` cut.
    pub fn new(table: ArrayView5<'_, u8>, tiles: Tiles) -> Result<Self> {
        let (size, found) = (tiles.image_size(), Self::image_size(table)?);
        if found != size {
            return Err(Error::invalid(
                "table",
                format!("expected images of {size} pixels, got {found}"),
            ));
        }
        let (first, second, ..) = table.dim();
        let image = |place: usize| {
            let (i, j) = (place / second, place % second);
            tiles.cut(|row, column, colour| table[[i, j, colour, row, column]])
        };
        let table = (0..first * second).flat_map(image).collect();
        Ok(Self { bins: [first, second], tiles, table })
    }

    /// How images are cut.
    pub fn tiles(&self) -> Tiles {
        self.tiles
    }

    /// Where in the table sliders at `coordinates[G]` (clamped to 0 to 1) are.
    pub fn corners(&self, coordinates: &[f32]) -> Corners {
        let mut low = [0; SLIDERS];
        let mut share = [0.0; SLIDERS];
        for axis in 0..SLIDERS {
            let place = coordinates[axis].clamp(0.0, 1.0) * (self.bins[axis] - 1) as f32;
            low[axis] = (place as usize).min(self.bins[axis] - 2);
            share[axis] = place - low[axis] as f32;
        }
        let first = low[0] * self.bins[1] + low[1];
        let (down, right) = (share[0], share[1]);
        [
            (first, (1.0 - down) * (1.0 - right)),
            (first + 1, (1.0 - down) * right),
            (first + self.bins[1], down * (1.0 - right)),
            (first + self.bins[1] + 1, down * right),
        ]
    }

    /// Draws one tile, `[3][T * T]` in [0, 1].
    #[inline(always)]
    pub fn draw(&self, corners: &Corners, tile: usize, out: &mut [f32]) {
        let length = out.len();
        let image = |(place, _): (usize, f32)| {
            &self.table[(place * self.tiles.count() + tile) * length..][..length]
        };
        let [a, b, c, d] = corners.map(image);
        let [wa, wb, wc, wd] = corners.map(|(_, weight)| weight / 255.0);
        for ((((out, a), b), c), d) in out.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            let upper = wb.mul_add(f32::from(*b), wa * f32::from(*a));
            *out = wd.mul_add(f32::from(*d), wc.mul_add(f32::from(*c), upper));
        }
    }
}
