//! The pixel cost: squared L2 between frames, per pixel.
//!
//! `cost(a, b) = sum over pixels and channels of (a - b)^2 / (H * W)`, frames scaled to `[0, 1]`.
//! This is the planning cost of Nair & Finn (2020), section 3. Unblurred `u8` frames are summed in
//! integers, so their cost is exact up to one final division.

use multiversion::multiversion;
use ndarray::{Array1, ArrayView4};
use rayon::iter::MinLen;
use rayon::prelude::*;

use super::all_pairs::Packed;
use super::blur::GaussianBlur;
use crate::{Error, Result};

/// A colour value: `u8` in `0..=255`, or `f32` in `[0, 1]`.
pub trait Pixel: Packed + Send + 'static {
    /// The square of the largest value, by which sums are divided.
    const PEAK_SQUARED: f64;

    /// Refuses values that are not colours (`f32` outside `[0, 1]`, NaN).
    ///
    /// # Errors
    /// Names `argument` and the first bad value.
    fn check(values: &[Self], argument: &'static str) -> Result<()>;

    /// `sum((a - b)^2)` in the pixel's own unit; exact for `u8`.
    fn squared_distance(a: &[Self], b: &[Self]) -> f64;

    /// `(a - b)`, scaled to `[-1, 1]`.
    fn difference(a: &[Self], b: &[Self], out: &mut [f32]);

    /// Values scaled to `[0, 1]`.
    fn to_unit(values: &[Self], out: &mut [f32]);
}

impl Pixel for u8 {
    const PEAK_SQUARED: f64 = 255.0 * 255.0;

    fn check(_: &[u8], _: &'static str) -> Result<()> {
        Ok(())
    }

    fn squared_distance(a: &[u8], b: &[u8]) -> f64 {
        squared_distance_u8(a, b) as f64
    }

    fn difference(a: &[u8], b: &[u8], out: &mut [f32]) {
        for ((&x, &y), difference) in a.iter().zip(b).zip(out) {
            *difference = f32::from(i16::from(x) - i16::from(y)) / 255.0;
        }
    }

    fn to_unit(values: &[u8], out: &mut [f32]) {
        for (&value, unit) in values.iter().zip(out) {
            *unit = f32::from(value) / 255.0;
        }
    }
}

impl Pixel for f32 {
    const PEAK_SQUARED: f64 = 1.0;

    fn check(values: &[f32], argument: &'static str) -> Result<()> {
        if all_in_unit_range(values) {
            return Ok(());
        }
        match values.iter().find(|value| !(0.0..=1.0).contains(*value)) {
            Some(bad) => Err(Error::invalid(
                argument,
                format!("float32 images must be finite and within [0, 1], found {bad}"),
            )),
            None => Ok(()), // Negative zeros.
        }
    }

    fn squared_distance(a: &[f32], b: &[f32]) -> f64 {
        squared_distance_f32(a, b)
    }

    fn difference(a: &[f32], b: &[f32], out: &mut [f32]) {
        for ((&x, &y), difference) in a.iter().zip(b).zip(out) {
            *difference = x - y;
        }
    }

    fn to_unit(values: &[f32], out: &mut [f32]) {
        out.copy_from_slice(values);
    }
}

/// Exact `sum((a - b)^2)` of bytes.
#[multiversion(targets("x86_64+avx2"))]
pub(crate) fn squared_distance_u8(a: &[u8], b: &[u8]) -> u64 {
    // A block's sum fits an i32 (16384 * 255^2 < 2^31), so that LLVM may use packed
    // multiply-add; blocks are added in u64.
    const BLOCK: usize = 16384;
    let mut sum = 0_u64;
    for (a, b) in a.chunks(BLOCK).zip(b.chunks(BLOCK)) {
        let mut block = 0_i32;
        for (&x, &y) in a.iter().zip(b) {
            let difference = i16::from(x) - i16::from(y);
            block += i32::from(difference) * i32::from(difference);
        }
        sum += block as u64;
    }
    sum
}

