//! A scene of a layout as the camera sees it, without the agent.

use super::coverage::add_coverage;
use super::polygon::clipped_to_rectangle;
use super::scene::LayoutScene;
use crate::maze::geometry::BORDER;
use crate::maze::pixels::Axis;
use crate::maze::render::blend;

/// What walls cover of each pixel of a frame, and the frame. A pixel's colour is the mean over its
/// area, by the same rule as in the paper's scenes: exact areas, also of turned walls.
#[derive(Clone, Debug)]
pub struct Backdrop {
    size: usize,
    cover: Vec<f64>,
    frame: Vec<u8>,
}

impl Backdrop {
    pub(super) fn new(scene: &LayoutScene, size: usize) -> Self {
        let arena = scene.layout().arena();
        let axis = Axis::new(size);
        let mut cover = vec![0.0; size * size];
        let inside = arena.map(|half| [-half, half]);
        // Walls end at the border; what is beyond is not seen.
        let polygons: Vec<Vec<[f64; 2]>> = scene
            .boxes()
            .iter()
            .map(|wall| clipped_to_rectangle(&wall.corners(), inside))
            .filter(|polygon| polygon.len() > 2)
            .collect();
        add_coverage(&polygons, size, &mut cover);
        let part = |half: f64| -> Vec<f64> {
            (0..size).map(|pixel| axis.covered(pixel, -half, half)).collect()
        };
        // Symmetric about 0, so rows need not be turned round.
        let [outer_columns, outer_rows] = arena.map(|half| part(half + BORDER));
        let [inner_columns, inner_rows] = arena.map(part);
        for (row, cover) in cover.chunks_exact_mut(size).enumerate() {
            for (col, cover) in cover.iter_mut().enumerate() {
                let border =
                    outer_rows[row] * outer_columns[col] - inner_rows[row] * inner_columns[col];
                *cover = (*cover + border).min(1.0);
            }
        }
        let frame = cover.iter().flat_map(|&walls| blend(walls, 0.0)).collect();
        Self { size, cover, frame }
    }

    /// Width and height, pixels.
    pub fn size(&self) -> usize {
        self.size
    }

    /// The part of each pixel that walls cover, `[size, size]`, row 0 at the top.
    pub fn cover(&self) -> &[f64] {
        &self.cover
    }

    /// The frame, `[size, size, 3]`.
    pub fn frame(&self) -> &[u8] {
        &self.frame
    }
}
