//! A layout with the gaps of an episode cut.

use std::sync::{Arc, OnceLock};

use super::backdrop::Backdrop;
use super::description::{Layout, Wall};
use super::obstacles::Obstacles;
use super::polygon::{box_of, TurnedBox};
use crate::maze::geometry::State;
use crate::maze::render::Renderer;
use crate::{Error, Result};

/// Sizes of frames that a scene keeps its backdrop for.
const SIZES_KEPT: usize = 3;

/// A state of a layout: its row is `[x, y, gap, ..]`.
pub type LayoutState = State<Arc<LayoutScene>>;

/// One scene of a layout: walls in place.
#[derive(Debug)]
pub struct LayoutScene {
    layout: Arc<Layout>,
    gaps: Vec<f64>,
    boxes: Vec<TurnedBox>,
    obstacles: Obstacles,
    backdrops: [OnceLock<Arc<Backdrop>>; SIZES_KEPT],
}

impl PartialEq for LayoutScene {
    fn eq(&self, other: &Self) -> bool {
        self.gaps == other.gaps && self.layout == other.layout
    }
}

impl LayoutScene {
    /// The scene of `gaps` that [`Layout::scene`] has checked.
    pub(super) fn new(layout: Arc<Layout>, gaps: Vec<f64>) -> Self {
        let mut boxes = Vec::new();
        let mut at = gaps.iter();
        for Wall { centre, half, angle, gap } in layout.walls() {
            let whole = box_of(centre, half, *angle);
            match gap.as_ref().zip(at.as_slice().first()) {
                Some((gap, &middle)) => {
                    at.next();
                    for (low, high) in [(-half[1], middle - gap.half), (middle + gap.half, half[1])]
                    {
                        if high > low {
                            boxes.push(whole.piece(low, high));
                        }
                    }
                }
                None => boxes.push(whole),
            }
        }
        let obstacles = Obstacles::new(layout.arena(), &boxes);
        Self { layout, gaps, boxes, obstacles, backdrops: Default::default() }
    }

    /// Whose scene it is.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    /// Where the gaps are, m from the centres of their walls.
    pub fn gaps(&self) -> &[f64] {
        &self.gaps
    }

    pub(super) fn boxes(&self) -> &[TurnedBox] {
        &self.boxes
    }

    /// Where the agent can be.
    pub fn obstacles(&self) -> &Obstacles {
        &self.obstacles
    }

    /// Centre, half extents and turn (degrees) of every box that walls consist of, gaps cut.
    pub fn wall_boxes(&self) -> Vec<([f64; 2], [f64; 2], f64)> {
        let turn = |wall: &TurnedBox| wall.axes[0][1].atan2(wall.axes[0][0]).to_degrees();
        self.boxes.iter().map(|wall| (wall.centre, wall.half, turn(wall))).collect()
    }

    /// The scene without the agent, as `renderer` draws it; kept for a few sizes.
    pub fn backdrop(&self, renderer: &Renderer) -> Arc<Backdrop> {
        let size = renderer.size();
        for slot in &self.backdrops {
            let kept = slot.get_or_init(|| Arc::new(Backdrop::new(self, size)));
            if kept.size() == size {
                return Arc::clone(kept);
            }
        }
        Arc::new(Backdrop::new(self, size))
    }
}

impl State<Arc<LayoutScene>> {
    /// A state of a layout from its row `[x, y, gap, ..]`.
    ///
    /// A position inside a wall is allowed; [`step_in`](super::step_in) first pushes it out.
    ///
    /// # Errors
    /// A position that is not finite or outside the arena, or gaps that [`Layout::scene`] refuses.
    pub fn at(scene: &Arc<LayoutScene>, position: [f64; 2]) -> Result<Self> {
        let arena = scene.layout().arena();
        if [0, 1].iter().all(|&axis| position[axis].abs() <= arena[axis]) {
            return Ok(Self { scene: Arc::clone(scene), position });
        }
        Err(Error::invalid(
            "position",
            format!("must be within the arena, +-{arena:?} m, got {position:?}"),
        ))
    }
}