/// `sum((a - b)^2)` of floats: 32 partial sums in `f32`, carried over to `f64` every 4096 values.
/// The order of additions is fixed, so the result is the same on every machine.
#[multiversion(targets("x86_64+avx2"))]
pub(crate) fn squared_distance_f32(a: &[f32], b: &[f32]) -> f64 {
    const BLOCK: usize = 4096;
    let mut sum = 0.0_f64;
    for (a, b) in a.chunks(BLOCK).zip(b.chunks(BLOCK)) {
        let mut lanes = [0.0_f32; 32];
        let (a_lanes, a_rest) = a.as_chunks::<32>();
        let (b_lanes, b_rest) = b.as_chunks::<32>();
        for (x, y) in a_lanes.iter().zip(b_lanes) {
            for lane in 0..32 {
                let difference = x[lane] - y[lane];
                lanes[lane] += difference * difference;
            }
        }
        for (&x, &y) in a_rest.iter().zip(b_rest) {
            sum += f64::from((x - y) * (x - y));
        }
        for lane in lanes {
            sum += f64::from(lane);
        }
    }
    sum
}

/// `sum(a^2)` of floats, in the same order as [`squared_distance_f32`].
#[multiversion(targets("x86_64+avx2"))]
pub(crate) fn squared_norm_f32(a: &[f32]) -> f64 {
    const BLOCK: usize = 4096;
    let mut sum = 0.0_f64;
    for a in a.chunks(BLOCK) {
        let mut lanes = [0.0_f32; 32];
        let (a_lanes, a_rest) = a.as_chunks::<32>();
        for x in a_lanes {
            for lane in 0..32 {
                lanes[lane] += x[lane] * x[lane];
            }
        }
        for &x in a_rest {
            sum += f64::from(x * x);
        }
        for lane in lanes {
            sum += f64::from(lane);
        }
    }
    sum
}

/// Whether all values are within `[+0, 1]`. Bit patterns of floats that are not negative are in
/// the order of their values, with infinity and NaN above and negative ones above those.
#[multiversion(targets("x86_64+avx2"))]
fn all_in_unit_range(values: &[f32]) -> bool {
    let mut largest = 0;
    for value in values {
        largest = largest.max(value.to_bits());
    }
    largest <= 1.0_f32.to_bits()
}

/// Values of a frame that are checked and compared together: of floats, 16 KiB from either frame.
const BLOCK: usize = 4096;

/// The frames of a batch as rayon tasks of at least 32 KiB.
pub(crate) fn tasks_of<T: Sync>(
    values: &[T],
    length: usize,
) -> MinLen<rayon::slice::ChunksExact<'_, T>> {
    values.par_chunks_exact(length).with_min_len((32 * 1024 / (length * size_of::<T>())).max(1))
}

/// The values of `frames[N, H, W, C]` without a copy, and the length of one frame.
pub(crate) fn contiguous<'a, T>(
    frames: &'a ArrayView4<'_, T>,
    argument: &'static str,
) -> Result<(&'a [T], usize)> {
    let (n, h, w, c) = frames.dim();
    if n == 0 || h == 0 || w == 0 || c == 0 {
        return Err(Error::invalid(
            argument,
            format!(
                "must be a non-empty batch of frames [N, H, W, C], got shape [{n}, {h}, {w}, {c}]"
            ),
        ));
    }
    let values = frames.as_slice().ok_or_else(|| {
        Error::invalid(argument, "must be C-contiguous (numpy.ascontiguousarray makes it so)")
    })?;
    Ok((values, h * w * c))
}

pub(crate) fn check_same_frame<T>(a: &ArrayView4<'_, T>, b: &ArrayView4<'_, T>) -> Result<()> {
    if a.shape()[1..] != b.shape()[1..] {
        return Err(Error::invalid(
            "b",
            format!(
                "frames must have the shape {:?} of those of a, got {:?}",
                &a.shape()[1..],
                &b.shape()[1..]
            ),
        ));
    }
    Ok(())
}

