//! Frames as a latent world keeps them.

use std::sync::Arc;

use ndarray::{ArrayView, ArrayView1, ArrayView2, ArrayView4, Dimension};

use crate::planner::model::picked;
use crate::planner::Frames;
use crate::{Error, Result};

/// Frames as latents, with what is known of them besides.
///
/// Selecting frames copies indices. Frames are of no world: any world with latents of this length
/// takes them.
#[derive(Clone, Debug)]
pub struct LatentFrames {
    pool: Arc<Pool>,
    index: Vec<usize>,
}

/// The images that frames come from.
#[derive(Clone, Debug)]
pub struct KeptImages {
    /// Bytes of all images, `[N, height, width, 3]`.
    pub bytes: Vec<u8>,
    /// Pixels.
    pub height: usize,
    /// Pixels.
    pub width: usize,
}

#[derive(Debug)]
struct Pool {
    dim: usize,
    /// `[N][Z]`.
    latents: Vec<f32>,
    /// `[N][P]`, and `P`.
    targets: Option<(Vec<f32>, usize)>,
    /// `[N]`.
    constants: Vec<f32>,
    images: Option<KeptImages>,
}

/// What is known of frames besides their latents.
#[derive(Clone, Copy, Debug, Default)]
pub struct Known<'a> {
    /// What the read-out of a latent is compared with where a frame is the goal, `[N, P]`; the
    /// frame's own latent, read out, if not given.
    pub targets: Option<ArrayView2<'a, f32>>,
    /// What every predicted frame that counts costs more where a frame is the goal, `[N]`: the part
    /// of a pixel cost that no read-out can do anything about. Zero if not given.
    pub constants: Option<ArrayView1<'a, f32>>,
    /// Images to be looked at, `[N, H, W, 3]`.
    pub images: Option<ArrayView4<'a, u8>>,
}

/// Checks that there is a row for each frame, and that all is finite.
fn rows<D: Dimension>(
    argument: &'static str,
    array: &ArrayView<'_, f32, D>,
    count: usize,
    rest: &str,
) -> Result<()> {
    if array.shape()[0] != count || array.shape()[1..].contains(&0) {
        return Err(Error::invalid(
            argument,
            format!("expected shape [{count}{rest}], got {:?}", array.shape()),
        ));
    }
    if array.iter().any(|x| !x.is_finite()) {
        return Err(Error::invalid(argument, "must be finite"));
    }
    Ok(())
}

impl LatentFrames {
    /// Frames from `latents[N, Z]` and what is `known` of them besides.
    ///
    /// # Errors
    /// Latents or targets of no numbers, batches of different sizes, or numbers that are not finite.
    pub fn new(latents: ArrayView2<'_, f32>, known: Known<'_>) -> Result<Self> {
        let (count, dim) = latents.dim();
        rows("latents", &latents, count, ", Z")?;
        let Known { targets, constants, images } = known;
        if let Some(targets) = &targets {
            rows("targets", targets, count, ", P")?;
        }
        if let Some(constants) = &constants {
            rows("constants", constants, count, "")?;
        }
        let images = match images {
            None => None,
            Some(images) if images.dim().0 == count && images.dim().3 == 3 => {
                let (_, height, width, _) = images.dim();
                Some(KeptImages { bytes: images.iter().copied().collect(), height, width })
            }
            Some(images) => {
                return Err(Error::invalid(
                    "images",
                    format!("expected shape [{count}, H, W, 3], got {:?}", images.shape()),
                ))
            }
        };
        let pool = Pool {
            dim,
            latents: latents.iter().copied().collect(),
            targets: targets.map(|rows| (rows.iter().copied().collect(), rows.ncols())),
            constants: constants.map_or_else(|| vec![0.0; count], |numbers| numbers.to_vec()),
            images,
        };
        Ok(Self { pool: Arc::new(pool), index: (0..count).collect() })
    }

    /// Length of a latent, `Z`.
    pub fn latent_dim(&self) -> usize {
        self.pool.dim
    }

    /// Latent `i`, `[Z]`.
    pub fn latent(&self, i: usize) -> &[f32] {
        &self.pool.latents[self.index[i] * self.pool.dim..][..self.pool.dim]
    }

