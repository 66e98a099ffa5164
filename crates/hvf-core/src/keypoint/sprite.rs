//! The moving part of a frame: a soft box of one colour.

use crate::{Error, Result};

/// Most pixels that a profile can cover.
pub(super) const MAX_WIDTH: usize = 40;

/// Shape and colour of the moving part.
#[derive(Clone, Debug, PartialEq)]
pub struct Sprite {
    /// Half the size along rows and columns, in pixels.
    pub half_size: [f32; 2],
    /// Width of the soft edge along rows and columns, in pixels; 1 is exact area coverage.
    pub edge: [f32; 2],
    /// Colour relative to the background, red, green, blue, in units of full intensity.
    pub colour: [f32; 3],
}

/// The nonzero part of a profile.
struct Profile {
    first: usize,
    width: usize,
    coverage: [f32; MAX_WIDTH],
}

impl Profile {
    fn values(&self) -> &[f32] {
        &self.coverage[..self.width]
    }
}

impl Sprite {
    /// Checks that the sprite can be drawn.
    ///
    /// # Errors
    /// Numbers that are not finite, sizes that are not positive, or a sprite wider than 39 pixels.
    pub fn validate(&self) -> Result<()> {
        for axis in 0..2 {
            let (half, edge) = (self.half_size[axis], self.edge[axis]);
            if !(half.is_finite() && half > 0.0) {
                return Err(Error::invalid("half_size", format!("must be positive, got {half}")));
            }
            if !(edge.is_finite() && edge > 0.0) {
                return Err(Error::invalid("edge", format!("must be positive, got {edge}")));
            }
            if 2.0 * half + edge > (MAX_WIDTH - 1) as f32 {
                return Err(Error::invalid(
                    "half_size",
                    format!("sprite of {} pixels is too wide", 2.0 * half + edge),
                ));
            }
        }
        if self.colour.iter().any(|c| !c.is_finite()) {
            return Err(Error::invalid("colour", "must be finite"));
        }
        Ok(())
    }

    fn profile(&self, axis: usize, centre: f32, size: usize) -> Profile {
        let (half, edge) = (self.half_size[axis], self.edge[axis]);
        let reach = half + 0.5 * edge;
        let first = (centre - reach).ceil().clamp(0.0, size as f32) as usize;
        let end = ((centre + reach).floor() + 1.0).clamp(first as f32, size as f32) as usize;
        let mut coverage = [0.0; MAX_WIDTH];
        let width = (end - first).min(MAX_WIDTH);
        for (i, value) in coverage[..width].iter_mut().enumerate() {
            let distance = ((first + i) as f32 - centre).abs();
            *value = ((half - distance) / edge + 0.5).clamp(0.0, 1.0);
        }
        Profile { first, width, coverage }
    }

    /// Adds `sign * colour * coverage` to `image [S, S, 3]`; `keypoint` is (row, column) in pixels.
    pub fn draw(&self, keypoint: [f32; 2], sign: f32, image: &mut [f32], size: usize) {
        let row = self.profile(0, keypoint[0], size);
        let column = self.profile(1, keypoint[1], size);
        for (i, a) in row.values().iter().enumerate() {
            for (j, b) in column.values().iter().enumerate() {
                let pixel = ((row.first + i) * size + column.first + j) * 3;
                for (value, colour) in image[pixel..pixel + 3].iter_mut().zip(self.colour) {
                    *value += sign * colour * a * b;
                }
            }
        }
    }
}
