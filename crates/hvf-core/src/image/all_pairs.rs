//! The pixel cost between all pairs of two batches of frames, blocked for the caches.
//!
//! # How it works
//! 1. The table of costs is cut into blocks of 64 x 64 frames, one task each.
//! 2. Within a block the frames are cut into pieces of 1024 values, so that a piece of all 128
//!    frames stays in the second-level cache while its 4096 pairs are added up.
//! 3. A micro kernel takes 4 x 2 frames at a time, so that each value loaded serves several pairs.
//!
//! Bytes go through `|a - b|^2 = |a|^2 + |b|^2 - 2 a.b` in integers, which is exact and needs one
//! packed multiply-add per 16 values; floats are subtracted first, since that formula would
//! cancel where two frames are nearly equal.

use multiversion::multiversion;
use ndarray::{s, Array2, ArrayView4};
use rayon::prelude::*;

use super::blur::GaussianBlur;
use super::l2::{check_same_frame, contiguous, squared_distance_u8, tasks_of, Pixel};
use crate::Result;

/// Frames of a block, each side.
const BLOCK: usize = 64;
/// Values of a frame that are worked on at once.
const PIECE: usize = 1024;
/// Frames of the micro kernel, each side.
const TILE: (usize, usize) = (4, 2);

/// What the micro kernel makes of each pair of its frames.
type Tile = [[f64; TILE.1]; TILE.0];

/// How the micro kernel takes pixels.
pub trait Packed: Copy + Sync {
    /// The values of one frame in one step of the kernel.
    type Lanes: Copy + Send + Sync;

    /// Values in `Lanes`.
    const WIDTH: usize;

    /// At most `WIDTH` values, filled up with zeros.
    fn pack(values: &[Self]) -> Self::Lanes;

    /// Sums over one piece of 4 packed frames with 2 packed frames.
    fn tile(a: &[Self::Lanes], b: &[Self::Lanes]) -> Tile;

    /// What [`distance`](Self::distance) needs to know of each frame of `length` values.
    fn norms(values: &[Self], length: usize) -> Vec<f64>;

    /// The squared distance, from what the kernel summed up.
    fn distance(sum: f64, a_norm: f64, b_norm: f64) -> f64;
}

impl Packed for u8 {
    type Lanes = [i16; 16];
    const WIDTH: usize = 16;

    #[inline(always)]
    fn pack(values: &[u8]) -> [i16; 16] {
        match values.try_into() {
            Ok(all) => <[u8; 16]>::map(all, i16::from),
            Err(_) => {
                let mut lanes = [0; 16];
                for (lane, &value) in lanes.iter_mut().zip(values) {
                    *lane = i16::from(value);
                }
                lanes
            }
        }
    }

    fn tile(a: &[[i16; 16]], b: &[[i16; 16]]) -> Tile {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { avx2::products(a, b) };
        }
        products(a, b)
    }

    fn norms(values: &[u8], length: usize) -> Vec<f64> {
        let zeros = vec![0; length];
        let norm = |frame: &[u8]| squared_distance_u8(frame, &zeros) as f64;
        tasks_of(values, length).map(norm).collect()
    }

    fn distance(product: f64, a_norm: f64, b_norm: f64) -> f64 {
        // Integers below 2^53: exact.
        a_norm + b_norm - 2.0 * product
    }
}

impl Packed for f32 {
    type Lanes = [f32; 8];
    const WIDTH: usize = 8;

    #[inline(always)]
    fn pack(values: &[f32]) -> [f32; 8] {
        values.try_into().unwrap_or_else(|_| {
            let mut lanes = [0.0; 8];
            lanes[..values.len()].copy_from_slice(values);
            lanes
        })
    }

    fn tile(a: &[[f32; 8]], b: &[[f32; 8]]) -> Tile {
        squared_differences(a, b)
    }

    fn norms(values: &[f32], length: usize) -> Vec<f64> {
        vec![0.0; values.len() / length]
    }

    fn distance(sum: f64, _: f64, _: f64) -> f64 {
        sum
    }
}

