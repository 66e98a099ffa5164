//! One step of the maze: from contact to contact, exactly.
//!
//! The action is a force, held for half a second from rest; velocity is zeroed afterwards.
//!
//! # How it works
//! The agent's centre is a point in [`FreeSpace`]. On each axis its velocity never turns against
//! the force there, so motion on an axis is monotone and in closed form ([`Motion`]). One step
//! repeats, until its time is used up:
//! 1. Which axes are blocked: the agent touches a wall and the force presses on it.
//! 2. No axis blocked: free flight to the first wall that both axes have entered. The axis that
//!    entered last is the one that hits.
//! 3. One axis blocked: slide along the wall until it ends, something is hit or friction has
//!    stopped the agent. Friction takes `FRICTION` times the pressing force off the other one.
//! 4. Both blocked, or friction holds: the agent stays.
//!
//! A hit has no restitution, and its friction takes `FRICTION` times the lost speed off the
//! speed along the wall. A coordinate that meets a wall is set to the wall's, so that touching
//! is equality and rounding never adds up.

use rapier2d_f64::parry::bounding_volume::{Aabb, BoundingVolume};

use super::geometry::{swept, FreeSpace, State, REACH};
use super::motion::Motion;

/// Actions are clipped to `+-ACTION_LIMIT` on each axis.
pub const ACTION_LIMIT: f64 = 3.0;
/// Force of one unit of action, N.
pub const GEAR: f64 = 0.05;
/// Duration of a step, s.
pub const STEP_SECONDS: f64 = 0.5;
/// Coefficient of Coulomb friction between agent and walls.
pub const FRICTION: f64 = 1.0;

/// Far more contacts than a step can have (each is on another face).
const MOST_CONTACTS: usize = 24;

/// How far a force of 1 N carries the agent in one step if it meets nothing, m.
pub(super) const FREE_TRAVEL: f64 = Motion { speed: 0.0, force: 1.0 }.distance(STEP_SECONDS);

/// The state after half a second of `action` (units of [`GEAR`] newtons, clipped to
/// `+-`[`ACTION_LIMIT`]).
///
/// Total on purpose, for inner loops: a component that is NaN counts as no force. The batch
/// functions and the bindings refuse actions that are not finite. A start inside a wall is first
/// pushed out of it ([`FreeSpace::push_out`]); the result is always in free space.
#[inline]
pub fn step(state: &State, action: [f64; 2]) -> State {
    let position = step_within(&state.scene.free_space(), state.position, action);
    State { scene: state.scene, position }
}

/// What an action pushes with, newtons; a component that is NaN with nothing.
#[inline]
pub(super) fn force_of(action: [f64; 2]) -> [f64; 2] {
    action.map(|a| if a.is_nan() { 0.0 } else { GEAR * a.clamp(-ACTION_LIMIT, ACTION_LIMIT) })
}

/// [`step`] from `position` in a scene whose free space is at hand: what rollouts in one scene
/// share. Returns the new position.
pub fn step_within(space: &FreeSpace, position: [f64; 2], action: [f64; 2]) -> [f64; 2] {
    let force = force_of(action);
    let start = space.push_out(position);
    // Most steps meet nothing.
    let end = [start[0] + FREE_TRAVEL * force[0], start[1] + FREE_TRAVEL * force[1]];
    if space.is_clear(start, end) {
        return end;
    }
    space.push_out(Agent::at_rest(start, force).travel(space, STEP_SECONDS))
}

/// What the agent touches.
#[derive(Clone, Copy)]
enum Surface<'a> {
    Border,
    /// A wall, grown by the agent's half-size.
    Wall(&'a Aabb),
}

/// The agent during a step.
struct Agent {
    position: [f64; 2],
    /// Speed along `heading`, m/s, never negative.
    speed: [f64; 2],
    /// Size of the force along `heading`, N, never negative.
    force: [f64; 2],
    /// Sign of force and velocity on each axis: -1, 0 or 1.
    heading: [f64; 2],
}

impl Agent {
    fn at_rest(position: [f64; 2], force: [f64; 2]) -> Self {
        let heading = force.map(|f| if f == 0.0 { 0.0 } else { f.signum() });
        Self { position, speed: [0.0; 2], force: force.map(f64::abs), heading }
    }

    /// Where the agent is after `seconds`.
    fn travel(mut self, space: &FreeSpace, seconds: f64) -> [f64; 2] {
        let mut left = seconds;
        for _ in 0..MOST_CONTACTS {
            let spent = match self.contacts(space) {
                [Some(_), Some(_)] => None,
                [Some(surface), None] => self.slide(space, 1, surface, left),
                [None, Some(surface)] => self.slide(space, 0, surface, left),
                [None, None] => self.fly(space, left),
            };
            match spent {
                Some(time) => left -= time,
                None => break,
            }
        }
        self.position
    }

