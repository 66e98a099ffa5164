//! What the arm looks like: a gallery of its images on a grid of hand positions.
//!
//! The twin of `hvf.models.layers.gallery.Gallery.forward`: trilinear interpolation in the grid,
//! tile by tile, most of which are empty.

use ndarray::{ArrayView2, ArrayView4};

use super::tiles::Tiles;
use crate::{Error, Result};

/// Dimensions of the hand's code.
pub const DIMENSIONS: usize = 3;
/// Values that are summed at once; they fill four vector registers.
const BLOCK: usize = 32;
/// Places of the grid around a code.
const AROUND: usize = 8;

/// What a gallery is made of.
#[derive(Clone, Debug)]
pub struct GalleryImages<'a> {
    /// The hand's code at the first place of the grid.
    pub low: [f32; DIMENSIONS],
    /// From one place to the next.
    pub step: [f32; DIMENSIONS],
    /// Places of the grid.
    pub places: [usize; DIMENSIONS],
    /// Opacity, and colour times opacity, of tiles: `[M, 4, T, T]`; the first is empty.
    pub patches: ArrayView4<'a, u8>,
    /// Number of the patch in each tile of each place's image: `[places, tiles]`.
    pub index: ArrayView2<'a, i32>,
}

/// The images of the arm.
#[derive(Clone, Debug)]
pub struct Gallery {
    low: [f32; DIMENSIONS],
    step: [f32; DIMENSIONS],
    places: [usize; DIMENSIONS],
    /// `[M][4][T * T]`, those of a place's image one after the other, and so are those of
    /// neighbours along the last dimension: what is read together lies together.
    patches: Vec<[u8; BLOCK]>,
    /// `[places][tiles]`, 0 where there is no arm.
    index: Vec<u32>,
    /// Tiles with an arm, a bit each: `[places][words]`.
    occupied: Vec<u64>,
    tiles: Tiles,
}

/// The places around a code, and how much of the image of each is seen.
pub type Around = [(usize, f32); AROUND];

impl Gallery {
    /// Takes over `images`, of frames of `image_size` pixels.
    ///
    /// # Errors
    /// Shapes that do not fit each other, numbers of patches that are not there, a first patch that
    /// is not empty, or a grid that does not go up.
    pub fn new(images: &GalleryImages<'_>, image_size: usize) -> Result<Self> {
        let (count, channels, height, width) = images.patches.dim();
        if count == 0 || channels != 4 || height != width || width == 0 {
            return Err(Error::invalid(
                "arm_patches",
                format!("expected shape [M, 4, T, T], got {:?}", images.patches.shape()),
            ));
        }
        let tiles = Tiles::new(image_size, width)?;
        if images.places.iter().any(|&places| places < 2) {
            return Err(Error::invalid(
                "arm_places",
                format!("must be at least 2, got {:?}", images.places),
            ));
        }
        let count_of = |total: usize, &places: &usize| total.checked_mul(places);
        let places = images.places.iter().try_fold(1, count_of);
        if places != Some(images.index.nrows()) || images.index.ncols() != tiles.count() {
            return Err(Error::invalid(
                "arm_index",
                format!(
                    "expected shape [product of {:?}, {}], got {:?}",
                    images.places,
                    tiles.count(),
                    images.index.shape()
                ),
            ));
        }
        let known = |&number: &i32| usize::try_from(number).is_ok_and(|number| number < count);
        if !images.index.iter().all(known) {
            return Err(Error::invalid("arm_index", format!("must be from 0 to {}", count - 1)));
        }
        if images.patches.outer_iter().next().is_some_and(|first| first.iter().any(|&x| x != 0)) {
            return Err(Error::invalid("arm_patches", "the first must be empty"));
        }
        if images.low.iter().any(|x| !x.is_finite()) {
            return Err(Error::invalid("arm_low", "must be finite"));
        }
        if images.step.iter().any(|x| !(x.is_finite() && *x > 0.0)) {
            return Err(Error::invalid("arm_step", "must be positive and finite"));
        }
        let length = 4 * tiles.plane();
        let bytes: Vec<u8> = images.patches.iter().copied().collect();
        let mut numbers = vec![0; count];
        let mut ordered = vec![0; length];
        let mut index = Vec::with_capacity(images.index.len());
        let mut occupied = Vec::new();
        for image in images.index.rows() {
            let mut words = vec![0; tiles.words()];
            for (tile, &old) in image.iter().enumerate() {
                let old = old as usize;
                if old != 0 {
                    words[tile / 64] |= 1 << (tile % 64);
                    if numbers[old] == 0 {
                        numbers[old] = (ordered.len() / length) as u32;
                        ordered.extend_from_slice(&bytes[old * length..][..length]);
                    }
                }
                index.push(numbers[old]);
            }
            occupied.extend(words);
        }
        Ok(Self {
            low: images.low,
            step: images.step,
            places: images.places,
            patches: ordered.as_chunks().0.to_vec(),
            index,
            occupied,
            tiles,
        })
    }

