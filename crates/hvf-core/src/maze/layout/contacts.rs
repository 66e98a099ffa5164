//! What the agent touches, runs into and is pressed on.

use super::polygon::dot;
use super::step::Agent;
use crate::maze::physics::FRICTION;

/// Distance to a face at which it is touched, m; walls are entered this deep to be hit.
pub(super) const TOUCH: f64 = 1e-9;
/// Speeds below this are none, m/s.
pub(super) const STILL: f64 = 1e-12;
/// Sine of an angle below which directions are along a face.
pub(super) const ALONG: f64 = 1e-9;
/// Faces that can be touched at once.
const MOST_TOUCHED: usize = 8;

/// A line that the agent must stay in front of, and touches.
#[derive(Clone, Copy, Debug)]
pub(super) struct Contact {
    /// Number of the wall; `None` for the border.
    pub wall: Option<usize>,
    /// Unit vector away from the wall.
    pub normal: [f64; 2],
    /// Where the face ends, clockwise and anticlockwise about the wall.
    pub ends: Option<[[f64; 2]; 2]>,
}

impl Contact {
    pub fn along(&self) -> [f64; 2] {
        [-self.normal[1], self.normal[0]]
    }
}

/// What is touched at one place.
pub(super) struct Touched {
    contacts: [Contact; MOST_TOUCHED],
    count: usize,
}

impl Touched {
    pub fn iter(&self) -> impl Iterator<Item = &Contact> + Clone {
        self.contacts[..self.count].iter()
    }
}

impl Agent<'_> {
    /// Direction of motion, or else of the force; zero if there is neither.
    fn heading(&self) -> [f64; 2] {
        let speed = self.speed();
        if speed > STILL {
            return self.velocity.map(|v| v / speed);
        }
        let force = self.force[0].hypot(self.force[1]);
        if force > 0.0 {
            self.force.map(|f| f / force)
        } else {
            [0.0; 2]
        }
    }

    pub fn presses(&self, contact: &Contact) -> bool {
        dot(contact.normal, self.force) < 0.0
    }

    /// The faces that the agent touches; if it is a hair inside a wall, it is put on its face.
    pub fn touched(&mut self) -> Touched {
        let none = Contact { wall: None, normal: [0.0; 2], ends: None };
        let mut touched = Touched { contacts: [none; MOST_TOUCHED], count: 0 };
        for axis in 0..2 {
            for sign in [-1.0, 1.0] {
                if sign * self.position[axis] >= self.space.reach[axis] - TOUCH {
                    self.position[axis] = sign * self.space.reach[axis];
                    let mut normal = [0.0; 2];
                    normal[axis] = -sign;
                    touched.contacts[touched.count] = Contact { normal, ..none };
                    touched.count += 1;
                }
            }
        }
        let heading = self.heading();
        for &index in &self.near {
            if touched.count == MOST_TOUCHED {
                break;
            }
            let wall = &self.space.walls[index];
            let furthest = wall.faces.iter().map(|face| face.distance(self.position));
            let furthest = furthest.fold(f64::NEG_INFINITY, f64::max);
            if furthest > 2.0 * TOUCH {
                continue;
            }
            // At a corner of the wall: the face that is pressed on least.
            let faces = wall
                .faces
                .iter()
                .filter(|face| face.distance(self.position) >= furthest - 2.0 * TOUCH);
            let least =
                faces.max_by(|a, b| dot(a.normal, heading).total_cmp(&dot(b.normal, heading)));
            let Some(face) = least else {
                continue;
            };
            let deep = face.distance(self.position);
            if deep < 0.0 {
                self.position = [0, 1].map(|i| self.position[i] - deep * face.normal[i]);
            }
            touched.contacts[touched.count] =
                Contact { wall: Some(index), normal: face.normal, ends: Some(face.ends) };
            touched.count += 1;
        }
        touched
    }

    /// Takes off the speed into faces, and friction's part of the speed along them.
    pub fn collide(&mut self, touched: &Touched) {
        let into = |velocity, contact: &Contact| -dot(contact.normal, velocity);
        // One face after another; between two that face each other nothing is left.
        for _ in 0..4 {
            let speed = self.speed();
            if speed <= STILL {
                return;
            }
            let velocity = self.velocity;
            let hardest = touched
                .iter()
                .max_by(|a, b| into(velocity, a).total_cmp(&into(velocity, b)))
                .filter(|contact| into(velocity, contact) > ALONG * speed);
            let Some(contact) = hardest else {
                return;
            };
            let along = contact.along();
            let tangential = dot(along, velocity);
            let kept = (tangential.abs() - FRICTION * into(velocity, contact)).max(0.0);
            self.velocity = along.map(|t| t * tangential.signum() * kept);
        }
        self.velocity = [0.0; 2];
    }

    /// The face that the moving agent slides along, if the force presses on one.
    pub fn pressed_while_moving(&self, touched: &Touched) -> Option<Contact> {
        let speed = self.speed();
        let along = |contact: &&Contact| {
            dot(contact.normal, self.velocity).abs() <= ALONG * speed && self.presses(contact)
        };
        self.hardest(touched.iter().filter(along))
    }

    fn hardest<'c>(&self, contacts: impl Iterator<Item = &'c Contact>) -> Option<Contact> {
        let press = |contact: &Contact| -dot(contact.normal, self.force);
        contacts.max_by(|a, b| press(a).total_cmp(&press(b))).copied()
    }

    /// The face along which the force moves an agent at rest; `None` if friction or a corner
    /// holds it.
    pub fn gives_way(&self, touched: &Touched) -> Option<Contact> {
        let free = |contact: &&Contact| {
            let along = contact.along();
            let (tangential, normal) = (dot(along, self.force), dot(contact.normal, self.force));
            let direction = along.map(|t| t * tangential.signum());
            normal < 0.0
                && tangential.abs() > -FRICTION * normal
                && touched.iter().all(|other| dot(other.normal, direction) >= -ALONG)
        };
        self.hardest(touched.iter().filter(free))
    }
}
