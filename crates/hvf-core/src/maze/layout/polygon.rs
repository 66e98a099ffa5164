//! Convex polygons: walls, walls grown by the agent, and clipping.

use rapier2d_f64::parry::bounding_volume::Aabb;
use rapier2d_f64::parry::math::Vector;

/// Walls that are turned by less than this from a quarter turn, degrees, count as not turned.
const ALIGNED: f64 = 1e-6;

/// `a . b`.
#[inline]
pub(super) fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

/// A box and the directions of its axes.
#[derive(Clone, Copy, Debug)]
pub(super) struct TurnedBox {
    pub centre: [f64; 2],
    pub half: [f64; 2],
    /// Unit vectors of its first and second axis.
    pub axes: [[f64; 2]; 2],
    /// Whether these are the arena's.
    pub aligned: bool,
}

/// A box from its description; `angle` in degrees.
pub(super) fn box_of(centre: &[f64; 2], half: &[f64; 2], angle: f64) -> TurnedBox {
    let quarter = (angle / 90.0).round();
    let (aligned, first) = if (angle - 90.0 * quarter).abs() <= ALIGNED {
        let first = match quarter.rem_euclid(4.0) as u8 {
            0 => [1.0, 0.0],
            1 => [0.0, 1.0],
            2 => [-1.0, 0.0],
            _ => [0.0, -1.0],
        };
        (true, first)
    } else {
        let turn = angle.rem_euclid(360.0).to_radians();
        // The same bits on every machine.
        (false, [libm::cos(turn), libm::sin(turn)])
    };
    TurnedBox { centre: *centre, half: *half, axes: [first, [-first[1], first[0]]], aligned }
}

impl TurnedBox {
    /// The part of it between `low` and `high` along its second axis, from its centre.
    pub fn piece(&self, low: f64, high: f64) -> TurnedBox {
        let middle = 0.5 * (low + high);
        let [_, up] = self.axes;
        TurnedBox {
            centre: [self.centre[0] + middle * up[0], self.centre[1] + middle * up[1]],
            half: [self.half[0], 0.5 * (high - low)],
            ..*self
        }
    }

    /// Corners, anticlockwise.
    pub fn corners(&self) -> [[f64; 2]; 4] {
        [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]].map(|[s, t]| {
            let [a, b] = [s * self.half[0], t * self.half[1]];
            let [u, v] = self.axes;
            [self.centre[0] + a * u[0] + b * v[0], self.centre[1] + a * u[1] + b * v[1]]
        })
    }

    /// Whether it shares an area with the rectangle of these half-widths about the origin.
    pub fn overlaps_rectangle(&self, half: [f64; 2]) -> bool {
        area(&clipped_to_rectangle(&self.corners(), half.map(|h| [-h, h]))) > 0.0
    }

    /// The box grown by an axis-aligned square of half-width `by`: their Minkowski sum.
    pub fn grown(&self, by: f64) -> Grown {
        let mut normals = vec![[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]];
        if !self.aligned {
            let [u, v] = self.axes;
            normals.extend([u, v, u.map(|c| -c), v.map(|c| -c)]);
            normals.sort_by(|a, b| libm::atan2(a[1], a[0]).total_cmp(&libm::atan2(b[1], b[0])));
        }
        let sign = |value: f64| if value < 0.0 { -1.0 } else { 1.0 };
        let corner = |direction: [f64; 2]| {
            let [a, b] = [0, 1].map(|i| sign(dot(direction, self.axes[i])) * self.half[i]);
            let [u, v] = self.axes;
            [0, 1].map(|i| self.centre[i] + a * u[i] + b * v[i] + by * sign(direction[i]))
        };
        let count = normals.len();
        let faces: Vec<Face> = (0..count)
            .map(|i| {
                let (before, normal, after) =
                    (normals[(i + count - 1) % count], normals[i], normals[(i + 1) % count]);
                let between = |a: [f64; 2], b: [f64; 2]| corner([a[0] + b[0], a[1] + b[1]]);
                let reach = dot(normal, self.centre)
                    + self.half[0] * dot(normal, self.axes[0]).abs()
                    + self.half[1] * dot(normal, self.axes[1]).abs()
                    + by * (normal[0].abs() + normal[1].abs());
                Face {
                    normal,
                    offset: reach,
                    ends: [between(before, normal), between(normal, after)],
                }
            })
            .collect();
        let mut mins = Vector::new(f64::INFINITY, f64::INFINITY);
        let mut maxs = -mins;
        for face in &faces {
            let end = Vector::from(face.ends[0]);
            (mins, maxs) = (mins.min(end), maxs.max(end));
        }
        Grown { faces, bounds: Aabb::new(mins, maxs) }
    }
}

