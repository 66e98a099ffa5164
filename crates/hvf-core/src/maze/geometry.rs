//! The maze as shapes: the arena, its two walls with one gap each, and where the agent can be.
//!
//! Lengths are metres, `y` points up, the origin is the centre of the arena. The agent is an
//! axis-aligned square that cannot turn, so its centre is a point among walls grown by its
//! half-size (their Minkowski sum), and all questions of contact are about that point.

use rapier2d_f64::parry::bounding_volume::{Aabb, BoundingVolume};
use rapier2d_f64::parry::math::Vector;

use crate::{Error, Result};

/// Half the width of the square arena, m: border walls begin at `+-ARENA`.
pub const ARENA: f64 = 0.3;
/// Half the width of the square agent, m.
pub const AGENT_HALF: f64 = 0.025;
/// The agent's centre stays within `+-REACH`, m.
pub const REACH: f64 = ARENA - AGENT_HALF;
/// Where the two inner walls stand: `x` of their centre lines, m.
pub const WALL_X: [f64; 2] = [-0.15, 0.15];
/// Half the thickness of an inner wall, m.
pub const WALL_HALF: f64 = 0.005;
/// Half the width of a gap, m.
pub const GAP_HALF: f64 = 0.05;
/// Gap centres are drawn from `+-GAP_RANGE`, m.
pub const GAP_RANGE: f64 = 0.2;
/// Largest gap centre a scene may have, m: there the gap touches the border.
pub const GAP_LIMIT: f64 = ARENA - GAP_HALF;
/// Thickness of the border walls as drawn, m.
pub const BORDER: f64 = 0.01;

/// One maze: where the gaps of its two walls are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scene {
    /// `y` of the gap centres of the left and the right wall, m.
    pub gap_y: [f64; 2],
}

impl Scene {
    /// A scene with gaps centred at `gap_y`.
    ///
    /// # Errors
    /// A gap that is not finite or lies beyond [`GAP_LIMIT`].
    pub fn new(gap_y: [f64; 2]) -> Result<Self> {
        if gap_y.iter().all(|y| y.abs() <= GAP_LIMIT) {
            Ok(Self { gap_y })
        } else {
            Err(Error::invalid(
                "gap_y",
                format!("gap centres must be within +-{GAP_LIMIT} m, got {gap_y:?}"),
            ))
        }
    }

    /// The four boxes that the two inner walls consist of: left below, left above, right below,
    /// right above their gap.
    pub fn walls(&self) -> [Aabb; 4] {
        let piece = |wall: usize, low: f64, high: f64| {
            Aabb::new(
                Vector::new(WALL_X[wall] - WALL_HALF, low),
                Vector::new(WALL_X[wall] + WALL_HALF, high),
            )
        };
        let [left, right] = self.gap_y;
        [
            piece(0, -ARENA, left - GAP_HALF),
            piece(0, left + GAP_HALF, ARENA),
            piece(1, -ARENA, right - GAP_HALF),
            piece(1, right + GAP_HALF, ARENA),
        ]
    }

    /// Where the agent's centre can be.
    pub fn free_space(&self) -> FreeSpace {
        let agent = Vector::new(AGENT_HALF, AGENT_HALF);
        FreeSpace { walls: self.walls().map(|wall| wall.add_half_extents(agent)) }
    }
}

/// A scene and where the agent stands in it; velocity is always zero between steps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct State<S = Scene> {
    /// The maze: the paper's [`Scene`] or another layout's.
    pub scene: S,
    /// Centre of the agent `[x, y]`, m.
    pub position: [f64; 2],
}

impl State {
    /// A state from its row `[x, y, w1, w2]`.
    ///
    /// A position inside a wall is allowed (recorded data has such); [`step`](super::step) first
    /// pushes it out.
    ///
    /// # Errors
    /// A position that is not finite or outside the arena, or a gap that [`Scene::new`] refuses.
    pub fn from_row([x, y, w1, w2]: [f64; 4]) -> Result<Self> {
        let scene = Scene::new([w1, w2])?;
        if x.abs() <= ARENA && y.abs() <= ARENA {
            Ok(Self { scene, position: [x, y] })
        } else {
            Err(Error::invalid(
                "position",
                format!("must be within the arena, +-{ARENA} m, got [{x}, {y}]"),
            ))
        }
    }

    /// The row `[x, y, w1, w2]` of this state.
    pub fn to_row(&self) -> [f64; 4] {
        let [x, y] = self.position;
        let [w1, w2] = self.scene.gap_y;
        [x, y, w1, w2]
    }

    /// How many walls are to the left of the agent: 0, 1 or 2 for the left, middle and right
    /// section of the maze.
    pub fn section(&self) -> usize {
        WALL_X.iter().filter(|&&wall| self.position[0] > wall).count()
    }
}

/// Where the agent's centre can be in one scene: the arena shrunk by the agent's half-size,
/// without the insides of the walls grown by it.
#[derive(Clone, Copy, Debug)]
pub struct FreeSpace {
    walls: [Aabb; 4],
}

impl FreeSpace {
    /// The inner walls grown by the agent's half-size; their faces still belong to free space.
    pub fn walls(&self) -> &[Aabb; 4] {
        &self.walls
    }

