//! What is behind everything, for every place of what slides: a table of images.
//!
//! The twin of `hvf.models.layers.backdrop.Backdrop.draw`: bilinear interpolation in the table.
//! Most of an image is the same wherever the sliders are, so images are kept as numbers of tiles,
//! and whether two places look the same is seen from the numbers.

use std::collections::HashMap;

use ndarray::ArrayView5;

use super::cell::SLIDERS;
use super::tiles::Tiles;
use crate::{Error, Result};

/// Values that are summed at once; they fill six vector registers.
const BLOCK: usize = 48;

/// Images over the coordinates of the sliders.
#[derive(Clone, Debug)]
pub struct Backdrop {
    bins: [usize; SLIDERS],
    tiles: Tiles,
    /// Different tiles, `[tiles][3][T * T]`.
    looks: Vec<[u8; BLOCK]>,
    /// Number of the look of each tile of each image, `[bins * bins][tiles]`.
    index: Vec<u32>,
}

/// The images of the table that a backdrop is made of, and how much of each.
#[derive(Clone, Copy, Debug, Default)]
pub struct Corners {
    corners: [(usize, f32); 4],
    count: usize,
}

impl Corners {
    #[inline(always)]
    fn all(&self) -> &[(usize, f32)] {
        &self.corners[..self.count]
    }

