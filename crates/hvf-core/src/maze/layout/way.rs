//! The shortest way through a scene, exactly.
//!
//! Among convex obstacles a shortest way consists of straight lines between their corners, so it
//! is found by A* on the corners of the grown walls, each joined to those that it sees.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use super::obstacles::Obstacles;
use super::scene::LayoutScene;

/// How far a place is moved to have more room, m.
const MOVED: f64 = 0.02;
/// Room that is enough, m.
const ROOM: f64 = 0.02;

/// A way of straight lines.
#[derive(Clone, Debug, PartialEq)]
pub struct Way {
    /// Where it begins, turns and ends, m.
    pub turns: Vec<[f64; 2]>,
}

impl Way {
    /// A straight line.
    pub fn straight(start: [f64; 2], goal: [f64; 2]) -> Self {
        Self { turns: vec![start, goal] }
    }

    /// The shortest way of the agent's centre in a scene; `None` if there is none.
    pub fn shortest(scene: &LayoutScene, start: [f64; 2], goal: [f64; 2]) -> Option<Self> {
        let space = scene.obstacles();
        let (start, goal) = (space.push_out(start), space.push_out(goal));
        if space.sees(start, goal) {
            return Some(Self::straight(start, goal));
        }
        let mut places = vec![start, goal];
        places.extend(space.corners());
        let count = places.len();
        let mut lengths = vec![f64::INFINITY; count];
        let mut from = vec![0; count];
        let mut done = vec![false; count];
        let mut open = BinaryHeap::from([Entry { length: apart(start, goal), place: 0 }]);
        lengths[0] = 0.0;
        while let Some(Entry { place, .. }) = open.pop() {
            if std::mem::replace(&mut done[place], true) {
                continue;
            }
            if place == 1 {
                let mut turns = vec![goal];
                let mut at = place;
                while at != 0 {
                    at = from[at];
                    turns.push(places[at]);
                }
                turns.reverse();
                return Some(Self { turns });
            }
            for next in 1..count {
                if done[next] {
                    continue;
                }
                let length = lengths[place] + apart(places[place], places[next]);
                if length < lengths[next] && space.sees(places[place], places[next]) {
                    (lengths[next], from[next]) = (length, place);
                    open.push(Entry { length: length + apart(places[next], goal), place: next });
                }
            }
        }
        None
    }

    /// Its length, m.
    pub fn length(&self) -> f64 {
        self.turns.windows(2).map(|pair| apart(pair[0], pair[1])).sum()
    }

    /// The place at a part of its length, 0 to 1.
    pub fn at(&self, part: f64) -> [f64; 2] {
        if part >= 1.0 {
            return self.turns.last().copied().unwrap_or_default();
        }
        let mut left = part.max(0.0) * self.length();
        for pair in self.turns.windows(2) {
            let length = apart(pair[0], pair[1]);
            if left <= length && length > 0.0 {
                let [a, b] = [pair[0], pair[1]];
                return [0, 1].map(|i| a[i] + left / length * (b[i] - a[i]));
            }
            left -= length;
        }
        self.turns.last().copied().unwrap_or_default()
    }
}

impl Way {
    /// `count` places on the way between its ends, in order: its turns, as far as there are so
    /// many, so that straight lines lead from one to the next.
    ///
    /// With more places than turns, straight lines are divided, the longest parts first. With
    /// fewer, each is the turn nearest to where equal parts of the length would end.
    pub fn places(&self, count: usize) -> Vec<[f64; 2]> {
        let turns = self.turns.len().saturating_sub(2);
        if count >= turns {
            return self.divided(count - turns);
        }
        let mut upto = 0.0;
        let lengths: Vec<f64> = self
            .turns
            .windows(2)
            .map(|pair| {
                upto += apart(pair[0], pair[1]);
                upto
            })
            .collect();
        let mut next = 0;
        (1..=count)
            .map(|place| {
                let wanted = upto * place as f64 / (count + 1) as f64;
                // Turns enough must be left for the other places.
                let last = turns - 1 - (count - place);
                let off = |turn: &usize| (lengths[*turn] - wanted).abs();
                let turn = (next..=last).min_by(|a, b| off(a).total_cmp(&off(b))).unwrap_or(last);
                next = turn + 1;
                self.turns[turn + 1]
            })
            .collect()
    }

    /// All turns and `more` places on the lines between them.
    fn divided(&self, more: usize) -> Vec<[f64; 2]> {
        let legs: Vec<_> = self.turns.windows(2).map(|pair| (pair[0], pair[1])).collect();
        let mut parts = vec![1_usize; legs.len()];
        for _ in 0..more {
            let part = |leg: usize| apart(legs[leg].0, legs[leg].1) / parts[leg] as f64;
            let longest = (0..legs.len()).max_by(|&a, &b| part(a).total_cmp(&part(b)));
            if let Some(leg) = longest {
                parts[leg] += 1;
            }
        }
        let mut places = Vec::new();
        for (&(a, b), &parts) in legs.iter().zip(&parts) {
            places.extend((1..=parts).map(|part| {
                let part = part as f64 / parts as f64;
                [0, 1].map(|i| a[i] + part * (b[i] - a[i]))
            }));
        }
        // The last one is the goal.
        places.pop();
        places
    }
}

impl Obstacles {
    /// Corners of grown walls where the agent can stand.
    fn corners(&self) -> impl Iterator<Item = [f64; 2]> + '_ {
        let faces = self.walls.iter().flat_map(|wall| &wall.faces);
        faces.map(|face| face.ends[0]).filter(|&corner| self.contains(corner))
    }

    /// How far `position` is from walls and border, m, or less.
    fn room(&self, position: [f64; 2]) -> f64 {
        let mut room = [0, 1].map(|i| self.reach[i] - position[i].abs());
        for wall in &self.walls {
            room[0] = room[0].min(-wall.depth(position));
        }
        room[0].min(room[1])
    }

    /// The place nearby, in sight of `position`, with the most room around the agent.
    pub(super) fn roomiest(&self, position: [f64; 2]) -> [f64; 2] {
        const HALF: i32 = 8;
        let mut best = (self.room(position).min(ROOM), 0, position);
        for i in -HALF..=HALF {
            for j in -HALF..=HALF {
                let far = i * i + j * j;
                if far > HALF * HALF {
                    continue;
                }
                let by = MOVED / f64::from(HALF);
                let there = [position[0] + by * f64::from(i), position[1] + by * f64::from(j)];
                let room = self.room(there).min(ROOM);
                let better = room > best.0 + 1e-9 || (room > best.0 - 1e-9 && far < best.1);
                if better && self.sees(position, there) {
                    best = (room, far, there);
                }
            }
        }
        best.2
    }
}

fn apart(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// A place in the queue: least length first, then in order.
struct Entry {
    length: f64,
    place: usize,
}

impl Ord for Entry {
    fn cmp(&self, other: &Self) -> Ordering {
        other.length.total_cmp(&self.length).then(other.place.cmp(&self.place))
    }
}

impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Entry {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Entry {}