    /// How images are cut.
    pub fn tiles(&self) -> Tiles {
        self.tiles
    }

    /// The places around a code, which is moved into the grid.
    pub fn around(&self, code: [f32; DIMENSIONS]) -> Around {
        let mut lower = [0; DIMENSIONS];
        let mut beyond = [0.0; DIMENSIONS];
        for axis in 0..DIMENSIONS {
            let last = (self.places[axis] - 1) as f32;
            let place = ((code[axis] - self.low[axis]) / self.step[axis]).clamp(0.0, last);
            lower[axis] = (place as usize).min(self.places[axis] - 2);
            beyond[axis] = place - lower[axis] as f32;
        }
        std::array::from_fn(|corner| {
            let up = [corner >> 2 & 1, corner >> 1 & 1, corner & 1];
            let mut share = 1.0;
            for axis in 0..DIMENSIONS {
                share *= if up[axis] == 1 { beyond[axis] } else { 1.0 - beyond[axis] };
            }
            let at: [usize; DIMENSIONS] = std::array::from_fn(|axis| lower[axis] + up[axis]);
            ((at[0] * self.places[1] + at[1]) * self.places[2] + at[2], share)
        })
    }

    /// Adds the tiles with an arm to `drawn`, a bit each.
    #[inline(always)]
    pub fn occupied(&self, around: &Around, drawn: &mut [u64]) {
        for &(place, share) in around {
            if share != 0.0 {
                let occupied = &self.occupied[place * drawn.len()..][..drawn.len()];
                for (drawn, occupied) in drawn.iter_mut().zip(occupied) {
                    *drawn |= occupied;
                }
            }
        }
    }

    /// Draws the arm before a tile `behind` (`[3][T * T]`, 0 to 255), with `arm[4][T * T]` as room.
    #[inline(always)]
    pub fn draw(
        &self,
        around: &Around,
        tile: usize,
        behind: &[f32],
        arm: &mut [f32],
        out: &mut [f32],
    ) {
        let (count, blocks) = (self.tiles.count(), 4 * self.tiles.plane() / BLOCK);
        let mut patches: [(&[[u8; BLOCK]], f32); AROUND] = [(&[], 0.0); AROUND];
        let mut seen = 0;
        for &(place, share) in around {
            let number = self.index[place * count + tile] as usize;
            if number != 0 && share != 0.0 {
                patches[seen] = (&self.patches[number * blocks..][..blocks], share);
                seen += 1;
            }
        }
        for (block, arm) in arm.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
            *arm = blend(&patches[..seen], block);
        }
        let (opacity, colours) = arm.split_at(self.tiles.plane());
        for ((out, behind), colour) in out
            .chunks_exact_mut(opacity.len())
            .zip(behind.chunks_exact(opacity.len()))
            .zip(colours.chunks_exact(opacity.len()))
        {
            for (((out, behind), colour), opacity) in
                out.iter_mut().zip(behind).zip(colour).zip(opacity)
            {
                let through = (-1.0_f32 / 255.0).mul_add(*opacity, 1.0);
                *out = behind.mul_add(through, *colour).clamp(0.0, 255.0);
            }
        }
    }
}

