//! One step in any layout: from contact to contact, exactly.
//!
//! # How it works
//! The agent's centre is a point among grown walls, convex polygons ([`Obstacles`]). Between
//! contacts its motion is in closed form along any direction ([`Motion`]), hence so is its
//! distance to the line of a face. One step repeats, until its time is used up:
//! 1. What it runs into stops it: the speed into a face is lost, and `FRICTION` times as much of
//!    the speed along the face. At a corner one face after another does so.
//! 2. Pressed on a face it slides along it, or stays: friction takes `FRICTION` times the pressing
//!    force off the force along the face, against the motion. It slides until the face ends, a
//!    wall is in the way or friction has stopped it.
//! 3. Else it flies until it enters a wall: until it is behind the lines of all its faces.
//!
//! At the corner of one wall only the face that leaves most room counts, so nothing sticks there.
//! Rules and numbers are those of [`step_within`](crate::maze::step_within), which knows walls
//! along the axes only.

use rapier2d_f64::parry::bounding_volume::{Aabb, BoundingVolume};
use rapier2d_f64::parry::math::Vector;

use super::contacts::{Contact, ALONG, STILL, TOUCH};
use super::obstacles::Obstacles;
use super::polygon::dot;
use crate::maze::motion::Motion;
use crate::maze::physics::{force_of, FREE_TRAVEL, FRICTION, STEP_SECONDS};

/// Rounding of a distance, m.
const HAIR: f64 = 1e-12;
/// Far more contacts than a step can have.
const MOST_CONTACTS: usize = 200;

/// The position after half a second of `action` (as [`step`](crate::maze::step) takes it) from
/// `position`, where the agent is at rest.
///
/// Total on purpose, as [`step`](crate::maze::step): a component that is NaN counts as no force,
/// a start inside a wall is first pushed out of it.
pub fn step_in(space: &Obstacles, position: [f64; 2], action: [f64; 2]) -> [f64; 2] {
    let force = force_of(action);
    let start = space.push_out(position);
    let end = [start[0] + FREE_TRAVEL * force[0], start[1] + FREE_TRAVEL * force[1]];
    if space.is_clear(start, end) {
        return end;
    }
    // Contacts turn the speed but never add to it, so the agent gets no further than this.
    let far = FREE_TRAVEL * force[0].hypot(force[1]) + 2.0 * TOUCH;
    let around = Aabb::from_half_extents(Vector::from(start), Vector::new(far, far));
    let mut near = Vec::with_capacity(16);
    space.near(&around, |wall| near.push(wall));
    near.sort_unstable();
    let agent = Agent { space, near, position: start, velocity: [0.0; 2], force };
    space.push_out(agent.travel(STEP_SECONDS))
}

/// What comes next along a line: a distance, and the wall in the way.
struct Obstacle {
    distance: f64,
    normal: [f64; 2],
    offset: f64,
}

/// The agent during a step.
pub(super) struct Agent<'a> {
    pub space: &'a Obstacles,
    /// Walls within reach.
    pub near: Vec<usize>,
    pub position: [f64; 2],
    /// m/s.
    pub velocity: [f64; 2],
    /// N.
    pub force: [f64; 2],
}

