//! Frames as the compact dynamics model keeps them.

use std::sync::{Arc, OnceLock};

use ndarray::{ArrayView2, ArrayView3, ArrayView4};

use super::cell::Cell;
use super::cost::GoalTerms;
use super::field::SceneField;
use crate::planner::model::picked;
use crate::planner::Frames;
use crate::{Error, Result};

/// Frames as the model sees them: the image, where the moving part is, and a map of the rest.
///
/// Made by [`KeypointWorld::frames`](super::KeypointWorld::frames). Selecting frames copies
/// indices, not images, and what the cell sees in a scene is computed once, when it is first
/// needed.
#[derive(Clone, Debug)]
pub struct KeypointFrames {
    pool: Arc<Pool>,
    index: Vec<usize>,
    prepared: Option<Prepared>,
}

/// What goals contribute to costs from the starts that they were prepared with.
#[derive(Clone, Debug)]
struct Prepared {
    terms: Arc<Vec<GoalTerms>>,
    index: Vec<usize>,
}

/// What does not move, and what the cell sees of it.
#[derive(Debug)]
struct Scene {
    map: Vec<f32>,
    field: OnceLock<SceneField>,
}

#[derive(Debug)]
struct Pool {
    cell: Arc<Cell>,
    size: usize,
    images: Vec<u8>,
    keypoints: Vec<[f32; 2]>,
    scenes: Vec<Arc<Scene>>,
}

/// Checks images `[N, S, S, 3]` and keypoints `[N, 2]`; copies both.
fn images_and_keypoints(
    images: ArrayView4<'_, u8>,
    keypoints: ArrayView2<'_, f32>,
    size: usize,
) -> Result<(Vec<u8>, Vec<[f32; 2]>)> {
    let (count, height, width, channels) = images.dim();
    if (height, width, channels) != (size, size, 3) {
        return Err(Error::invalid(
            "images",
            format!("expected shape [N, {size}, {size}, 3], got {:?}", images.shape()),
        ));
    }
    if keypoints.dim() != (count, 2) {
        return Err(Error::invalid(
            "keypoints",
            format!("expected shape [{count}, 2], got {:?}", keypoints.shape()),
        ));
    }
    if keypoints.iter().any(|x| !x.is_finite()) {
        return Err(Error::invalid("keypoints", "must be finite"));
    }
    Ok((
        images.iter().copied().collect(),
        keypoints.rows().into_iter().map(|row| [row[0], row[1]]).collect(),
    ))
}

impl KeypointFrames {
    /// Frames from `images[N, S, S, 3]`, `keypoints[N, 2]` (row, column in pixels) and scene
    /// `maps[N, S, S]`, as `cell` will see them.
    pub(super) fn new(
        cell: Arc<Cell>,
        size: usize,
        images: ArrayView4<'_, u8>,
        keypoints: ArrayView2<'_, f32>,
        maps: ArrayView3<'_, f32>,
    ) -> Result<Self> {
        let count = images.dim().0;
        let (images, keypoints) = images_and_keypoints(images, keypoints, size)?;
        if maps.dim() != (count, size, size) {
            return Err(Error::invalid(
                "maps",
                format!("expected shape [{count}, {size}, {size}], got {:?}", maps.shape()),
            ));
        }
        if maps.iter().any(|x| !x.is_finite()) {
            return Err(Error::invalid("maps", "must be finite"));
        }
        let scenes = maps
            .outer_iter()
            .map(|map| {
                Arc::new(Scene { map: map.iter().copied().collect(), field: OnceLock::new() })
            })
            .collect();
        let pool = Pool { cell, size, images, keypoints, scenes };
        Ok(Self { pool: Arc::new(pool), index: (0..count).collect(), prepared: None })
    }

    /// Frames of the same scene in which the moving part is elsewhere: `images[N, S, S, 3]` and
    /// `keypoints[N, 2]` in the scene of this one frame.
    ///
    /// # Errors
    /// More or less than one frame here, shapes that do not fit each other, or keypoints that are
    /// not finite.
    pub fn moved(
        &self,
        images: ArrayView4<'_, u8>,
        keypoints: ArrayView2<'_, f32>,
    ) -> Result<Self> {
        if self.len() != 1 {
            return Err(Error::invalid("self", format!("expected 1 frame, got {}", self.len())));
        }
        let size = self.pool.size;
        let (images, keypoints) = images_and_keypoints(images, keypoints, size)?;
        let count = keypoints.len();
        let scenes = vec![Arc::clone(self.scene(0)); count];
        let pool = Pool { cell: Arc::clone(&self.pool.cell), size, images, keypoints, scenes };
        Ok(Self { pool: Arc::new(pool), index: (0..count).collect(), prepared: None })
    }

    /// The same frames, as goals with these terms, one for each.
    pub(super) fn with_terms(&self, terms: Vec<GoalTerms>) -> Self {
        let index = (0..terms.len()).collect();
        Self { prepared: Some(Prepared { terms: Arc::new(terms), index }), ..self.clone() }
    }

    /// Terms of goal `i`, if they have been prepared.
    pub(super) fn terms(&self, i: usize) -> Option<&GoalTerms> {
        self.prepared.as_ref().map(|prepared| &prepared.terms[prepared.index[i]])
    }

    fn scene(&self, i: usize) -> &Arc<Scene> {
        &self.pool.scenes[self.index[i]]
    }

    /// Whether these are frames of the world that `cell` moves.
    pub(super) fn belong_to(&self, cell: &Arc<Cell>) -> bool {
        Arc::ptr_eq(&self.pool.cell, cell)
    }

    /// Height and width of the images, `S`.
    pub fn image_size(&self) -> usize {
        self.pool.size
    }

    /// Image `i`, `S * S * 3` bytes.
    pub fn image(&self, i: usize) -> &[u8] {
        let bytes = self.pool.size * self.pool.size * 3;
        &self.pool.images[self.index[i] * bytes..][..bytes]
    }

    /// Keypoint `i`, (row, column) in pixels.
    pub fn keypoint(&self, i: usize) -> [f32; 2] {
        self.pool.keypoints[self.index[i]]
    }

    /// Scene map `i`, `[S, S]` row by row.
    pub fn map(&self, i: usize) -> &[f32] {
        &self.scene(i).map
    }

    /// What the cell sees around every point of scene `i`.
    pub(super) fn field(&self, i: usize) -> &SceneField {
        let scene = self.scene(i);
        scene.field.get_or_init(|| self.pool.cell.field(&scene.map, self.pool.size))
    }
}

impl Frames for KeypointFrames {
    fn len(&self) -> usize {
        self.index.len()
    }

    fn select(&self, index: &[usize]) -> Result<Self> {
        let prepared = match &self.prepared {
            None => None,
            Some(Prepared { terms, index: places }) => {
                Some(Prepared { terms: Arc::clone(terms), index: picked(places, index)? })
            }
        };
        Ok(Self { pool: Arc::clone(&self.pool), index: picked(&self.index, index)?, prepared })
    }
}