    /// Whether the images are the same, though not how much of each.
    #[inline(always)]
    pub fn are_those_of(&self, other: &Corners) -> bool {
        let pairs = self.all().iter().zip(other.all());
        self.count == other.count && pairs.into_iter().all(|(a, b)| a.0 == b.0)
    }
}

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
        let mut numbers: HashMap<Vec<u8>, u32> = HashMap::new();
        let (mut looks, mut index) = (Vec::new(), Vec::new());
        for place in 0..first * second {
            let (i, j) = (place / second, place % second);
            let image = tiles.cut(|row, column, colour| table[[i, j, colour, row, column]]);
            for look in image.chunks_exact(tiles.values()) {
                let next = numbers.len() as u32;
                index.push(*numbers.entry(look.to_vec()).or_insert_with(|| {
                    looks.extend_from_slice(look.as_chunks::<BLOCK>().0);
                    next
                }));
            }
        }
        Ok(Self { bins: [first, second], tiles, looks, index })
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
        let four = [
            (first, (1.0 - down) * (1.0 - right)),
            (first + 1, (1.0 - down) * right),
            (first + self.bins[1], down * (1.0 - right)),
            (first + self.bins[1] + 1, down * right),
        ];
        // Sliders are often at the end of their way, right at a place of the table.
        let mut found = Corners::default();
        for corner in four {
            if corner.1 != 0.0 {
                found.corners[found.count] = corner;
                found.count += 1;
            }
        }
        found
    }

    /// Numbers of the looks of an image of the table.
    #[inline(always)]
    fn looks_of(&self, place: usize) -> &[u32] {
        &self.index[place * self.tiles.count()..][..self.tiles.count()]
    }

    /// Sets `changed[tiles]` to whether a tile may look different at these two places.
    #[inline(always)]
    pub fn compare(&self, before: &Corners, after: &Corners, changed: &mut [bool]) {
        changed.fill(false);
        let Some((&(place, _), rest)) = before.all().split_first() else { return };
        let first = self.looks_of(place);
        for &(other, _) in rest.iter().chain(after.all()) {
            if other == place {
                continue;
            }
            for ((changed, a), b) in changed.iter_mut().zip(first).zip(self.looks_of(other)) {
                *changed |= a != b;
            }
        }
    }

    /// Draws one tile, `[3][T * T]` in 0 to 255.
    #[inline(always)]
    pub fn draw(&self, corners: &Corners, tile: usize, out: &mut [f32]) {
        let blocks = self.tiles.values() / BLOCK;
        let mut looks: [(&[[u8; BLOCK]], f32); 4] = [(&[], 0.0); 4];
        for (look, &(place, weight)) in looks.iter_mut().zip(corners.all()) {
            let number = self.looks_of(place)[tile] as usize;
            *look = (&self.looks[number * blocks..][..blocks], weight);
        }
        for (block, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
            let mut sums = [0.0; BLOCK];
            for (look, weight) in &looks[..corners.count] {
                let values = &look[block];
                for i in 0..BLOCK {
                    sums[i] = weight.mul_add(f32::from(values[i]), sums[i]);
                }
            }
            *out = sums;
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use proptest::prelude::*;

    use super::super::toys::{table, BINS, SIZE};
    use super::*;

    fn drawn(backdrop: &Backdrop, corners: &Corners) -> Vec<f32> {
        let tiles = backdrop.tiles();
        let mut image = vec![0.0; tiles.count() * tiles.values()];
        for (tile, out) in image.chunks_exact_mut(tiles.values()).enumerate() {
            backdrop.draw(corners, tile, out);
        }
        image
    }

    proptest! {
        #[test]
        fn images_are_interpolated_in_the_table(
            seed in 0_u64..100,
            sliders in prop::array::uniform2(-0.2_f32..1.2),
        ) {
            let tiles = Tiles::new(SIZE, 8).unwrap();
            let table = table(seed);
            let backdrop = Backdrop::new(table.view(), tiles).unwrap();
            let found = drawn(&backdrop, &backdrop.corners(&sliders));
            let place = [0, 1].map(|i| sliders[i].clamp(0.0, 1.0) * (BINS[i] - 1) as f32);
            let expected = tiles.cut(|row, column, colour| {
                let mut sum = 0.0;
                for i in 0..BINS[0] {
                    for j in 0..BINS[1] {
                        let near = (1.0 - (place[0] - i as f32).abs()).max(0.0)
                            * (1.0 - (place[1] - j as f32).abs()).max(0.0);
                        sum += near * f32::from(table[[i, j, colour, row, column]]);
                    }
                }
                sum
            });
            for (found, expected) in found.iter().zip(&expected) {
                prop_assert!((found - expected).abs() < 1e-3, "{found}, not {expected}");
            }
        }

        #[test]
        fn tiles_said_not_to_change_do_not(
            seed in 0_u64..100,
            before in prop::array::uniform2(0.0_f32..=1.0),
            after in prop::array::uniform2(-0.5_f32..1.5),
        ) {
            let tiles = Tiles::new(SIZE, 4).unwrap();
            let backdrop = Backdrop::new(table(seed).view(), tiles).unwrap();
            let (before, after) = (backdrop.corners(&before), backdrop.corners(&after));
            let mut changed = vec![false; tiles.count()];
            backdrop.compare(&before, &after, &mut changed);
            // The right half is always the same.
            prop_assert!(changed.iter().any(|&changed| !changed));
            let (a, b) = (drawn(&backdrop, &before), drawn(&backdrop, &after));
            let pairs = a.chunks_exact(tiles.values()).zip(b.chunks_exact(tiles.values()));
            for ((a, b), changed) in pairs.zip(changed) {
                for (a, b) in a.iter().zip(b) {
                    prop_assert!(changed || (a - b).abs() < 1e-4, "{a} became {b}");
                }
            }
        }
    }

    #[test]
    fn a_slider_at_a_place_of_the_table_has_one_image() {
        let tiles = Tiles::new(SIZE, 8).unwrap();
        let backdrop = Backdrop::new(table(1).view(), tiles).unwrap();
        for sliders in [[0.0, 0.0], [1.0, 1.0], [-3.0, 0.5], [0.0, 7.0]] {
            assert_eq!(backdrop.corners(&sliders).all().len(), 1, "{sliders:?}");
        }
        assert_eq!(backdrop.corners(&[0.1, 0.1]).all().len(), 4);
    }
}