/// Pixel cost of all pairs: `a[N, H, W, C]`, `b[M, H, W, C]` to `costs[N, M]`.
///
/// One-to-many is all pairs with one frame in `a`. With `blur` all frames are blurred first, into
/// `4 * (N + M) * H * W * C` bytes of working memory. Parallel over blocks; the result does not
/// depend on the number of threads.
///
/// # Errors
/// Empty or differing shapes, memory that is not C-contiguous, `f32` values outside `[0, 1]`.
pub fn all_pairs_costs<T: Pixel>(
    a: ArrayView4<'_, T>,
    b: ArrayView4<'_, T>,
    blur: Option<&GaussianBlur>,
) -> Result<Array2<f64>> {
    let (a_values, length) = contiguous(&a, "a")?;
    let (b_values, _) = contiguous(&b, "b")?;
    check_same_frame(&a, &b)?;
    check(a_values, length, "a")?;
    check(b_values, length, "b")?;
    let (n, h, w, c) = a.dim();
    let m = b.dim().0;
    let (mut costs, peak) = match blur {
        None => (distances(a_values, b_values, n, m, length), T::PEAK_SQUARED),
        Some(blur) => {
            let blurred = |values: &[T]| {
                let mut out = vec![0.0_f32; values.len()];
                out.par_chunks_exact_mut(length)
                    .zip(values.par_chunks_exact(length))
                    .for_each_init(
                        || blur.scratch(h, w, c),
                        |scratch, (out, values)| {
                            T::to_unit(values, out);
                            blur.apply(out, h, w, c, scratch);
                        },
                    );
                out
            };
            (distances(&blurred(a_values), &blurred(b_values), n, m, length), 1.0)
        }
    };
    costs /= peak * (h * w) as f64;
    Ok(costs)
}

fn check<T: Pixel>(values: &[T], length: usize, argument: &'static str) -> Result<()> {
    tasks_of(values, length).try_for_each(|frame| T::check(frame, argument))
}

/// `sum((a[i] - b[j])^2)`, `[n, m]`.
fn distances<T: Pixel>(a: &[T], b: &[T], n: usize, m: usize, length: usize) -> Array2<f64> {
    // Few against many: every frame of the many is read once, the few stay in the cache.
    if n < TILE.0 {
        let to_few = |x: &[T]| -> Vec<f64> {
            a.chunks_exact(length).map(|y| T::squared_distance(y, x)).collect()
        };
        let columns: Vec<Vec<f64>> = tasks_of(b, length).map(to_few).collect();
        return Array2::from_shape_fn((n, m), |(i, j)| columns[j][i]);
    }
    if m < TILE.0 {
        return distances(b, a, m, n, length).reversed_axes();
    }
    let (a_norms, b_norms) = (T::norms(a, length), T::norms(b, length));
    let corners: Vec<(usize, usize)> =
        (0..n).step_by(BLOCK).flat_map(|i| (0..m).step_by(BLOCK).map(move |j| (i, j))).collect();
    let block = |&(i, j): &(usize, usize)| {
        let rows = &a[i * length..(i + BLOCK).min(n) * length];
        let columns = &b[j * length..(j + BLOCK).min(m) * length];
        let sums = block_sums(rows, columns, length);
        Array2::from_shape_fn((rows.len() / length, columns.len() / length), |(r, c)| {
            T::distance(sums[[r, c]], a_norms[i + r], b_norms[j + c])
        })
    };
    let blocks: Vec<Array2<f64>> = corners.par_iter().map(block).collect();
    let mut out = Array2::zeros((n, m));
    for ((i, j), block) in corners.into_iter().zip(blocks) {
        let (rows, columns) = block.dim();
        out.slice_mut(s![i..i + rows, j..j + columns]).assign(&block);
    }
    out
}