/// Pixel cost of each pair: `a[N, H, W, C]`, `b[N, H, W, C]` to `costs[N]`.
///
/// With `blur`, both frames are blurred first; since the blur is linear, it is applied once, to
/// their difference. Parallel over frames; the result does not depend on the number of threads.
///
/// # Errors
/// Empty or differing shapes, memory that is not C-contiguous, `f32` values outside `[0, 1]`.
pub fn paired_costs<T: Pixel>(
    a: ArrayView4<'_, T>,
    b: ArrayView4<'_, T>,
    blur: Option<&GaussianBlur>,
) -> Result<Array1<f64>> {
    let (a_values, length) = contiguous(&a, "a")?;
    let (b_values, _) = contiguous(&b, "b")?;
    check_same_frame(&a, &b)?;
    let (n, h, w, c) = a.dim();
    if b.dim().0 != n {
        return Err(Error::invalid(
            "b",
            format!("must hold as many frames as a ({n}), got {}", b.dim().0),
        ));
    }
    let pairs = tasks_of(a_values, length).zip(tasks_of(b_values, length));
    let costs: Result<Vec<f64>> = match blur {
        None => pairs
            .map(|(a, b)| {
                let mut sum = 0.0;
                // Block by block, so that values are checked and compared while in the L1 cache.
                for (a, b) in a.chunks(BLOCK).zip(b.chunks(BLOCK)) {
                    T::check(a, "a")?;
                    T::check(b, "b")?;
                    sum += T::squared_distance(a, b);
                }
                Ok(sum / (T::PEAK_SQUARED * (h * w) as f64))
            })
            .collect(),
        Some(blur) => pairs
            .map_init(
                || (vec![0.0; length], blur.scratch(h, w, c)),
                |(difference, scratch), (a, b)| {
                    T::check(a, "a")?;
                    T::check(b, "b")?;
                    T::difference(a, b, difference);
                    blur.apply(difference, h, w, c, scratch);
                    Ok(squared_norm_f32(difference) / (h * w) as f64)
                },
            )
            .collect(),
    };
    Ok(Array1::from_vec(costs?))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use ndarray::Array4;
    use proptest::prelude::*;

    use super::*;

    fn slow_sum(a: &[i64], b: &[i64]) -> i64 {
        a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum()
    }

    #[test]
    fn black_and_white_frames_are_three_apart() {
        let black = Array4::<u8>::zeros((2, 8, 8, 3));
        let white = Array4::<u8>::from_elem((2, 8, 8, 3), 255);
        assert_eq!(paired_costs(black.view(), white.view(), None).unwrap().to_vec(), [3.0, 3.0]);
    }

    #[test]
    fn sums_of_bytes_are_exact_for_frames_larger_than_a_block() {
        let a = vec![255_u8; 5 * 16384 + 7];
        let b = vec![0_u8; a.len()];
        assert_eq!(squared_distance_u8(&a, &b), 65025 * a.len() as u64);
    }

    #[test]
    fn bad_input_names_the_argument() {
        let a = Array4::<f32>::zeros((2, 4, 4, 1));
        let mut b = a.clone();
        b[[1, 2, 3, 0]] = f32::NAN;
        let said = paired_costs(a.view(), b.view(), None).unwrap_err().to_string();
        assert!(said.starts_with("b: float32 images must be finite"), "{said}");
        let short = Array4::<f32>::zeros((1, 4, 4, 1));
        assert!(paired_costs(a.view(), short.view(), None).is_err());
        let narrow = Array4::<f32>::zeros((2, 4, 3, 1));
        assert!(paired_costs(a.view(), narrow.view(), None).is_err());
        let none = Array4::<f32>::zeros((0, 4, 4, 1));
        assert!(paired_costs(none.view(), none.view(), None).is_err());
        let transposed = a.view().permuted_axes([0, 2, 1, 3]);
        assert!(paired_costs(transposed, a.view(), None).is_err());
    }

    proptest! {
        #[test]
        fn equals_the_sum_written_out(
            (n, h, w, c) in (1_usize..4, 1_usize..20, 1_usize..20, 1_usize..5),
            seed in any::<u64>(),
        ) {
            let mut state = seed | 1;
            let mut next = move || {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (state >> 56) as u8
            };
            let a = Array4::from_shape_simple_fn((n, h, w, c), &mut next);
            let b = Array4::from_shape_simple_fn((n, h, w, c), &mut next);
            let bytes = paired_costs(a.view(), b.view(), None).unwrap();
            let (af, bf) = (a.mapv(|v| f32::from(v) / 255.0), b.mapv(|v| f32::from(v) / 255.0));
            let floats = paired_costs(af.view(), bf.view(), None).unwrap();
            for frame in 0..n {
                let slice = |x: &Array4<u8>| -> Vec<i64> {
                    x.index_axis(ndarray::Axis(0), frame).iter().map(|&v| i64::from(v)).collect()
                };
                let slow = slow_sum(&slice(&a), &slice(&b));
                prop_assert_eq!(bytes[frame], slow as f64 / (65025.0 * (h * w) as f64));
                prop_assert!((floats[frame] - bytes[frame]).abs() <= 1e-6 * (1.0 + bytes[frame]));
            }
        }
    }
}