impl Agent<'_> {
    /// Where the agent is after `seconds`.
    fn travel(mut self, seconds: f64) -> [f64; 2] {
        let mut left = seconds;
        for _ in 0..MOST_CONTACTS {
            let touched = self.touched();
            self.collide(&touched);
            let spent = if self.speed() > STILL {
                match self.pressed_while_moving(&touched) {
                    Some(contact) => self.slide(contact, left),
                    None => self.fly(left),
                }
            } else {
                self.velocity = [0.0; 2];
                if touched.iter().any(|contact| self.presses(contact)) {
                    match self.gives_way(&touched) {
                        Some(contact) => self.slide(contact, left),
                        None => None,
                    }
                } else {
                    self.fly(left)
                }
            };
            match spent {
                Some(time) => left -= time,
                None => break,
            }
            if left <= 0.0 {
                break;
            }
        }
        self.position
    }

    pub fn speed(&self) -> f64 {
        self.velocity[0].hypot(self.velocity[1])
    }

    /// Moves along a face that the force presses on, for `left` seconds or until that changes.
    /// Returns the time spent.
    fn slide(&mut self, contact: Contact, left: f64) -> Option<f64> {
        let along = contact.along();
        let (speed, pull) = (dot(along, self.velocity), dot(along, self.force));
        let sign = if speed == 0.0 { pull.signum() } else { speed.signum() };
        let friction = FRICTION * -dot(contact.normal, self.force);
        let motion = Motion { speed: speed.abs(), force: sign * pull - friction };
        let direction = along.map(|t| sign * t);
        let lasts = motion.stop_time().map_or(left, |stop| stop.min(left));
        let reach = motion.distance(lasts).max(0.0);
        let end = contact.ends.map(|ends| {
            let end = ends[usize::from(sign > 0.0)];
            let away = [end[0] - self.position[0], end[1] - self.position[1]];
            (dot(direction, away).max(0.0), end)
        });
        let obstacle = self.first_in_line(direction, reach, contact.wall);
        let blocked = obstacle.as_ref().map_or(f64::INFINITY, |obstacle| obstacle.distance);
        match end {
            Some((distance, end)) if distance <= reach && distance <= blocked => {
                let time = motion.time_of(distance, lasts);
                self.set_speed(direction, motion.speed_at(time));
                self.position = end;
                Some(time)
            }
            _ => match obstacle {
                Some(Obstacle { distance, normal, offset }) => {
                    let time = motion.time_of(distance, lasts);
                    self.set_speed(direction, motion.speed_at(time));
                    self.advance(direction, distance);
                    self.put_on(normal, offset);
                    Some(time)
                }
                None => {
                    self.advance(direction, reach);
                    // Stopped by friction: it may still turn back.
                    self.velocity = [0.0; 2];
                    (lasts < left).then_some(lasts)
                }
            },
        }
    }

    fn set_speed(&mut self, direction: [f64; 2], speed: f64) {
        self.velocity = direction.map(|d| d * speed.max(0.0));
    }

    fn advance(&mut self, direction: [f64; 2], distance: f64) {
        self.position = [0, 1].map(|i| self.position[i] + distance * direction[i]);
    }

    /// Puts the agent exactly on the line that it has reached.
    fn put_on(&mut self, normal: [f64; 2], offset: f64) {
        let off = dot(normal, self.position) - offset;
        self.position = [0, 1].map(|i| self.position[i] - off * normal[i]);
    }

    /// What is in the way within `reach` of a straight line, other than one wall.
    fn first_in_line(
        &self,
        direction: [f64; 2],
        reach: f64,
        but: Option<usize>,
    ) -> Option<Obstacle> {
        let mut first: Option<Obstacle> = None;
        let mut offer = |distance: f64, normal, offset| {
            let nearest = first.as_ref().map_or(reach, |first| first.distance);
            if distance <= nearest && (first.is_none() || distance < nearest) {
                first = Some(Obstacle { distance: distance.max(0.0), normal, offset });
            }
        };
        for axis in 0..2 {
            if direction[axis] != 0.0 {
                let sign = direction[axis].signum();
                let ahead = self.space.reach[axis] - sign * self.position[axis];
                let mut normal = [0.0; 2];
                normal[axis] = -sign;
                // A face that runs along the border never meets it.
                if direction[axis].abs() > ALONG {
                    offer(ahead / direction[axis].abs(), normal, -self.space.reach[axis]);
                }
            }
        }
        for &index in self.near.iter().filter(|&&index| Some(index) != but) {
            let (mut enters, mut leaves, mut face) = (f64::NEG_INFINITY, f64::INFINITY, None);
            for candidate in &self.space.walls[index].faces {
                let distance = candidate.distance(self.position) + TOUCH;
                let slope = dot(candidate.normal, direction);
                if slope < -ALONG {
                    let at = -distance / slope;
                    if at > enters {
                        (enters, face) = (at, Some(candidate));
                    }
                } else if slope > ALONG {
                    leaves = leaves.min(-distance / slope);
                } else if distance >= 0.0 {
                    leaves = f64::NEG_INFINITY;
                }
            }
            if let Some(face) = face.filter(|_| enters < leaves && leaves > 0.0) {
                offer(enters, face.normal, face.offset);
            }
        }
        first
    }

    /// Moves with nothing pressed on, for `left` seconds or until something is hit. Returns the
    /// time spent, or `None` if the step is over.
    fn fly(&mut self, left: f64) -> Option<f64> {
        let motion = |direction: [f64; 2]| Motion {
            speed: dot(direction, self.velocity),
            force: dot(direction, self.force),
        };
        let axes = [motion([1.0, 0.0]), motion([0.0, 1.0])];
        let place = |time: f64| [0, 1].map(|i| self.position[i] + axes[i].distance(time));
        let to = place(left);
        // What it may pass through: a coordinate that turns round goes furthest there.
        let mut ends = [self.position, to];
        for axis in 0..2 {
            if let Some(turn) = axes[axis].turn_time().filter(|&turn| turn > 0.0 && turn < left) {
                let furthest = self.position[axis] + axes[axis].distance(turn);
                let [low, high] =
                    [ends[0][axis].min(ends[1][axis]), ends[0][axis].max(ends[1][axis])];
                (ends[0][axis], ends[1][axis]) = (low.min(furthest), high.max(furthest));
            }
        }
        let swept = crate::maze::geometry::swept(ends[0], ends[1]);

        let mut first: Option<(f64, [f64; 2], f64)> = None;
        for axis in 0..2 {
            for sign in [-1.0, 1.0] {
                let reach = self.space.reach[axis];
                if sign * swept.mins[axis] < reach && sign * swept.maxs[axis] < reach {
                    continue;
                }
                let mut normal = [0.0; 2];
                normal[axis] = -sign;
                let height = reach - sign * self.position[axis] + TOUCH;
                let latest = first.map_or(left, |(time, ..)| time);
                if let Some(time) = motion(normal).falls_below(height, 0.0, latest) {
                    first = Some((time, normal, -reach));
                }
            }
        }
        for &index in &self.near {
            let wall = &self.space.walls[index];
            if !wall.bounds.intersects(&swept) {
                continue;
            }
            // It is inside once it is behind all faces: from one that it is in front of to the
            // time when it gets behind that, until there is none.
            let latest = first.map_or(left, |(time, ..)| time);
            let (mut time, mut entered) = (0.0, None);
            loop {
                let here = if time == 0.0 { self.position } else { place(time) };
                let ahead = |face: &&super::polygon::Face| face.distance(here) + TOUCH > HAIR;
                let Some(face) = wall.faces.iter().find(ahead) else {
                    break;
                };
                let height = face.distance(self.position) + TOUCH;
                match motion(face.normal).falls_below(height, time, latest) {
                    // Rounding may leave it a hair in front for good.
                    Some(next) => {
                        (time, entered) = (next.max(time + 1e-15), Some(face));
                    }
                    None => {
                        entered = None;
                        time = f64::INFINITY;
                        break;
                    }
                }
            }
            if let Some(face) = entered.filter(|_| time < latest) {
                first = Some((time, face.normal, face.offset));
            }
        }
        let Some((time, normal, offset)) = first else {
            self.position = to;
            return None;
        };
        self.position = place(time);
        self.put_on(normal, offset);
        self.velocity = axes.map(|motion| motion.speed_at(time));
        Some(time)
    }
}
