//! What a layout is: arena, walls with their gaps, and where episodes start and aim.

use std::sync::Arc;

use super::scene::LayoutScene;
use super::way::Way;
use crate::maze::episodes::Difficulty;
use crate::maze::geometry::{AGENT_HALF, ARENA};
use crate::{Error, Result};

/// Most walls of a layout.
pub const MOST_WALLS: usize = 256;
/// Smallest half-width of an arena, m: room for the agent to move.
pub const SMALLEST_ARENA: f64 = 2.0 * AGENT_HALF;

/// Scenes of a layout whose start and goal regions are looked at when it is made.
const SCENES_CHECKED: u64 = 8;
/// Points of a side of the grid in which free space in a region is looked for.
const POINTS: usize = 41;

/// An opening in a wall, across its second axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gap {
    /// Half its width, m; more than the agent's.
    pub half: f64,
    /// Where its centre may be along the wall's second axis, from the wall's centre, m; an
    /// episode draws it uniformly.
    pub range: [f64; 2],
}

/// A wall: a box that may be turned and may have a gap.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wall {
    /// Centre `[x, y]`, m.
    pub centre: [f64; 2],
    /// Half extents along its own two axes, m.
    pub half: [f64; 2],
    /// Turn of its axes, degrees, anticlockwise.
    pub angle: f64,
    /// The opening, if it has one.
    pub gap: Option<Gap>,
}

impl Wall {
    /// A wall without a gap that is not turned.
    pub fn new(centre: [f64; 2], half: [f64; 2]) -> Self {
        Self { centre, half, angle: 0.0, gap: None }
    }
}

/// A rectangle from which positions are drawn uniformly, where the agent can stand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region {
    /// Lowest and highest `x`, m.
    pub x: [f64; 2],
    /// Lowest and highest `y`, m.
    pub y: [f64; 2],
}

/// A kind of maze. Made by [`Layout::new`] or [`preset`](super::preset).
#[derive(Clone, Debug, PartialEq)]
pub struct Layout {
    name: String,
    arena: [f64; 2],
    walls: Vec<Wall>,
    start: Region,
    goal: Region,
    paper: Option<Difficulty>,
}

impl Layout {
    /// A layout.
    ///
    /// # Arguments
    /// `arena`: half-widths, m, up to [`ARENA`], which is what the camera sees. `walls`: parts
    /// beyond the arena do not count. `start` and `goal`: where episodes start and aim at.
    ///
    /// # Errors
    /// Numbers that are not finite or out of range; a wall outside the arena; a gap that the agent
    /// does not fit through or that may lie beyond its wall; a start or goal region that walls
    /// fill; a goal that cannot be reached from the start.
    pub fn new(
        name: impl Into<String>,
        arena: [f64; 2],
        walls: Vec<Wall>,
        start: Region,
        goal: Region,
    ) -> Result<Arc<Self>> {
        let layout = Self { name: name.into(), arena, walls, start, goal, paper: None };
        layout.check_numbers()?;
        let layout = Arc::new(layout);
        layout.check_scenes()?;
        Ok(layout)
    }

    /// The same layout, known to be the paper's at this difficulty.
    pub(super) fn of_paper(&self, difficulty: Difficulty) -> Arc<Self> {
        Arc::new(Self { paper: Some(difficulty), ..self.clone() })
    }

    /// Which of the paper's difficulties this is, if it is one: the parent module has episodes
    /// and steps of those.
    pub fn difficulty(&self) -> Option<Difficulty> {
        self.paper
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Half-widths of the arena, m.
    pub fn arena(&self) -> [f64; 2] {
        self.arena
    }

    /// The walls.
    pub fn walls(&self) -> &[Wall] {
        &self.walls
    }

    /// Where episodes start.
    pub fn start(&self) -> Region {
        self.start
    }

    /// Where episodes aim at.
    pub fn goal(&self) -> Region {
        self.goal
    }

    /// The gaps, in the order of their walls: what an episode draws.
    pub fn gaps(&self) -> impl Iterator<Item = Gap> + '_ {
        self.walls.iter().filter_map(|wall| wall.gap)
    }

    /// Numbers of a state's row: `x`, `y` and where each gap is.
    pub fn columns(&self) -> usize {
        2 + self.gaps().count()
    }

    /// The scene with gaps at `gaps`, m from the centres of their walls.
    ///
    /// # Errors
    /// Another number of gaps, or one beyond its wall.
    pub fn scene(self: &Arc<Self>, gaps: &[f64]) -> Result<LayoutScene> {
        let expected = self.gaps().count();
        if gaps.len() != expected {
            return Err(Error::invalid(
                "gaps",
                format!("layout '{}' has {expected} gaps, got {}", self.name, gaps.len()),
            ));
        }
        let walls = self.walls.iter().filter(|wall| wall.gap.is_some());
        for (index, (wall, at)) in walls.zip(gaps).enumerate() {
            // The paper's maze may have gaps beyond those that are drawn.
            if at.is_nan() || at.abs() > wall.half[1] {
                return Err(Error::invalid(
                    "gaps",
                    format!(
                        "gap {index} of layout '{}' must be within +-{} m, got {at}",
                        self.name, wall.half[1]
                    ),
                ));
            }
        }
        Ok(LayoutScene::new(Arc::clone(self), gaps.to_vec()))
    }