    /// What the agent presses on along each axis.
    fn contacts<'a>(&self, space: &'a FreeSpace) -> [Option<Surface<'a>>; 2] {
        let mut contacts = [0, 1].map(|axis| {
            (self.heading[axis] * self.position[axis] >= REACH).then_some(Surface::Border)
        });
        for wall in space.walls() {
            for (axis, contact) in contacts.iter_mut().enumerate() {
                let (face, _) = self.ahead(wall, axis);
                let (begins, ends) = self.ahead(wall, 1 - axis);
                // Beside the face, or at its edge and pressed onto it.
                let edge = begins == 0.0 && self.moves(1 - axis);
                let beside = ends > 0.0 && (begins < 0.0 || edge);
                if self.moves(axis) && face == 0.0 && beside {
                    *contact = contact.or(Some(Surface::Wall(wall)));
                    // At a corner, met exactly, one face is enough.
                    break;
                }
            }
        }
        contacts
    }

    fn moves(&self, axis: usize) -> bool {
        self.heading[axis] != 0.0
    }

    /// Distances along the heading of `axis` to where `wall` begins and ends there. An axis that
    /// does not move is measured upwards.
    #[inline]
    fn ahead(&self, wall: &Aabb, axis: usize) -> (f64, f64) {
        let (low, high) =
            (wall.mins[axis] - self.position[axis], wall.maxs[axis] - self.position[axis]);
        if self.heading[axis] < 0.0 {
            (-high, -low)
        } else {
            (low, high)
        }
    }

    /// Distance along the heading of `axis` to the border.
    #[inline]
    fn border_ahead(&self, axis: usize) -> f64 {
        (REACH - self.heading[axis] * self.position[axis]).max(0.0)
    }

    fn motion(&self, axis: usize) -> Motion {
        Motion { speed: self.speed[axis], force: self.force[axis] }
    }

    #[inline]
    fn advance(&mut self, axis: usize, distance: f64) {
        self.position[axis] += self.heading[axis] * distance;
    }

    /// Puts the agent exactly on the face of what it hits.
    fn snap(&mut self, axis: usize, hit: Surface<'_>) {
        self.position[axis] = match hit {
            Surface::Border => REACH * self.heading[axis],
            Surface::Wall(wall) if self.heading[axis] < 0.0 => wall.maxs[axis],
            Surface::Wall(wall) => wall.mins[axis],
        };
    }

    /// Moves with no axis blocked for `left` seconds or until something is hit. Returns the time
    /// spent, or `None` if the step is over.
    fn fly(&mut self, space: &FreeSpace, left: f64) -> Option<f64> {
        let motions = [self.motion(0), self.motion(1)];
        let reach = motions.map(|motion| motion.distance(left));
        let to = [0, 1].map(|axis| self.position[axis] + self.heading[axis] * reach[axis]);
        let swept = swept(self.position, to);

        let mut first: Option<(f64, usize, Surface<'_>)> = None;
        let mut offer = |time: f64, axis, surface| {
            if first.is_none_or(|(earliest, ..)| time < earliest) {
                first = Some((time, axis, surface));
            }
        };
        for axis in 0..2 {
            let border = self.border_ahead(axis);
            if self.moves(axis) && reach[axis] >= border {
                offer(motions[axis].time_of(border, left), axis, Surface::Border);
            }
        }
        for wall in space.walls() {
            if !wall.intersects(&swept) {
                continue;
            }
            let ahead = [self.ahead(wall, 0), self.ahead(wall, 1)];
            let passed = [0, 1].map(|axis| {
                let (begins, ends) = ahead[axis];
                ends <= 0.0 || begins >= reach[axis]
            });
            if passed[0] || passed[1] {
                continue;
            }
            // It is entered when the later axis comes in, if the other has not left by then.
            let entry = [0, 1].map(|axis| motions[axis].time_of(ahead[axis].0, left));
            let axis = usize::from(entry[1] > entry[0]);
            if motions[1 - axis].distance(entry[axis]) < ahead[1 - axis].1 {
                offer(entry[axis], axis, Surface::Wall(wall));
            }
        }

        let Some((time, axis, hit)) = first else {
            self.advance(0, reach[0]);
            self.advance(1, reach[1]);
            return None;
        };
        self.snap(axis, hit);
        let other = 1 - axis;
        self.advance(other, motions[other].distance(time));
        let lost = motions[axis].speed_at(time);
        self.speed[axis] = 0.0;
        self.speed[other] = (motions[other].speed_at(time) - FRICTION * lost).max(0.0);
        Some(time)
    }

    /// Moves on `axis` along a surface that the other axis presses on, for `left` seconds or
    /// until that changes. Returns the time spent, or `None` if the step is over.
    fn slide(
        &mut self,
        space: &FreeSpace,
        axis: usize,
        surface: Surface<'_>,
        left: f64,
    ) -> Option<f64> {
        let across = 1 - axis;
        self.speed[across] = 0.0;
        let motion = Motion {
            speed: self.speed[axis],
            force: self.force[axis] - FRICTION * self.force[across],
        };
        if !self.moves(axis) || (motion.speed == 0.0 && motion.force <= 0.0) {
            return None;
        }
        let lasts = motion.stop_time().map_or(left, |stop| stop.min(left));
        let reach = motion.distance(lasts);

        let mut obstacle = (self.border_ahead(axis), Surface::Border);
        for wall in space.walls() {
            let inside = wall.mins[across] < self.position[across]
                && self.position[across] < wall.maxs[across];
            let (begins, _) = self.ahead(wall, axis);
            if inside && begins >= 0.0 && begins < obstacle.0 {
                obstacle = (begins, Surface::Wall(wall));
            }
        }
        if let Surface::Wall(wall) = surface {
            let (_, ends) = self.ahead(wall, axis);
            if ends <= reach && ends < obstacle.0 {
                let time = motion.time_of(ends, lasts);
                self.speed[axis] = motion.speed_at(time).max(0.0);
                self.position[axis] =
                    if self.heading[axis] < 0.0 { wall.mins[axis] } else { wall.maxs[axis] };
                return Some(time);
            }
        }
        if reach < obstacle.0 {
            self.advance(axis, reach);
        } else {
            // Pressed on two surfaces at once: a corner, where the agent stays.
            self.snap(axis, obstacle.1);
        }
        None
    }
}
