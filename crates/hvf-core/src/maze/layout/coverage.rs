//! How much of each pixel walls cover: exact areas of turned boxes, counted once where they meet.

use super::polygon::{area, clipped, clipped_to_rectangle, dot};
use crate::maze::pixels::Axis;

/// A convex polygon without the inside of another one, as convex parts.
fn without(polygon: &[[f64; 2]], other: &[[f64; 2]]) -> Vec<Vec<[f64; 2]>> {
    let (mut outside, mut rest) = (Vec::new(), polygon.to_vec());
    for (i, &p) in other.iter().enumerate() {
        let q = other[(i + 1) % other.len()];
        // Anticlockwise: the outside of an edge is to its right.
        let normal = [q[1] - p[1], p[0] - q[0]];
        let offset = dot(normal, p);
        let beyond = clipped(&rest, normal.map(|c| -c), -offset);
        if beyond.len() > 2 {
            outside.push(beyond);
        }
        rest = clipped(&rest, normal, offset);
        if rest.len() < 3 {
            break;
        }
    }
    outside
}

/// The part that polygons cover of each pixel of a frame, added to `cover`, `[size, size]`, row 0
/// at the top. Where several meet in a pixel their union counts.
pub(super) fn add_coverage(polygons: &[Vec<[f64; 2]>], size: usize, cover: &mut [f64]) {
    let axis = Axis::new(size);
    let pixel_area = axis.pixel() * axis.pixel();
    let mut met: Vec<u8> = vec![0; size * size];
    for polygon in polygons {
        part_of_pixels(polygon, size, |pixel, part| {
            cover[pixel] += part;
            met[pixel] = met[pixel].saturating_add(1);
        });
    }
    for pixel in (0..size * size).filter(|&pixel| met[pixel] > 1) {
        let rectangle = axis.rectangle(pixel);
        let (mut whole, mut apart) = (0.0, 0.0);
        let mut parts: Vec<Vec<[f64; 2]>> = Vec::new();
        for polygon in polygons {
            let part = clipped_to_rectangle(polygon, rectangle);
            if part.len() < 3 {
                continue;
            }
            apart += area(&part);
            let mut left = vec![part.clone()];
            for before in &parts {
                left = left.iter().flat_map(|piece| without(piece, before)).collect();
            }
            whole += left.iter().map(|piece| area(piece)).sum::<f64>();
            parts.push(part);
        }
        cover[pixel] -= (apart - whole) / pixel_area;
    }
    for value in cover.iter_mut() {
        // Rounding of sums of parts.
        *value = if *value < 1e-12 { 0.0 } else { value.min(1.0) };
    }
}

/// Calls `visit(pixel, part)` for each pixel that a convex polygon covers in part or wholly, in
/// ascending order.
pub(super) fn part_of_pixels(polygon: &[[f64; 2]], size: usize, mut visit: impl FnMut(usize, f64)) {
    let axis = Axis::new(size);
    let bounds = |i: usize, sign: f64| {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for corner in polygon {
            low = low.min(sign * corner[i]);
            high = high.max(sign * corner[i]);
        }
        (low, high)
    };
    if polygon.len() < 3 {
        return;
    }
    let (left, right) = bounds(0, 1.0);
    // Rows count downwards, so the axis of rows is -y.
    let (top, bottom) = bounds(1, -1.0);
    let upright = polygon.len() == 4
        && (0..4).all(|i| {
            let (p, q) = (polygon[i], polygon[(i + 1) % 4]);
            p[0] == q[0] || p[1] == q[1]
        });
    if upright {
        for row in axis.pixels(top, bottom) {
            let in_row = axis.covered(row, top, bottom);
            for col in axis.pixels(left, right) {
                let part = in_row * axis.covered(col, left, right);
                if part > 0.0 {
                    visit(row * axis.size() + col, part);
                }
            }
        }
        return;
    }
    let pixel_area = axis.pixel() * axis.pixel();
    for row in axis.pixels(top, bottom) {
        let (high, low) = (-axis.edge(row), -axis.edge(row + 1));
        let slab = clipped(&clipped(polygon, [0.0, 1.0], high), [0.0, -1.0], -low);
        if slab.len() < 3 {
            continue;
        }
        let ends = slab.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], corner| {
            [low.min(corner[0]), high.max(corner[0])]
        });
        let mut rest = slab;
        for col in axis.pixels(ends[0], ends[1]) {
            let right = axis.edge(col + 1);
            let part = area(&clipped(&rest, [1.0, 0.0], right)) / pixel_area;
            rest = clipped(&rest, [-1.0, 0.0], -right);
            if part > 0.0 {
                visit(row * axis.size() + col, part);
            }
            if rest.len() < 3 {
                break;
            }
        }
    }
}