    /// Length of a target, `P`, where frames have them.
    pub fn target_dim(&self) -> Option<usize> {
        self.pool.targets.as_ref().map(|(_, length)| *length)
    }

    /// What a read-out is compared with where frame `i` is the goal, `[P]`.
    pub fn target(&self, i: usize) -> Option<&[f32]> {
        let (targets, length) = self.pool.targets.as_ref()?;
        Some(&targets[self.index[i] * length..][..*length])
    }

    /// What every predicted frame that counts costs more where frame `i` is the goal.
    pub fn constant(&self, i: usize) -> f32 {
        self.pool.constants[self.index[i]]
    }

    /// The images of these frames, where they were kept (a copy).
    pub fn images(&self) -> Option<KeptImages> {
        let KeptImages { bytes, height, width } = self.pool.images.as_ref()?;
        let size = height * width * 3;
        let picked = self.index.iter().flat_map(|&i| &bytes[i * size..][..size]);
        Some(KeptImages { bytes: picked.copied().collect(), height: *height, width: *width })
    }
}

impl Frames for LatentFrames {
    fn len(&self) -> usize {
        self.index.len()
    }

    fn select(&self, index: &[usize]) -> Result<Self> {
        Ok(Self { pool: Arc::clone(&self.pool), index: picked(&self.index, index)? })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use ndarray::{array, Array1, Array2, Array4};

    use super::*;

    #[test]
    fn selected_frames_keep_all_that_is_known_of_them() {
        let latents = array![[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]];
        let targets = array![[0.1], [0.2], [0.3]];
        let constants = array![0.5, 0.25, 0.125];
        let images = Array4::from_shape_fn((3, 2, 4, 3), |(i, ..)| i as u8);
        let known = Known {
            targets: Some(targets.view()),
            constants: Some(constants.view()),
            images: Some(images.view()),
        };
        let frames = LatentFrames::new(latents.view(), known).unwrap();
        let picked = frames.select(&[2, 0, 2]).unwrap().select(&[1, 2]).unwrap();
        assert_eq!((picked.len(), picked.latent_dim(), picked.target_dim()), (2, 2, Some(1)));
        assert_eq!((picked.latent(0), picked.latent(1)), (&[1.0, 2.0][..], &[5.0, 6.0][..]));
        assert_eq!([picked.target(0), picked.target(1)], [Some(&[0.1][..]), Some(&[0.3][..])]);
        assert_eq!([picked.constant(0), picked.constant(1)], [0.5, 0.125]);
        let kept = picked.images().unwrap();
        assert_eq!((kept.height, kept.width), (2, 4));
        assert_eq!(kept.bytes, [vec![0; 24], vec![2; 24]].concat());
        assert!(frames.select(&[3]).is_err());
        let bare = LatentFrames::new(latents.view(), Known::default()).unwrap();
        assert!(bare.images().is_none() && bare.target(0).is_none());
        assert_eq!(bare.constant(2), 0.0);
    }

    #[test]
    fn what_makes_no_frames_is_refused_by_name() {
        let latents = Array2::zeros((2, 3));
        fn said(latents: &Array2<f32>, known: Known<'_>) -> String {
            LatentFrames::new(latents.view(), known).unwrap_err().to_string()
        }
        for bad in [Array2::zeros((2, 0)), Array2::from_elem((1, 1), f32::NAN)] {
            assert!(said(&bad, Known::default()).starts_with("latents: "));
        }
        for bad in
            [Array2::zeros((2, 0)), Array2::zeros((1, 4)), Array2::from_elem((2, 1), f32::NAN)]
        {
            let known = Known { targets: Some(bad.view()), ..Known::default() };
            assert!(said(&latents, known).starts_with("targets: "));
        }
        for bad in [Array1::zeros(3), Array1::from_elem(2, f32::INFINITY)] {
            let known = Known { constants: Some(bad.view()), ..Known::default() };
            assert!(said(&latents, known).starts_with("constants: "));
        }
        let images = Array4::zeros((1, 2, 2, 3));
        let known = Known { images: Some(images.view()), ..Known::default() };
        assert!(said(&latents, known).starts_with("images: "));
    }
}
