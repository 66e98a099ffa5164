//! The inner loops of [`agent_cost`](super::agent_cost).

use multiversion::multiversion;

use super::render::{AGENT, FLOOR, WALL};

/// Rows of patches are filled up to whole vectors of this many values.
pub(super) const LANES: usize = 8;

/// What an agent on open floor changes, in three rows of three planes of `stride` values: `rows`
/// and `columns` are the parts of the first, the middle and the last that it covers.
///
/// Colours are those of [`blend`](super::render::blend), worked out side by side.
#[multiversion(targets("x86_64+avx2"))]
pub(super) fn floor_planes(
    rows: [f64; 3],
    columns: [f64; 3],
    count: usize,
    stride: usize,
    planes: &mut [f32],
) {
    // First, middle, last column and one for nothing.
    let columns = [columns[0], columns[1], columns[2], 0.0];
    for (planes, row) in planes.chunks_exact_mut(3 * stride).zip(rows) {
        for (channel, plane) in planes.chunks_exact_mut(stride).enumerate() {
            let (floor, green) = (f64::from(FLOOR[channel]), f64::from(AGENT[channel]));
            let mut change = [0.0_f32; 4];
            for (change, column) in change.iter_mut().zip(columns) {
                let value = floor + (green - floor) * (row * column);
                *change = ((value + 0.5 + 1e-9).floor() - floor) as f32;
            }
            plane.fill(0.0);
            if count > 0 {
                plane[..count].fill(change[1]);
                plane[count - 1] = change[2];
                plane[0] = change[0];
            }
        }
    }
}

/// What an agent that covers `parts` of the pixels of a row changes about it, in three planes:
/// `walls` are the parts that walls cover and `under` the scene, interleaved. Parts, walls and
/// planes are filled up to whole vectors.
///
/// Colours are those of [`blend`](super::render::blend), worked out side by side.
#[multiversion(targets("x86_64+avx2"))]
pub(super) fn blend_planes(parts: &[f64], walls: &[f64], under: &[u8], planes: &mut [f32]) {
    let (parts, walls) = (parts.as_chunks::<LANES>().0, walls.as_chunks::<LANES>().0);
    let planes = planes.as_chunks_mut::<LANES>().0;
    for (block, (agent, walls)) in parts.iter().zip(walls).enumerate() {
        let mut before = [0_u8; 3 * LANES];
        let under = under.get(3 * LANES * block..).unwrap_or(&[]);
        for (before, under) in before.iter_mut().zip(under) {
            *before = *under;
        }
        // Short loops of one step each: these the compiler makes vectors of.
        let mut walls = *walls;
        for (walls, agent) in walls.iter_mut().zip(agent) {
            let room = 1.0 - agent;
            *walls = if *walls < room { *walls } else { room };
        }
        for channel in 0..3 {
            let [floor, wall, green] =
                [f64::from(FLOOR[channel]), f64::from(WALL[channel]), f64::from(AGENT[channel])];
            let mut value = [0.0_f64; LANES];
            for lane in 0..LANES {
                value[lane] = floor + (wall - floor) * walls[lane] + (green - floor) * agent[lane];
            }
            for value in &mut value {
                *value = (*value + 0.5 + 1e-9).floor();
            }
            let mut colour = [0.0_f32; LANES];
            for (colour, value) in colour.iter_mut().zip(value) {
                *colour = value as f32;
            }
            let change = &mut planes[channel * parts.len() + block];
            for lane in 0..LANES {
                if agent[lane] >= 1.0 {
                    colour[lane] = green as f32;
                }
                change[lane] = colour[lane] - f32::from(before[3 * lane + channel]);
                if agent[lane] <= 0.0 {
                    change[lane] = 0.0;
                }
            }
        }
    }
}

/// Inner product of a patch, whose rows of `stride` values are of these `kinds`, with `other` read
/// every `other_stride` values.
#[multiversion(targets("x86_64+avx2"))]
pub(super) fn inner_integers(
    kinds: &[usize],
    change: &[i16],
    stride: usize,
    other: &[i16],
    other_stride: usize,
) -> i64 {
    let mut sum = 0;
    for (row, kind) in kinds.iter().enumerate() {
        let (patch, _) = change[kind * stride..][..stride].as_chunks::<LANES>();
        let (other, _) = other[row * other_stride..][..stride].as_chunks::<LANES>();
        let mut lanes = [0_i32; LANES];
        for (p, o) in patch.iter().zip(other) {
            for lane in 0..LANES {
                lanes[lane] += i32::from(p[lane]) * i32::from(o[lane]);
            }
        }
        sum += i64::from(lanes.iter().sum::<i32>());
    }
    sum
}

/// [`inner_integers`] of the three planes; the order of additions is fixed.
#[multiversion(targets("x86_64+avx2"))]
pub(super) fn inner_floats(
    kinds: &[usize],
    planes: &[f32],
    stride: usize,
    other: [&[f32]; 3],
    other_stride: usize,
) -> f32 {
    let mut lanes = [0.0_f32; LANES];
    for (row, kind) in kinds.iter().enumerate() {
        let patch = &planes[kind * 3 * stride..][..3 * stride];
        for (patch, other) in patch.chunks_exact(stride).zip(other) {
            let (patch, _) = patch.as_chunks::<LANES>();
            let (other, _) = other[row * other_stride..][..stride].as_chunks::<LANES>();
            for (p, o) in patch.iter().zip(other) {
                for lane in 0..LANES {
                    lanes[lane] += p[lane] * o[lane];
                }
            }
        }
    }
    lanes.iter().sum()
}

/// Sum over pairs `(i, j)` of rows of `planes`, three channels of `stride` values each, of
/// `weights[i, j]` times their inner product under `gram`. Values from `columns` on are zero.
#[multiversion(targets("x86_64+avx2"))]
pub(super) fn weighted_products(
    planes: &[f32],
    (stride, columns): (usize, usize),
    (weights, weights_stride): (&[f32], usize),
    (gram, gram_stride): (&[f32], usize),
) -> f32 {
    let kinds = planes.len() / (3 * stride);
    let columns = columns.min(gram.len().div_ceil(gram_stride));
    let mut lanes = [0.0_f32; LANES];
    for (kind, row) in planes.chunks_exact(3 * stride).enumerate() {
        for channel in 0..3 {
            let values = &row[channel * stride..][..columns];
            for block in (0..stride).step_by(LANES) {
                let mut across = [0.0_f32; LANES];
                for (column, value) in values.iter().enumerate() {
                    let gram = &gram[column * gram_stride + block..][..LANES];
                    for lane in 0..LANES {
                        across[lane] += value * gram[lane];
                    }
                }
                for other in 0..kinds {
                    let weight = weights[kind * weights_stride + other];
                    let values = &planes[(other * 3 + channel) * stride + block..][..LANES];
                    for lane in 0..LANES {
                        lanes[lane] += weight * values[lane] * across[lane];
                    }
                }
            }
        }
    }
    lanes.iter().sum()
}

#[multiversion(targets("x86_64+avx2"))]
pub(super) fn add_scaled(sum: &mut [f32], factor: f32, values: &[f32]) {
    for (sum, &value) in sum.iter_mut().zip(values) {
        *sum += factor * value;
    }
}
