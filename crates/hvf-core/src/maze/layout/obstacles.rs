//! Where the agent's centre can be among the walls of a scene.

use rapier2d_f64::parry::bounding_volume::{Aabb, BoundingVolume};
use rapier2d_f64::parry::partitioning::{Bvh, BvhBuildStrategy};

use super::polygon::{Grown, TurnedBox};
use crate::maze::geometry::{swept, AGENT_HALF};

/// Up to this many boxes each is looked at; more are found by parry's bounding volume hierarchy.
const LOOKED_AT: usize = 24;
/// Depth in a wall that counts as touching, m: rounding of contacts with turned walls.
pub const SLACK: f64 = 1e-8;

/// The arena shrunk by the agent's half-width, and walls grown by it (Minkowski sums): the
/// agent's centre is a point among them.
#[derive(Clone, Debug)]
pub struct Obstacles {
    pub(super) reach: [f64; 2],
    pub(super) walls: Vec<Grown>,
    tree: Option<Bvh>,
}

impl Obstacles {
    pub(super) fn new(arena: [f64; 2], boxes: &[TurnedBox]) -> Self {
        let walls: Vec<Grown> = boxes.iter().map(|wall| wall.grown(AGENT_HALF)).collect();
        let bounds: Vec<Aabb> = walls.iter().map(|wall| wall.bounds).collect();
        let tree = (walls.len() > LOOKED_AT)
            .then(|| Bvh::from_leaves(BvhBuildStrategy::default(), &bounds));
        Self { reach: arena.map(|half| half - AGENT_HALF), walls, tree }
    }

    /// The agent's centre stays within plus and minus these, m.
    pub fn reach(&self) -> [f64; 2] {
        self.reach
    }

    /// Calls `visit` with the number of each wall whose bounds touch `bounds`.
    #[inline]
    pub(super) fn near(&self, bounds: &Aabb, mut visit: impl FnMut(usize)) {
        match &self.tree {
            Some(tree) => tree.intersect_aabb(bounds).for_each(|wall| visit(wall as usize)),
            None => {
                for (index, wall) in self.walls.iter().enumerate() {
                    if wall.bounds.intersects(bounds) {
                        visit(index);
                    }
                }
            }
        }
    }

    /// Whether the agent can stand at `position`; touching is allowed.
    pub fn contains(&self, position: [f64; 2]) -> bool {
        self.penetration(position) <= SLACK
    }

    /// How far `position` is inside a wall or beyond the border, m (0 or less if it is in
    /// neither).
    pub fn penetration(&self, position: [f64; 2]) -> f64 {
        let beyond = [0, 1].map(|axis| position[axis].abs() - self.reach[axis]);
        let mut deepest = beyond[0].max(beyond[1]);
        self.near(&swept(position, position), |wall| {
            deepest = deepest.max(self.walls[wall].depth(position));
        });
        deepest
    }

    /// Whether the agent surely meets nothing on the straight line between two places.
    #[inline]
    pub(super) fn is_clear(&self, start: [f64; 2], end: [f64; 2]) -> bool {
        if !(end[0].abs() <= self.reach[0] && end[1].abs() <= self.reach[1]) {
            return false;
        }
        let mut clear = true;
        self.near(&swept(start, end), |_| clear = false);
        clear
    }

    /// Whether the agent can go from `start` to `end` in a straight line, which may touch walls.
    pub fn sees(&self, start: [f64; 2], end: [f64; 2]) -> bool {
        if self.is_clear(start, end) {
            return true;
        }
        if !(self.contains(start) && self.contains(end)) {
            return false;
        }
        let mut free = true;
        self.near(&swept(start, end), |wall| {
            let (mut enters, mut leaves) = (0.0_f64, 1.0_f64);
            for face in &self.walls[wall].faces {
                let (from, to) = (face.distance(start) + SLACK, face.distance(end) + SLACK);
                if from >= 0.0 && to >= 0.0 {
                    leaves = -1.0;
                } else if from > 0.0 {
                    enters = enters.max(from / (from - to));
                } else if to > 0.0 {
                    leaves = leaves.min(from / (from - to));
                }
            }
            free &= enters >= leaves;
        });
        free
    }

    /// `position`, moved to a place nearby where the agent can stand if it is not in one.
    pub fn push_out(&self, position: [f64; 2]) -> [f64; 2] {
        let within = |p: [f64; 2]| [0, 1].map(|i| p[i].clamp(-self.reach[i], self.reach[i]));
        let start = within(position);
        let mut here = start;
        for _ in 0..4 {
            let (mut deepest, mut wall) = (SLACK, None);
            self.near(&swept(here, here), |index| {
                let depth = self.walls[index].depth(here);
                if depth > deepest {
                    (deepest, wall) = (depth, Some(index));
                }
            });
            let Some(wall) = wall else {
                return here;
            };
            // Out of the wall by the nearest face that is within the arena.
            let exit = |face: &super::polygon::Face| {
                let back = -face.distance(here);
                (back, [0, 1].map(|i| here[i] + back * face.normal[i]))
            };
            let inside = |p: [f64; 2]| [0, 1].iter().all(|&i| p[i].abs() <= self.reach[i]);
            let exits = self.walls[wall].faces.iter().map(exit).filter(|(_, p)| inside(*p));
            match exits.min_by(|a, b| a.0.total_cmp(&b.0)) {
                Some((_, out)) => here = out,
                None => break,
            }
        }
        if self.contains(here) {
            here
        } else {
            self.nearest_free(start)
        }
    }

    /// The nearest of a fan of places around `start` where the agent can stand.
    fn nearest_free(&self, start: [f64; 2]) -> [f64; 2] {
        const STEP: f64 = 0.0025;
        const SPOKES: usize = 64;
        let widest = 2.0 * self.reach[0].hypot(self.reach[1]);
        let rings = (widest / STEP).ceil() as usize;
        for ring in 1..=rings {
            for spoke in 0..SPOKES {
                let turn = std::f64::consts::TAU * spoke as f64 / SPOKES as f64;
                let radius = STEP * ring as f64;
                let p = [start[0] + radius * libm::cos(turn), start[1] + radius * libm::sin(turn)];
                if self.contains(p) {
                    return p;
                }
            }
        }
        start
    }
}