/// A face of a [`Grown`] box.
#[derive(Clone, Copy, Debug)]
pub(super) struct Face {
    /// Unit vector out of the wall.
    pub normal: [f64; 2],
    /// The face is where `normal . p = offset`.
    pub offset: f64,
    /// Where it begins and ends, anticlockwise about the wall.
    pub ends: [[f64; 2]; 2],
}

impl Face {
    /// How far `p` is in front of the face, m; negative behind it.
    #[inline]
    pub fn distance(&self, p: [f64; 2]) -> f64 {
        dot(self.normal, p) - self.offset
    }
}

/// A wall grown by the agent: where the agent's centre cannot be, 4 or 8 faces, anticlockwise.
#[derive(Clone, Debug)]
pub(super) struct Grown {
    pub faces: Vec<Face>,
    pub bounds: Aabb,
}

impl Grown {
    /// How deep `p` is inside, m: the distance to the nearest face; 0 or less outside.
    #[inline]
    pub fn depth(&self, p: [f64; 2]) -> f64 {
        self.faces.iter().map(|face| -face.distance(p)).fold(f64::INFINITY, f64::min)
    }
}

/// The part of a convex polygon where `normal . p <= offset`.
pub(super) fn clipped(polygon: &[[f64; 2]], normal: [f64; 2], offset: f64) -> Vec<[f64; 2]> {
    let mut kept = Vec::with_capacity(polygon.len() + 1);
    for (i, &p) in polygon.iter().enumerate() {
        let q = polygon[(i + 1) % polygon.len()];
        let (a, b) = (dot(normal, p) - offset, dot(normal, q) - offset);
        if a <= 0.0 {
            kept.push(p);
        }
        if (a < 0.0 && b > 0.0) || (a > 0.0 && b < 0.0) {
            let part = a / (a - b);
            kept.push([p[0] + part * (q[0] - p[0]), p[1] + part * (q[1] - p[1])]);
        }
    }
    kept
}

/// The part of a convex polygon in a rectangle `[[low x, high x], [low y, high y]]`.
pub(super) fn clipped_to_rectangle(
    polygon: &[[f64; 2]],
    rectangle: [[f64; 2]; 2],
) -> Vec<[f64; 2]> {
    let [[left, right], [low, high]] = rectangle;
    let mut kept = polygon.to_vec();
    for (normal, offset) in
        [([-1.0, 0.0], -left), ([1.0, 0.0], right), ([0.0, -1.0], -low), ([0.0, 1.0], high)]
    {
        if kept.is_empty() {
            break;
        }
        kept = clipped(&kept, normal, offset);
    }
    kept
}

/// Area of a polygon whose corners go round anticlockwise.
pub(super) fn area(polygon: &[[f64; 2]]) -> f64 {
    let Some(&[x, y]) = polygon.first() else {
        return 0.0;
    };
    // About its first corner, so that nothing large cancels.
    let mut twice = 0.0;
    for pair in polygon.windows(2) {
        let (a, b) = ([pair[0][0] - x, pair[0][1] - y], [pair[1][0] - x, pair[1][1] - y]);
        twice += a[0] * b[1] - a[1] * b[0];
    }
    0.5 * twice.max(0.0)
}
