//! The moving part of a frame: a soft box of one colour, and its squared distance to a goal image
//! in closed form.
//!
//! A predicted frame is `base + colour * row(y) column(x)`, where `base` is the start frame with
//! its own sprite taken away. With `r = base - goal`, the squared distance after a separable blur
//! `B` with Gram matrix `G = B^T B` is
//!
//! ```text
//! |B r|^2  +  2 row^T (G (colour . r) G) column  +  |colour|^2 (row^T G row) (column^T G column)
//! ```
//!
//! The first term and the matrix in the second depend only on start and goal; a candidate costs
//! a few hundred multiply-adds because the profiles are zero outside a few pixels.

use ndarray::Array2;

use crate::{Error, Result};

/// Most pixels that a profile can cover.
const MAX_WIDTH: usize = 40;

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

    /// `values^T gram values`, or the squared norm without a blur.
    fn norm(&self, gram: Option<&Array2<f32>>) -> f32 {
        match gram {
            None => self.values().iter().map(|a| a * a).sum(),
            Some(gram) => {
                let mut sum = 0.0;
                for (i, a) in self.values().iter().enumerate() {
                    for (j, b) in self.values().iter().enumerate() {
                        sum += a * gram[[self.first + i, self.first + j]] * b;
                    }
                }
                sum
            }
        }
    }
}

/// What a start and a goal contribute to the cost of every candidate between them.
#[derive(Clone, Debug)]
pub struct GoalTerms {
    /// Squared distance of the base frame to the goal, summed over pixels and channels.
    distance: f32,
    /// Gradient of the cost with respect to the sprite's coverage, halved, `[S, S]`.
    projection: Array2<f32>,
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

    /// Terms of a goal from the residual `base - goal`, `[S, S, 3]` in [0, 1] units, with the Gram
    /// matrix of the blur (`[S, S]`) if there is one. With a blur, `6 S^3` multiply-adds.
    pub fn goal_terms(
        &self,
        residual: &[f32],
        size: usize,
        gram: Option<&Array2<f32>>,
    ) -> GoalTerms {
        let mut distance = 0.0f64;
        let mut projection = Array2::<f32>::zeros((size, size));
        for channel in 0..3 {
            let plane = Array2::from_shape_fn((size, size), |(y, x)| {
                residual[(y * size + x) * 3 + channel]
            });
            let spread = match gram {
                None => plane.clone(),
                Some(gram) => gram.dot(&plane).dot(gram),
            };
            distance +=
                plane.iter().zip(&spread).map(|(r, s)| f64::from(*r) * f64::from(*s)).sum::<f64>();
            projection.scaled_add(self.colour[channel], &spread);
        }
        GoalTerms { distance: distance as f32, projection }
    }

    /// Squared distance to the goal, summed over pixels and channels, of the frame whose sprite
    /// stands at `keypoint` (row, column in pixels).
    pub fn squared_distance(
        &self,
        keypoint: [f32; 2],
        terms: &GoalTerms,
        gram: Option<&Array2<f32>>,
    ) -> f32 {
        let size = terms.projection.nrows();
        let row = self.profile(0, keypoint[0], size);
        let column = self.profile(1, keypoint[1], size);
        let mut cross = 0.0;
        for (i, a) in row.values().iter().enumerate() {
            let line = terms.projection.row(row.first + i);
            let line = line.as_slice().unwrap_or(&[]);
            let dot: f32 =
                line[column.first..].iter().zip(column.values()).map(|(g, b)| g * b).sum();
            cross += a * dot;
        }
        let colour: f32 = self.colour.iter().map(|c| c * c).sum();
        terms.distance + 2.0 * cross + colour * row.norm(gram) * column.norm(gram)
    }
}
