//! Frames of the maze: states, and images where there are any.

use std::borrow::Cow;
use std::sync::Arc;

use rayon::prelude::*;

use super::geometry::State;
use super::ground::Ground;
use super::layout::{locate_in, Layout, LayoutState};
use super::render::Renderer;
use crate::planner::model::picked;
use crate::planner::Frames;
use crate::{Error, Result};

/// States of one layout each, or of the paper's maze.
#[derive(Clone, Debug)]
pub enum States {
    /// Of the paper's maze.
    Paper(Vec<State>),
    /// Of other layouts.
    Laid(Vec<LayoutState>),
}

impl States {
    /// How many.
    pub fn len(&self) -> usize {
        match self {
            States::Paper(states) => states.len(),
            States::Laid(states) => states.len(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl From<Vec<State>> for States {
    fn from(states: Vec<State>) -> Self {
        States::Paper(states)
    }
}

impl From<Vec<LayoutState>> for States {
    fn from(states: Vec<LayoutState>) -> Self {
        States::Laid(states)
    }
}

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
    states: States,
    image_size: usize,
    images: Option<Vec<u8>>,
}

impl MazeFrames {
    /// Frames of states; their images, of `image_size` pixels, are drawn where they are needed.
    pub fn from_states(states: impl Into<States>, image_size: usize) -> Self {
        let states = states.into();
        let index = (0..states.len()).collect();
        Self { pool: Arc::new(Pool { states, image_size, images: None }), index }
    }

    /// Frames of images `[N, S, S, 3]`, whose states are read off them.
    ///
    /// # Errors
    /// Bytes that are not a whole number of frames of `renderer`'s size.
    pub fn from_images(renderer: &Renderer, images: &[u8]) -> Result<Self> {
        Self::seen(renderer, images, |image| renderer.locate(image))
    }

    /// [`from_images`](Self::from_images) of images of a layout.
    ///
    /// # Errors
    /// As [`from_images`](Self::from_images).
    pub fn from_images_in(
        layout: &Arc<Layout>,
        renderer: &Renderer,
        images: &[u8],
    ) -> Result<Self> {
        Self::seen(renderer, images, |image| locate_in(layout, renderer, image))
    }

    fn seen<S: Ground>(
        renderer: &Renderer,
        images: &[u8],
        locate: impl Fn(&[u8]) -> State<S> + Sync + Send,
    ) -> Result<Self>
    where
        States: From<Vec<State<S>>>,
    {
        let (size, length) = (renderer.size(), renderer.frame_len());
        if !images.len().is_multiple_of(length) {
            return Err(Error::invalid(
                "images",
                format!("must be [N, {size}, {size}, 3], got {} bytes", images.len()),
            ));
        }
        let states: Vec<State<S>> = images.par_chunks_exact(length).map(locate).collect();
        let index = (0..states.len()).collect();
        let pool = Pool { states: states.into(), image_size: size, images: Some(images.to_vec()) };
        Ok(Self { pool: Arc::new(pool), index })
    }

    /// The state of each frame.
    pub fn states(&self) -> States {
        match &self.pool.states {
            States::Paper(states) => States::Paper(picked_states(states, &self.index)),
            States::Laid(states) => States::Laid(picked_states(states, &self.index)),
        }
    }

    /// State `i` of frames of the paper's maze.
    #[cfg(test)]
    pub(super) fn state(&self, i: usize) -> State {
        match &self.pool.states {
            States::Paper(states) => states[self.index[i]],
            States::Laid(_) => panic!("frames of a layout"),
        }
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
                match &self.pool.states {
                    States::Paper(states) => renderer.render(&states[self.index[i]], &mut image),
                    States::Laid(states) => renderer.render(&states[self.index[i]], &mut image),
                }
                Cow::Owned(image)
            }
        })
    }
}

fn picked_states<S: Ground>(states: &[State<S>], index: &[usize]) -> Vec<State<S>> {
    index.iter().map(|&i| states[i].clone()).collect()
}

impl Frames for MazeFrames {
    fn len(&self) -> usize {
        self.index.len()
    }

    fn select(&self, index: &[usize]) -> Result<Self> {
        Ok(Self { pool: Arc::clone(&self.pool), index: picked(&self.index, index)? })
    }
}
