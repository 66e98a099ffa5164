//! Frames as the layered model keeps them.

use std::sync::Arc;

use ndarray::{ArrayView2, ArrayView4};

use super::painter::{Painter, Start};
use crate::planner::model::picked;
use crate::planner::Frames;
use crate::{Error, Result};

/// Frames as the model sees them: the image, the image without its arm, where parts are in it, and
/// its state.
///
/// Made by [`LayerWorld::frames`](super::LayerWorld::frames). Selecting frames copies indices, not
/// images.
#[derive(Clone, Debug)]
pub struct LayerFrames {
    pool: Arc<Pool>,
    index: Vec<usize>,
}

#[derive(Debug)]
struct Pool {
    painter: Arc<Painter>,
    /// In tiles.
    images: Vec<u8>,
    /// In tiles, from 0 to 255.
    clean: Vec<f32>,
    /// `[N][R]`, in tiles.
    regions: Vec<u8>,
    states: Vec<f32>,
}

impl LayerFrames {
    /// See [`LayerWorld::frames`](super::LayerWorld::frames).
    pub(super) fn new(
        painter: Arc<Painter>,
        images: ArrayView4<'_, u8>,
        clean: ArrayView4<'_, f32>,
        regions: ArrayView4<'_, bool>,
        states: ArrayView2<'_, f32>,
    ) -> Result<Self> {
        let tiles = painter.tiles();
        let (count, size, parts) = (images.dim().0, tiles.image_size(), painter.roaming());
        let expect = |argument, expected: &[usize], found: &[usize]| {
            if expected == found {
                return Ok(());
            }
            Err(Error::invalid(argument, format!("expected shape {expected:?}, got {found:?}")))
        };
        if images.shape()[1..] != [size, size, 3] {
            return Err(Error::invalid(
                "images",
                format!("expected shape [N, {size}, {size}, 3], got {:?}", images.shape()),
            ));
        }
        expect("clean", &[count, size, size, 3], clean.shape())?;
        expect("regions", &[count, parts, size, size], regions.shape())?;
        expect("states", &[count, painter.state_size()], states.shape())?;
        if clean.iter().any(|x| !x.is_finite()) {
            return Err(Error::invalid("clean", "must be finite"));
        }
        if states.iter().any(|x| !x.is_finite()) {
            return Err(Error::invalid("states", "must be finite"));
        }
        let image = |i: usize| tiles.cut(|row, column, colour| images[[i, row, column, colour]]);
        let cut =
            |i: usize| tiles.cut(|row, column, colour| 255.0 * clean[[i, row, column, colour]]);
        let mask = |i: usize| {
            tiles.cut_plane(|row, column| u8::from(regions[[i / parts, i % parts, row, column]]))
        };
        let pool = Pool {
            images: (0..count).flat_map(image).collect(),
            clean: (0..count).flat_map(cut).collect(),
            regions: (0..count * parts).flat_map(mask).collect(),
            states: states.iter().copied().collect(),
            painter,
        };
        Ok(Self { pool: Arc::new(pool), index: (0..count).collect() })
    }

    /// Whether these are frames of the world that `painter` draws.
    pub(super) fn belong_to(&self, painter: &Arc<Painter>) -> bool {
        Arc::ptr_eq(&self.pool.painter, painter)
    }

    /// Height and width of the images, `S`.
    pub fn image_size(&self) -> usize {
        self.pool.painter.tiles().image_size()
    }

    /// Length of a state, `X`.
    pub fn state_size(&self) -> usize {
        self.pool.painter.state_size()
    }

    /// Image `i` in tiles, bytes.
    pub(super) fn tiles(&self, i: usize) -> &[u8] {
        let bytes = self.image_size() * self.image_size() * 3;
        &self.pool.images[self.index[i] * bytes..][..bytes]
    }

    /// Image `i`, `[S, S, 3]`.
    pub fn image(&self, i: usize) -> Vec<u8> {
        let tiles = self.pool.painter.tiles();
        let bytes = self.tiles(i);
        let mut image = vec![0; bytes.len()];
        for (tile, values) in bytes.chunks_exact(tiles.values()).enumerate() {
            tiles.place(tile, values, &mut image);
        }
        image
    }

    /// State `i`, `[X]`.
    pub fn state(&self, i: usize) -> &[f32] {
        &self.pool.states[self.index[i] * self.state_size()..][..self.state_size()]
    }

    /// What candidates start from in frame `i`.
    pub(super) fn start(&self, i: usize) -> Start<'_> {
        let pixels = self.image_size() * self.image_size();
        let parts = self.pool.painter.roaming();
        Start {
            clean: &self.pool.clean[self.index[i] * pixels * 3..][..pixels * 3],
            regions: &self.pool.regions[self.index[i] * pixels * parts..][..pixels * parts],
            state: self.state(i),
        }
    }
}

impl Frames for LayerFrames {
    fn len(&self) -> usize {
        self.index.len()
    }

    fn select(&self, index: &[usize]) -> Result<Self> {
        Ok(Self { pool: Arc::clone(&self.pool), index: picked(&self.index, index)? })
    }
}