    /// Whether the agent can stand at `position`; touching is allowed.
    pub fn contains(&self, position: [f64; 2]) -> bool {
        self.penetration(position) <= 0.0
    }

    /// How far `position` is inside a wall or beyond the border, m (0 or less if it is in
    /// neither).
    pub fn penetration(&self, position: [f64; 2]) -> f64 {
        let beyond = position[0].abs().max(position[1].abs()) - REACH;
        self.walls.iter().map(|wall| depth(wall, position)).fold(beyond, f64::max)
    }

    /// Whether the agent surely meets nothing on its way from `start`, where it can stand, to
    /// `end`, if it moves monotonously on both axes.
    #[inline]
    pub fn is_clear(&self, start: [f64; 2], end: [f64; 2]) -> bool {
        let swept = swept(start, end);
        end[0].abs() <= REACH
            && end[1].abs() <= REACH
            && !self.walls.iter().any(|wall| wall.intersects(&swept))
    }

    /// `position`, moved to the nearest place where the agent can stand if it is not in one:
    /// first into the arena, then out of a wall along the axis of least penetration.
    pub fn push_out(&self, position: [f64; 2]) -> [f64; 2] {
        let mut position = position.map(|p| p.clamp(-REACH, REACH));
        for (index, wall) in self.walls.iter().enumerate() {
            if depth(wall, position) <= 0.0 {
                continue;
            }
            let gap_side = if index % 2 == 0 { wall.maxs.y } else { wall.mins.y };
            let exits = [(0, wall.mins.x), (0, wall.maxs.x), (1, gap_side)];
            let mut nearest = exits[0];
            for exit in exits {
                if (exit.1 - position[exit.0]).abs() < (nearest.1 - position[nearest.0]).abs() {
                    nearest = exit;
                }
            }
            position[nearest.0] = nearest.1;
        }
        position
    }
}

/// What a centre that moves from `start` to `end`, monotonously on both axes, may pass through.
pub(super) fn swept(start: [f64; 2], end: [f64; 2]) -> Aabb {
    let (start, end) = (Vector::from(start), Vector::from(end));
    Aabb::new(start.min(end), start.max(end))
}

/// Distance from a point inside `wall` to its nearest face; 0 or less outside.
fn depth(wall: &Aabb, position: [f64; 2]) -> f64 {
    let x = (position[0] - wall.mins.x).min(wall.maxs.x - position[0]);
    let y = (position[1] - wall.mins.y).min(wall.maxs.y - position[1]);
    x.min(y)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;
    use rapier2d_f64::parry::math::Pose;
    use rapier2d_f64::parry::query::intersection_test;
    use rapier2d_f64::parry::shape::Cuboid;

    #[test]
    fn rows_round_trip_and_bad_rows_name_what_is_wrong() {
        let row = [0.1, -0.2, 0.05, -0.25];
        assert_eq!(State::from_row(row).unwrap().to_row(), row);
        for (row, argument) in [
            ([0.31, 0.0, 0.0, 0.0], "position"),
            ([0.0, f64::NAN, 0.0, 0.0], "position"),
            ([0.0, 0.0, 0.26, 0.0], "gap_y"),
            ([0.0, 0.0, 0.0, f64::INFINITY], "gap_y"),
        ] {
            assert!(State::from_row(row).unwrap_err().to_string().starts_with(argument));
        }
    }

    #[test]
    fn sections_are_counted_by_walls() {
        let at = |x| State { scene: Scene { gap_y: [0.0; 2] }, position: [x, 0.0] }.section();
        assert_eq!([at(-0.2), at(-0.1), at(0.1), at(0.2)], [0, 1, 1, 2]);
    }

    proptest! {
        #[test]
        fn free_space_agrees_with_parrys_intersection_of_cuboids(
            x in -0.275..0.275f64, y in -0.275..0.275f64, w1 in -0.25..0.25f64, w2 in -0.25..0.25f64
        ) {
            let scene = Scene::new([w1, w2]).unwrap();
            let agent = Cuboid::new(Vector::new(AGENT_HALF, AGENT_HALF));
            let touches = scene.walls().iter().any(|wall| {
                let at = Pose::from_translation(wall.center());
                let here = Pose::from_translation(Vector::new(x, y));
                intersection_test(&here, &agent, &at, &Cuboid::new(wall.half_extents())).unwrap().intersecting
            });
            prop_assert_eq!(scene.free_space().contains([x, y]), !touches);
        }

        #[test]
        fn pushing_out_ends_in_free_space_and_moves_no_further_than_needed(
            x in -0.5..0.5f64, y in -0.5..0.5f64, w1 in -0.25..0.25f64, w2 in -0.25..0.25f64
        ) {
            let space = Scene::new([w1, w2]).unwrap().free_space();
            let out = space.push_out([x, y]);
            prop_assert!(space.contains(out));
            if space.contains([x, y]) {
                prop_assert_eq!(out, [x, y]);
            } else if x.abs() <= REACH && y.abs() <= REACH {
                let moved = (out[0] - x).abs() + (out[1] - y).abs();
                prop_assert!(moved <= 0.06, "{moved}");
            }
        }
    }
}