/// The kernel's sums for all pairs of a block, `[n, m]` rounded up to whole tiles.
fn block_sums<T: Packed>(a: &[T], b: &[T], length: usize) -> Array2<f64> {
    let tiles = ((a.len() / length).div_ceil(TILE.0), (b.len() / length).div_ceil(TILE.1));
    let steps = PIECE / T::WIDTH;
    let mut a_panel = vec![T::pack(&[]); tiles.0 * TILE.0 * steps];
    let mut b_panel = vec![T::pack(&[]); tiles.1 * TILE.1 * steps];
    let mut sums = Array2::<f64>::zeros((tiles.0 * TILE.0, tiles.1 * TILE.1));
    for from in (0..length).step_by(PIECE) {
        let to = (from + PIECE).min(length);
        fill_panel::<T>(a, length, from, to, TILE.0, &mut a_panel);
        fill_panel::<T>(b, length, from, to, TILE.1, &mut b_panel);
        for (i, rows) in a_panel.chunks_exact(TILE.0 * steps).enumerate() {
            for (j, columns) in b_panel.chunks_exact(TILE.1 * steps).enumerate() {
                for (r, row) in T::tile(rows, columns).iter().enumerate() {
                    for (c, sum) in row.iter().enumerate() {
                        sums[[i * TILE.0 + r, j * TILE.1 + c]] += sum;
                    }
                }
            }
        }
    }
    sums
}

/// Values `from..to` of every frame in the order in which the micro kernel reads them: one step's
/// values of each of `rows` frames, then the next step's. What is beyond `to` becomes zero.
fn fill_panel<T: Packed>(
    frames: &[T],
    length: usize,
    from: usize,
    to: usize,
    rows: usize,
    panel: &mut [T::Lanes],
) {
    let steps = PIECE / T::WIDTH;
    for (index, frame) in frames.chunks_exact(length).enumerate() {
        let first = index / rows * rows * steps + index % rows;
        let mut places = panel[first..].iter_mut().step_by(rows);
        let values = frame[from..to].chunks_exact(T::WIDTH);
        let rest = values.remainder();
        for (values, lanes) in values.zip(&mut places) {
            *lanes = T::pack(values);
        }
        if to - from < PIECE {
            let beyond = steps - (to - from) / T::WIDTH;
            for (lanes, values) in
                places.take(beyond).zip(std::iter::once(rest).chain(std::iter::repeat(&[][..])))
            {
                *lanes = T::pack(values);
            }
        }
    }
}

/// Inner products of values within `0..=255`.
fn products(a: &[[i16; 16]], b: &[[i16; 16]]) -> Tile {
    let mut products = Tile::default();
    for (x, y) in a.chunks_exact(TILE.0).zip(b.chunks_exact(TILE.1)) {
        for (row, x) in products.iter_mut().zip(x) {
            for (product, y) in row.iter_mut().zip(y) {
                let sum: i32 = x.iter().zip(y).map(|(&x, &y)| i32::from(x) * i32::from(y)).sum();
                *product += f64::from(sum);
            }
        }
    }
    products
}

/// [`products`] three times as fast as LLVM makes them: it does not find this kernel by itself.
#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::{
        __m256i, _mm256_add_epi32, _mm256_loadu_si256, _mm256_madd_epi16, _mm256_setzero_si256,
        _mm256_storeu_si256,
    };

    use super::{Tile, TILE};

    #[inline]
    #[target_feature(enable = "avx2")]
    fn load(values: &[i16; 16]) -> __m256i {
        // SAFETY: 32 readable bytes; the load may be unaligned.
        unsafe { _mm256_loadu_si256(values.as_ptr().cast()) }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn sum(lanes: __m256i) -> f64 {
        let mut values = [0_u32; 8];
        // SAFETY: 32 writable bytes; the store may be unaligned.
        unsafe { _mm256_storeu_si256(values.as_mut_ptr().cast(), lanes) };
        values.iter().map(|&value| u64::from(value)).sum::<u64>() as f64
    }

    #[target_feature(enable = "avx2")]
    pub fn products(a: &[[i16; 16]], b: &[[i16; 16]]) -> Tile {
        let mut sums = [[_mm256_setzero_si256(); TILE.1]; TILE.0];
        // A lane adds 128 products of a piece: 128 * 255^2 < 2^31.
        let (rows, columns) = (a.as_chunks::<{ TILE.0 }>().0, b.as_chunks::<{ TILE.1 }>().0);
        for (x, y) in rows.iter().zip(columns) {
            let y = [load(&y[0]), load(&y[1])];
            for r in 0..TILE.0 {
                let x = load(&x[r]);
                for c in 0..TILE.1 {
                    sums[r][c] = _mm256_add_epi32(sums[r][c], _mm256_madd_epi16(x, y[c]));
                }
            }
        }
        let mut products = Tile::default();
        for r in 0..TILE.0 {
            for c in 0..TILE.1 {
                products[r][c] = sum(sums[r][c]);
            }
        }
        products
    }
}

