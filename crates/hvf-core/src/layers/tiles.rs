//! Images cut into square tiles, tile by tile: what is drawn for a tile stays in the first cache.

use crate::{Error, Result};

/// How images of `S` x `S` pixels are cut into tiles of `T` x `T`.
///
/// An image in tiles is `[tiles][3][T * T]`, its colours one after the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tiles {
    size: usize,
    tile: usize,
}

impl Tiles {
    /// Tiles of `tile` pixels in images of `size`.
    ///
    /// # Errors
    /// A tile that is not a multiple of 4 pixels or does not divide the image.
    pub fn new(size: usize, tile: usize) -> Result<Self> {
        if tile == 0 || !tile.is_multiple_of(4) {
            return Err(Error::invalid(
                "arm_patches",
                format!("must be a multiple of 4 pixels wide, got {tile}"),
            ));
        }
        if size == 0 || !size.is_multiple_of(tile) {
            return Err(Error::invalid(
                "table",
                format!("expected images of a multiple of {tile} pixels, got {size}"),
            ));
        }
        Ok(Self { size, tile })
    }

    /// Height and width of an image, `S`.
    pub fn image_size(&self) -> usize {
        self.size
    }

    /// Height and width of a tile, `T`.
    pub fn tile_size(&self) -> usize {
        self.tile
    }

    /// Tiles in an image.
    pub fn count(&self) -> usize {
        (self.size / self.tile).pow(2)
    }

    /// Words of 64 bits that hold a bit for each tile.
    pub fn words(&self) -> usize {
        self.count().div_ceil(64)
    }

    /// Pixels of a tile.
    pub fn plane(&self) -> usize {
        self.tile * self.tile
    }

    /// Numbers that make a tile.
    pub fn values(&self) -> usize {
        3 * self.plane()
    }

    /// Row and column of the first pixel of a tile.
    pub fn corner(&self, tile: usize) -> [usize; 2] {
        let side = self.size / self.tile;
        [tile / side * self.tile, tile % side * self.tile]
    }

    /// One number per pixel, `at(row, column)`, in tiles: `[tiles][T * T]`.
    pub fn cut_plane<T>(&self, mut at: impl FnMut(usize, usize) -> T) -> Vec<T> {
        let mut tiles = Vec::with_capacity(self.size * self.size);
        for tile in 0..self.count() {
            let [top, left] = self.corner(tile);
            for i in 0..self.plane() {
                tiles.push(at(top + i / self.tile, left + i % self.tile));
            }
        }
        tiles
    }

    /// An image `at(row, column, colour)` in tiles.
    pub fn cut<T>(&self, mut at: impl FnMut(usize, usize, usize) -> T) -> Vec<T> {
        let mut tiles = Vec::with_capacity(self.size * self.size * 3);
        for tile in 0..self.count() {
            let [top, left] = self.corner(tile);
            for colour in 0..3 {
                for i in 0..self.plane() {
                    tiles.push(at(top + i / self.tile, left + i % self.tile, colour));
                }
            }
        }
        tiles
    }

    /// Puts a tile `[3][T * T]` at its place in `image[S, S, 3]`.
    pub fn place<T: Copy>(&self, tile: usize, values: &[T], image: &mut [T]) {
        let [top, left] = self.corner(tile);
        for (colour, plane) in values.chunks_exact(self.plane()).enumerate() {
            for (y, row) in plane.chunks_exact(self.tile).enumerate() {
                let first = ((top + y) * self.size + left) * 3 + colour;
                for (value, to) in row.iter().zip(image[first..].iter_mut().step_by(3)) {
                    *to = *value;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn what_is_cut_and_put_back_is_the_image() {
        let tiles = Tiles::new(24, 8).unwrap();
        let image: Vec<usize> = (0..24 * 24 * 3).collect();
        let cut = tiles.cut(|row, column, colour| image[(row * 24 + column) * 3 + colour]);
        let mut back = vec![0; image.len()];
        for (tile, values) in cut.chunks_exact(tiles.values()).enumerate() {
            tiles.place(tile, values, &mut back);
        }
        assert_eq!(back, image);
        let plane = tiles.cut_plane(|row, column| (row, column));
        assert_eq!(plane[4 * tiles.plane()], (8, 8));
        assert_eq!(tiles.corner(4), [8, 8]);
        assert_eq!((tiles.count(), tiles.words()), (9, 1));
    }

    #[test]
    fn tiles_that_do_not_fit_are_refused() {
        for (size, tile) in [(24, 0), (24, 6), (24, 16), (0, 8), (20, 8)] {
            assert!(Tiles::new(size, tile).is_err(), "{tile} in {size}");
        }
    }
}