/// The weighted sum of one block of each patch.
#[inline(always)]
fn blend(patches: &[(&[[u8; BLOCK]], f32)], block: usize) -> [f32; BLOCK] {
    let mut sums = [0.0; BLOCK];
    for (patch, share) in patches {
        let values = &patch[block];
        for i in 0..BLOCK {
            sums[i] = share.mul_add(f32::from(values[i]), sums[i]);
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use proptest::prelude::*;

    use super::super::toys::{gallery, gallery_images, PLACES, SIZE};

    const TILE: usize = 8;

    proptest! {
        #[test]
        fn the_arm_is_interpolated_in_the_grid(
            seed in 0_u64..100,
            code in prop::array::uniform3(-3.0_f32..4.0),
            at_a_place in any::<bool>(),
        ) {
            let gallery = gallery(seed, TILE);
            let (patches, index) = gallery_images(seed, TILE);
            let code = if at_a_place {
                [0, 1, 2].map(|i| gallery.low[i] + gallery.step[i] * code[i].round())
            } else {
                code
            };
            let around = gallery.around(code);
            let mut occupied = vec![0; 1];
            gallery.occupied(&around, &mut occupied);
            let place = [0, 1, 2].map(|i| {
                ((code[i] - gallery.low[i]) / gallery.step[i]).clamp(0.0, (PLACES[i] - 1) as f32)
            });
            for tile in 0..gallery.tiles().count() {
                let mut drawn = [[0.0; TILE * TILE]; 4];
                for (number, patch) in index.column(tile).iter().enumerate() {
                    let grid = [
                        number / (PLACES[1] * PLACES[2]),
                        number / PLACES[2] % PLACES[1],
                        number % PLACES[2],
                    ];
                    let near: f32 = (0..3)
                        .map(|axis| (1.0 - (place[axis] - grid[axis] as f32).abs()).max(0.0))
                        .product();
                    for (i, drawn) in drawn.as_flattened_mut().iter_mut().enumerate() {
                        let (channel, pixel) = (i / (TILE * TILE), i % (TILE * TILE));
                        let at = [*patch as usize, channel, pixel / TILE, pixel % TILE];
                        *drawn += near * f32::from(patches[at]);
                    }
                }
                if occupied[0] >> tile & 1 == 0 {
                    prop_assert!(drawn.as_flattened().iter().all(|&x| x < 1e-3));
                }
                let behind = vec![100.0; 3 * TILE * TILE];
                let (mut arm, mut out) = (vec![0.0; 4 * TILE * TILE], behind.clone());
                gallery.draw(&around, tile, &behind, &mut arm, &mut out);
                for (i, found) in out.iter().enumerate() {
                    let (colour, pixel) = (i / (TILE * TILE), i % (TILE * TILE));
                    let through = 1.0 - drawn[0][pixel] / 255.0;
                    let expected = (100.0 * through + drawn[1 + colour][pixel]).clamp(0.0, 255.0);
                    prop_assert!((found - expected).abs() < 1e-2, "{found}, not {expected}");
                }
            }
        }
    }

    #[test]
    fn tiles_are_found_again_in_images_of_more_than_64() {
        let gallery = gallery(1, 4);
        let (_, index) = gallery_images(1, 4);
        assert_eq!(gallery.tiles().count(), (SIZE / 4).pow(2));
        let around = gallery.around(gallery.low);
        let mut occupied = vec![0; gallery.tiles().words()];
        gallery.occupied(&around, &mut occupied);
        for (tile, &number) in index.row(0).iter().enumerate() {
            assert_eq!(occupied[tile / 64] >> (tile % 64) & 1 == 1, number != 0);
        }
    }
}