/// Sums of squared differences: 8 partial sums a pair, added up in `f64`.
#[multiversion(targets("x86_64+avx2"))]
fn squared_differences(a: &[[f32; 8]], b: &[[f32; 8]]) -> Tile {
    let mut sums = [[[0.0_f32; 8]; TILE.1]; TILE.0];
    let (rows, columns) = (a.as_chunks::<{ TILE.0 }>().0, b.as_chunks::<{ TILE.1 }>().0);
    for (x, y) in rows.iter().zip(columns) {
        for r in 0..TILE.0 {
            for c in 0..TILE.1 {
                for lane in 0..8 {
                    let difference = x[r][lane] - y[c][lane];
                    sums[r][c][lane] += difference * difference;
                }
            }
        }
    }
    sums.map(|row| row.map(|lanes| lanes.into_iter().map(f64::from).sum()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use ndarray::Array4;
    use proptest::prelude::*;

    use super::super::paired_costs;
    use super::*;

    fn frames(n: usize, h: usize, w: usize, c: usize, seed: u64) -> Array4<u8> {
        let mut state = seed | 1;
        Array4::from_shape_simple_fn((n, h, w, c), || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 56) as u8
        })
    }

    fn check_against_pairs<T: Pixel>(
        a: &Array4<T>,
        b: &Array4<T>,
        blur: Option<&GaussianBlur>,
        tolerance: f64,
    ) {
        let table = all_pairs_costs(a.view(), b.view(), blur).unwrap();
        for i in 0..a.dim().0 {
            for j in 0..b.dim().0 {
                let pair = paired_costs(
                    a.slice(s![i..i + 1, .., .., ..]),
                    b.slice(s![j..j + 1, .., .., ..]),
                    blur,
                )
                .unwrap()[0];
                assert!(
                    (table[[i, j]] - pair).abs() <= tolerance * (1.0 + pair),
                    "[{i}, {j}]: {} against {pair}",
                    table[[i, j]]
                );
            }
        }
    }

    #[test]
    fn white_against_black_does_not_overflow() {
        let white = Array4::<u8>::from_elem((5, 70, 70, 3), 255);
        let black = Array4::<u8>::zeros((3, 70, 70, 3));
        let costs = all_pairs_costs(white.view(), black.view(), None).unwrap();
        assert!(costs.iter().all(|&cost| cost == 3.0));
        let same = all_pairs_costs(white.view(), white.view(), None).unwrap();
        assert!(same.iter().all(|&cost| cost == 0.0));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn equals_the_costs_pair_by_pair(
            (n, m) in (1_usize..40, 1_usize..40),
            (h, w, c) in (1_usize..30, 1_usize..30, 1_usize..4),
            seed in any::<u64>(),
        ) {
            let (a, b) = (frames(n, h, w, c, seed), frames(m, h, w, c, seed ^ 0xABCD));
            check_against_pairs(&a, &b, None, 0.0);
            let (a, b) = (a.mapv(|v| f32::from(v) / 255.0), b.mapv(|v| f32::from(v) / 255.0));
            check_against_pairs(&a, &b, None, 1e-6);
            let blur = GaussianBlur::new(1.5, "blur").unwrap();
            check_against_pairs(&a, &b, blur.as_ref(), 1e-5);
        }
    }
}
