//! Candidates drawn from counters: uniform and normal, any subset of a problem's samples; and
//! seeds for models that draw numbers of their own.
//!
//! The value of dimension `d` of sample `n` depends on (seed, problem, iteration, n, d) only, so
//! samples can be drawn in any order, on any thread, and again later. Only f32 additions,
//! multiplications, divisions and square roots are used, which IEEE 754 rounds the same way
//! everywhere, and never fused: a seed gives the same bits on every machine.

use std::f32::consts::{LN_2, SQRT_2, TAU};

use multiversion::multiversion;

use super::philox::philox_lanes;

/// Samples drawn side by side: two AVX2 registers, which hides the latency of the multiplications.
const LANES: usize = 16;
/// Random words of one Philox block, hence dimensions of one block.
const BLOCK: usize = 4;

/// No standard normal number that is drawn is longer than this.
pub(super) const LONGEST_NORMAL: f32 = 7.0;
/// Most dimensions of one candidate: the counter keeps 16 bits for the block.
pub const MAX_DIMENSIONS: usize = BLOCK << 16;
/// Most iterations: the counter keeps 15 bits for the iteration.
pub const MAX_ITERATIONS: usize = 1 << 15;

/// What random numbers are for; those of one purpose are unrelated to those of the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Candidate actions of visual MPC.
    Actions = 0,
    /// Candidate latents of the subgoal search.
    Latents = 1,
}

/// Which random numbers a problem uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stream {
    /// The user's seed.
    pub seed: u64,
    /// What the numbers are for.
    pub purpose: Purpose,
    /// Tells the problems under one seed apart.
    pub problem: u64,
}

impl Stream {
    /// The stream of one iteration: in iteration 0 all problems under one seed have the same, so
    /// that they can share their candidates.
    pub(super) fn in_iteration(self, iteration: usize) -> Self {
        match iteration {
            0 => Self { problem: 0, ..self },
            _ => self,
        }
    }

    fn key(self) -> [u32; 2] {
        [self.seed as u32, (self.seed >> 32) as u32]
    }
}

/// What one problem's candidates of `N` dimensions are drawn from.
#[derive(Clone, Copy, Debug)]
pub enum Draw<'a> {
    /// Every dimension uniform in `[low, high]`, each `[N]`.
    Uniform {
        /// Lower bounds, `[N]`.
        low: &'a [f32],
        /// Upper bounds, `[N]`.
        high: &'a [f32],
    },
    /// A diagonal Gaussian, clipped to a box.
    Normal {
        /// Means, `[N]`.
        mean: &'a [f32],
        /// Standard deviations, `[N]`.
        std: &'a [f32],
        /// Lower bounds of the box, `[N]`, minus infinity where there is none.
        low: &'a [f32],
        /// Upper bounds of the box, `[N]`.
        high: &'a [f32],
    },
}

/// Marks the counters of seeds: the numbers of samples stay below, so that no candidate is drawn
/// from them.
const SEED_COUNTER: u32 = 1 << 31;

/// Fills `out` with a seed, from 0 to `2^63 - 1`, for each of the samples `0..out.len()` of one
/// problem and iteration: a function of these and the stream only, as the candidates are, and
/// unrelated to them.
pub fn draw_seeds(stream: Stream, iteration: usize, out: &mut [i64]) {
    debug_assert!(iteration < MAX_ITERATIONS && out.len() <= SEED_COUNTER as usize);
    for (chunk, seeds) in out.chunks_mut(LANES).enumerate() {
        let samples = std::array::from_fn(|lane| (chunk * LANES + lane) as u32 | SEED_COUNTER);
        let words = random_words(stream, iteration as u32, 0, &samples);
        for (lane, seed) in seeds.iter_mut().enumerate() {
            let bits = u64::from(words[1][lane]) << 32 | u64::from(words[0][lane]);
            *seed = (bits >> 1) as i64;
        }
    }
}

/// Draws `samples` (their numbers below 2^31, any subset, any order) of one problem and iteration
/// into the rows of `out`, `[samples, N]`.
pub fn draw(stream: Stream, iteration: usize, samples: &[u32], from: Draw<'_>, out: &mut [f32]) {
    if samples.is_empty() {
        return;
    }
    debug_assert!(iteration < MAX_ITERATIONS);
    let dimensions = out.len() / samples.len();
    debug_assert!(dimensions <= MAX_DIMENSIONS && dimensions * samples.len() == out.len());
    draw_vectorised(stream, iteration as u32, samples, from, out, dimensions);
}

#[multiversion(targets("x86_64+avx2", "aarch64+neon"))]
fn draw_vectorised(
    stream: Stream,
    iteration: u32,
    samples: &[u32],
    from: Draw<'_>,
    out: &mut [f32],
    dimensions: usize,
) {
    for (samples, rows) in samples.chunks(LANES).zip(out.chunks_mut(LANES * dimensions)) {
        let mut lanes = [samples[0]; LANES];
        lanes[..samples.len()].copy_from_slice(samples);
        for block in 0..dimensions.div_ceil(BLOCK) {
            let first = block * BLOCK;
            let wanted = (dimensions - first).min(BLOCK);
            let words = random_words(stream, iteration, block as u32, &lanes);
            let values = match from {
                Draw::Uniform { low, high } => {
                    uniform_values(&words, &low[first..], &high[first..])
                }
                Draw::Normal { mean, std, low, high } => {
                    let bounds = (&low[first..], &high[first..]);
                    normal_values(&words, &mean[first..], &std[first..], bounds)
                }
            };
            for (lane, row) in rows.chunks_exact_mut(dimensions).enumerate() {
                for (dimension, value) in row[first..first + wanted].iter_mut().enumerate() {
                    *value = values[dimension][lane];
                }
            }
        }
    }
}

