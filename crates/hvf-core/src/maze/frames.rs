//! Frames of the maze: states, and images where there are any.

use std::borrow::Cow;
use std::sync::Arc;

use rayon::prelude::*;

use super::geometry::State;
use super::render::Renderer;
use crate::planner::model::picked;
use crate::planner::Frames;
use crate::{Error, Result};

/// Frames of the maze, as [`MazeWorld`](super::MazeWorld) plans with them.
///
/// A frame is a state. Where it was made from an image (a goal photographed, a subgoal drawn by a
/// generator) it keeps that image, which is what costs are measured against; the state, which
/// [`Renderer::locate`] read off it, is where rollouts start. Selecting frames copies indices,
/// not images.
#[derive(Clone, Debug)]
pub struct MazeFrames {
    pool: Arc<Pool>,
    index: Vec<usize>,
}

#[derive(Debug)]
struct Pool {
    states: Vec<State>,
    image_size: usize,
    images: Option<Vec<u8>>,
}

impl MazeFrames {
    /// Frames of states; their images, of `image_size` pixels, are drawn where they are needed.
    pub fn from_states(states: Vec<State>, image_size: usize) -> Self {
        let index = (0..states.len()).collect();
        Self { pool: Arc::new(Pool { states, image_size, images: None }), index }
    }

    /// Frames of images `[N, S, S, 3]`, whose states are read off them.
    ///
    /// # Errors
    /// Bytes that are not a whole number of frames of `renderer`'s size.
    pub fn from_images(renderer: &Renderer, images: &[u8]) -> Result<Self> {
        let (size, length) = (renderer.size(), renderer.frame_len());
        if !images.len().is_multiple_of(length) {
            return Err(Error::invalid(
                "images",
                format!("must be [N, {size}, {size}, 3], got {} bytes", images.len()),
            ));
        }
        let states: Vec<State> =
            images.par_chunks_exact(length).map(|image| renderer.locate(image)).collect();
        let index = (0..states.len()).collect();
        let pool = Pool { states, image_size: size, images: Some(images.to_vec()) };
        Ok(Self { pool: Arc::new(pool), index })
    }

    /// State `i`.
    ///
    /// # Panics
    /// If there is no frame `i`.
    pub fn state(&self, i: usize) -> State {
        self.pool.states[self.index[i]]
    }

    /// Height and width of the images, pixels.
    pub fn image_size(&self) -> usize {
        self.pool.image_size
    }

    /// Image `i`, `[S, S, 3]`: the one it was made from, or else drawn by `renderer`.
    ///
    /// # Errors
    /// A renderer of another size.
    ///
    /// # Panics
    /// If there is no frame `i`.
    pub fn image(&self, renderer: &Renderer, i: usize) -> Result<Cow<'_, [u8]>> {
        let (length, size) = (renderer.frame_len(), self.image_size());
        if size != renderer.size() {
            return Err(Error::invalid(
                "frames",
                format!("must be of {} pixels, got {size}", renderer.size()),
            ));
        }
        Ok(match &self.pool.images {
            Some(images) => Cow::Borrowed(&images[self.index[i] * length..][..length]),
            None => {
                let mut image = vec![0; length];
                renderer.render(&self.state(i), &mut image);
                Cow::Owned(image)
            }
        })
    }
}

impl Frames for MazeFrames {
    fn len(&self) -> usize {
        self.index.len()
    }

    fn select(&self, index: &[usize]) -> Result<Self> {
        Ok(Self { pool: Arc::clone(&self.pool), index: picked(&self.index, index)? })
    }
}