    fn check_numbers(&self) -> Result<()> {
        if self.name.is_empty() {
            return Err(Error::invalid("name", "must not be empty"));
        }
        if !self.arena.iter().all(|half| (SMALLEST_ARENA..=ARENA).contains(half)) {
            return Err(Error::invalid(
                "arena",
                format!(
                    "half-widths must be from {SMALLEST_ARENA} to {ARENA} m, got {:?}",
                    self.arena
                ),
            ));
        }
        if self.walls.len() > MOST_WALLS {
            return Err(Error::invalid(
                "walls",
                format!("must be at most {MOST_WALLS}, got {}", self.walls.len()),
            ));
        }
        for (index, wall) in self.walls.iter().enumerate() {
            self.check_wall(wall)
                .map_err(|problem| Error::invalid("walls", format!("wall {index} {problem}")))?;
        }
        for (argument, region) in [("start", self.start), ("goal", self.goal)] {
            for ([low, high], reach) in [region.x, region.y].into_iter().zip(self.arena) {
                if !(-reach <= low && low <= high && high <= reach) {
                    return Err(Error::invalid(
                        argument,
                        format!(
                            "must be a rectangle [low x, high x, low y, high y] within the arena, \
                             got {region:?}"
                        ),
                    ));
                }
            }
        }
        Ok(())
    }

    fn check_wall(&self, wall: &Wall) -> std::result::Result<(), String> {
        let Wall { centre, half, angle, gap } = wall;
        if !centre.iter().chain(half).chain([angle]).all(|number| number.is_finite()) {
            return Err(format!("must have finite numbers, got {wall:?}"));
        }
        if !half.iter().all(|&half| half > 0.0 && half <= 10.0 * ARENA) {
            return Err(format!("half extents must be above 0 and at most 3 m, got {half:?}"));
        }
        if let Some(Gap { half: open, range: [low, high] }) = gap {
            if !(*open > AGENT_HALF && *open <= half[1]) {
                return Err(format!(
                    "gap: half its width must be above the agent's, {AGENT_HALF} m, and within \
                     the wall, {} m, got {open}",
                    half[1]
                ));
            }
            if !(-half[1] <= *low && low <= high && *high <= half[1]) {
                return Err(format!(
                    "gap: its range must be [low, high] within the wall, +-{} m, got {:?}",
                    half[1],
                    [low, high]
                ));
            }
        }
        if !super::polygon::box_of(centre, half, *angle).overlaps_rectangle(self.arena) {
            return Err("lies outside the arena".into());
        }
        Ok(())
    }

    fn check_scenes(self: &Arc<Self>) -> Result<()> {
        for index in 0..SCENES_CHECKED {
            let scene = self.drawn_scene(0, index);
            for (argument, region) in [("start", self.start), ("goal", self.goal)] {
                if region.free_point(&scene).is_none() {
                    return Err(Error::invalid(
                        argument,
                        format!(
                            "there is no free space in {region:?}: walls fill it, grown by the \
                             agent's half-width of {AGENT_HALF} m"
                        ),
                    ));
                }
            }
            let ends = (self.start.free_point(&scene), self.goal.free_point(&scene));
            if let (Some(start), Some(goal)) = ends {
                if Way::shortest(&scene, start, goal).is_none() {
                    return Err(Error::invalid(
                        "goal",
                        format!(
                            "cannot be reached from the start: no way from {start:?} to {goal:?} \
                             with gaps at {:?}",
                            scene.gaps()
                        ),
                    ));
                }
            }
            if self.gaps().next().is_none() {
                break;
            }
        }
        Ok(())
    }
}

impl Region {
    /// A point of the region where the agent can stand, nearest to its centre on a grid.
    fn free_point(&self, scene: &LayoutScene) -> Option<[f64; 2]> {
        let at =
            |[low, high]: [f64; 2], i: usize| low + (high - low) * i as f64 / (POINTS - 1) as f64;
        let middle = [self.x, self.y].map(|[low, high]| 0.5 * (low + high));
        let points = (0..POINTS * POINTS).map(|i| [at(self.x, i % POINTS), at(self.y, i / POINTS)]);
        let far = |p: &[f64; 2]| (p[0] - middle[0]).hypot(p[1] - middle[1]);
        points
            .filter(|&point| scene.obstacles().contains(point))
            .min_by(|a, b| far(a).total_cmp(&far(b)))
    }
}