type Words = [[u32; LANES]; BLOCK];
type Values = [[f32; LANES]; BLOCK];

#[inline(always)]
fn random_words(stream: Stream, iteration: u32, block: u32, samples: &[u32; LANES]) -> Words {
    let counter = [
        *samples,
        [(stream.purpose as u32) << 31 | iteration << 16 | block; LANES],
        [stream.problem as u32; LANES],
        [(stream.problem >> 32) as u32; LANES],
    ];
    philox_lanes(counter, stream.key())
}

#[inline(always)]
fn uniform_values(words: &Words, low: &[f32], high: &[f32]) -> Values {
    let mut values = [[0.0; LANES]; BLOCK];
    for dimension in 0..low.len().min(BLOCK) {
        let (low, high) = (low[dimension], high[dimension]);
        for lane in 0..LANES {
            let unit = (words[dimension][lane] >> 8) as i32 as f32 * (1.0 / (1 << 24) as f32);
            values[dimension][lane] = clip(low + (high - low) * unit, low, high);
        }
    }
    values
}

#[inline(always)]
fn normal_values(words: &Words, mean: &[f32], std: &[f32], bounds: (&[f32], &[f32])) -> Values {
    let mut values = [[0.0; LANES]; BLOCK];
    for pair in 0..BLOCK / 2 {
        let (first, second) = (2 * pair, 2 * pair + 1);
        for lane in 0..LANES {
            let (a, b) = normal_pair(words[first][lane], words[second][lane]);
            values[first][lane] = a;
            values[second][lane] = b;
        }
    }
    for dimension in 0..mean.len().min(BLOCK) {
        let (mean, std) = (mean[dimension], std[dimension]);
        let (low, high) = (bounds.0[dimension], bounds.1[dimension]);
        for value in &mut values[dimension] {
            *value = clip(mean + std * *value, low, high);
        }
    }
    values
}

/// Into `[low, high]`, as one minimum and one maximum instruction (`value` is never NaN).
#[inline(always)]
fn clip(value: f32, low: f32, high: f32) -> f32 {
    let raised = if value < low { low } else { value };
    if raised > high {
        high
    } else {
        raised
    }
}

/// Two independent standard normals from 64 random bits (Box & Muller, 1958).
#[inline(always)]
fn normal_pair(radius_bits: u32, angle_bits: u32) -> (f32, f32) {
    // 31 bits and a half: within (0, 1], so that the logarithm is finite; the longest radius, 6.66.
    let unit = ((radius_bits >> 1) as i32 as f32 + 0.5) * (1.0 / (1u32 << 31) as f32);
    let radius = (-2.0 * ln(unit)).sqrt();
    let (sin, cos) = sin_cos_of_turn(angle_bits);
    (radius * cos, radius * sin)
}

/// Natural logarithm of a positive normal number, relative error below 3e-7.
///
/// `x = 2^e m` with `m` in `[1/sqrt 2, sqrt 2)` and `ln m = 2 atanh s`, `s = (m - 1) / (m + 1)`,
/// by five terms of its series.
#[inline(always)]
fn ln(x: f32) -> f32 {
    const HALF_ROOT: i32 = (SQRT_2 / 2.0).to_bits() as i32;
    let bits = x.to_bits() as i32;
    let exponent = (bits - HALF_ROOT) >> 23;
    let mantissa = f32::from_bits((bits - (exponent << 23)) as u32);
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let z = s * s;
    let series = z * (1.0 / 3.0 + z * (1.0 / 5.0 + z * (1.0 / 7.0 + z * (1.0 / 9.0))));
    exponent as f32 * LN_2 + 2.0 * (s + s * series)
}

/// Sine and cosine of `bits / 2^32` of a full turn, absolute error below 1e-7.
///
/// The nearest quarter turn is split off exactly, in integers; what is left, within an eighth of
/// a turn, goes through Taylor's series.
#[inline(always)]
fn sin_cos_of_turn(bits: u32) -> (f32, f32) {
    const EIGHTH: u32 = 1 << 29;
    let quarter = bits.wrapping_add(EIGHTH) >> 30;
    let rest = bits.wrapping_sub(quarter << 30) as i32;
    let t = rest as f32 * (TAU / (1u64 << 32) as f32);
    let z = t * t;
    let sin = t + t
        * (z * (-1.0 / 6.0 + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362_880.0)))));
    let cos = 1.0 + z * (-0.5 + z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40_320.0))));
    let (sin, cos) = if quarter & 1 == 1 { (cos, sin) } else { (sin, cos) };
    let sin_sign = (quarter & 2) << 30;
    let cos_sign = (quarter.wrapping_add(1) & 2) << 30;
    (f32::from_bits(sin.to_bits() ^ sin_sign), f32::from_bits(cos.to_bits() ^ cos_sign))
}

#[cfg(test)]
#[path = "sampler_tests.rs"]
mod tests;
