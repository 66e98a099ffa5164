#![allow(clippy::unwrap_used)]

use super::*;
use crate::planner::philox::philox;
use proptest::prelude::*;

const UNBOUNDED: ([f32; 1], [f32; 1]) = ([f32::NEG_INFINITY], [f32::INFINITY]);

fn actions(seed: u64, problem: u64) -> Stream {
    Stream { seed, purpose: Purpose::Actions, problem }
}

fn standard_normals(stream: Stream, iteration: usize, samples: u32, dimensions: usize) -> Vec<f32> {
    let numbers: Vec<u32> = (0..samples).collect();
    let mut out = vec![0.0; samples as usize * dimensions];
    let low = vec![UNBOUNDED.0[0]; dimensions];
    let high = vec![UNBOUNDED.1[0]; dimensions];
    let (mean, std) = (vec![0.0; dimensions], vec![1.0; dimensions]);
    let from = Draw::Normal { mean: &mean, std: &std, low: &low, high: &high };
    draw(stream, iteration, &numbers, from, &mut out);
    out
}

/// Abramowitz & Stegun 7.1.26 is too coarse (1e-7 is fine here): series of the normal CDF.
fn normal_cdf(x: f64) -> f64 {
    if x.abs() > 7.0 {
        return if x > 0.0 { 1.0 } else { 0.0 };
    }
    // Phi(x) = 1/2 + phi(x) (x + x^3/3 + x^5/(3*5) + ...)
    let mut term = x;
    let mut sum = x;
    let mut n = 1.0;
    while term.abs() > 1e-17 {
        n += 2.0;
        term *= x * x / n;
        sum += term;
    }
    0.5 + sum * (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt()
}

/// Largest distance between the empirical CDF and `cdf`, times `sqrt(n)` (1.95 has p = 0.001).
fn kolmogorov(values: &[f32], cdf: impl Fn(f64) -> f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    let n = sorted.len() as f64;
    let distance = sorted.iter().enumerate().fold(0.0_f64, |worst, (i, &value)| {
        let p = cdf(f64::from(value));
        worst.max((p - i as f64 / n).abs()).max(((i + 1) as f64 / n - p).abs())
    });
    distance * n.sqrt()
}

fn correlation(a: &[f32], b: &[f32]) -> f64 {
    let n = a.len() as f64;
    let dot = |x: &[f32], y: &[f32]| {
        x.iter().zip(y).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum::<f64>() / n
    };
    let mean = |x: &[f32]| x.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
    let covariance = dot(a, b) - mean(a) * mean(b);
    covariance / ((dot(a, a) - mean(a).powi(2)) * (dot(b, b) - mean(b).powi(2))).sqrt()
}

#[test]
fn normals_have_the_moments_of_the_normal_distribution() {
    let values = standard_normals(actions(1, 2), 0, 40_000, 10);
    let n = values.len() as f64;
    let moment = |power: i32| values.iter().map(|v| f64::from(*v).powi(power)).sum::<f64>() / n;
    // Five standard errors of each sample moment: sqrt(var(x^p) / n).
    assert!(moment(1).abs() < 5.0 * (1.0 / n).sqrt());
    assert!((moment(2) - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
    assert!(moment(3).abs() < 5.0 * (15.0 / n).sqrt());
    assert!((moment(4) - 3.0).abs() < 5.0 * (96.0 / n).sqrt());
}

#[test]
fn normals_pass_kolmogorov_smirnov_in_every_dimension() {
    let dimensions = 6;
    let values = standard_normals(actions(7, 0), 1, 50_000, dimensions);
    for dimension in 0..dimensions {
        let column: Vec<f32> = values.iter().skip(dimension).step_by(dimensions).copied().collect();
        assert!(kolmogorov(&column, normal_cdf) < 1.95, "dimension {dimension}");
    }
}

#[test]
fn uniforms_pass_kolmogorov_smirnov_and_stay_in_the_box() {
    let numbers: Vec<u32> = (0..50_000).collect();
    let mut out = vec![0.0; numbers.len() * 2];
    let from = Draw::Uniform { low: &[-3.0, 0.0], high: &[3.0, 0.1] };
    draw(actions(3, 0), 0, &numbers, from, &mut out);
    let first: Vec<f32> = out.iter().step_by(2).copied().collect();
    let second: Vec<f32> = out.iter().skip(1).step_by(2).copied().collect();
    assert!(first.iter().all(|v| (-3.0..=3.0).contains(v)));
    assert!(second.iter().all(|v| (0.0..=0.1).contains(v)));
    assert!(kolmogorov(&first, |x| (x + 3.0) / 6.0) < 1.95);
    assert!(kolmogorov(&second, |x| x / 0.1) < 1.95);
}

#[test]
fn neighbouring_keys_are_uncorrelated() {
    let (samples, dimensions) = (20_000, 5);
    let base = standard_normals(actions(5, 9), 2, samples, dimensions);
    let n = base.len() as f64;
    let limit = 4.5 / n.sqrt();
    let next_seed = standard_normals(actions(6, 9), 2, samples, dimensions);
    let next_problem = standard_normals(actions(5, 10), 2, samples, dimensions);
    let next_iteration = standard_normals(actions(5, 9), 3, samples, dimensions);
    let far_problem = standard_normals(actions(5, 9 | 1 << 40), 2, samples, dimensions);
    let far_seed = standard_normals(actions(5 | 1 << 40, 9), 2, samples, dimensions);
    let latents = Stream { purpose: Purpose::Latents, ..actions(5, 9) };
    let other_purpose = standard_normals(latents, 2, samples, dimensions);
    for other in [other_purpose, next_seed, next_problem, next_iteration, far_problem, far_seed] {
        assert!(correlation(&base, &other).abs() < limit);
    }
    let shift_by_one_sample = correlation(&base[dimensions..], &base[..base.len() - dimensions]);
    assert!(shift_by_one_sample.abs() < limit);
    let shift_by_one_dimension = correlation(&base[1..], &base[..base.len() - 1]);
    assert!(shift_by_one_dimension.abs() < limit);
    let squares: Vec<f32> = base.iter().map(|v| v * v).collect();
    assert!(correlation(&squares[1..], &squares[..squares.len() - 1]).abs() < limit);
}

#[test]
fn logarithm_and_trigonometry_agree_with_double_precision() {
    let mut bits = 12345_u32;
    for _ in 0..200_000 {
        bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let unit = ((bits >> 1) as f32 + 0.5) / (1u32 << 31) as f32;
        let exact = f64::from(unit).ln();
        assert!((f64::from(ln(unit)) - exact).abs() <= 3e-7 * exact.abs().max(1e-3), "ln {unit}");
        let (sin, cos) = sin_cos_of_turn(bits);
        let angle = f64::from(bits) / 2f64.powi(32) * std::f64::consts::TAU;
        assert!((f64::from(sin) - angle.sin()).abs() < 1.5e-7, "sin {angle}");
        assert!((f64::from(cos) - angle.cos()).abs() < 1.5e-7, "cos {angle}");
    }
}

#[test]
fn extreme_bits_give_finite_normals() {
    for radius in [0, 1, 2, u32::MAX - 1, u32::MAX] {
        for angle in [0, 1, 1 << 29, 1 << 30, 1 << 31, 3 << 30, u32::MAX] {
            let (a, b) = normal_pair(radius, angle);
            assert!(a.is_finite() && b.is_finite() && a.hypot(b) < 6.7, "{radius} {angle}");
        }
    }
}

/// The same bits on every machine and for every instruction set: recorded once.
#[test]
fn draws_equal_the_recorded_bits() {
    let values = standard_normals(actions(0x0123_4567_89ab_cdef, 42), 3, 2, 3);
    let bits: Vec<u32> = values.iter().map(|v| v.to_bits()).collect();
    assert_eq!(bits, RECORDED, "{bits:#x?}");
}

const RECORDED: [u32; 6] =
    [0xbfc1_38a9, 0x3dba_6f25, 0xbfa5_480e, 0xbe90_7f69, 0xbf41_ce8a, 0xbdd2_c4d3];

proptest! {
    #[test]
    fn any_subset_of_samples_in_any_order_gives_the_same_rows(
        seed: u64,
        problem: u64,
        iteration in 0..MAX_ITERATIONS,
        dimensions in 1..20usize,
        subset in prop::collection::vec(0..60u32, 1..50),
    ) {
        let stream = actions(seed, problem);
        let all = standard_normals(stream, iteration, 60, dimensions);
        let (mean, std) = (vec![0.0; dimensions], vec![1.0; dimensions]);
        let (low, high) = (vec![f32::NEG_INFINITY; dimensions], vec![f32::INFINITY; dimensions]);
        let mut out = vec![0.0; subset.len() * dimensions];
        let from = Draw::Normal { mean: &mean, std: &std, low: &low, high: &high };
        draw(stream, iteration, &subset, from, &mut out);
        for (row, &sample) in out.chunks(dimensions).zip(&subset) {
            let first = sample as usize * dimensions;
            prop_assert_eq!(row, &all[first..first + dimensions]);
        }
    }

    #[test]
    fn clipped_normals_stay_in_the_box(mean in -5.0f32..5.0, std in 0.0f32..10.0, seed: u64) {
        let numbers: Vec<u32> = (0..100).collect();
        let mut out = vec![0.0; 100];
        let from = Draw::Normal { mean: &[mean], std: &[std], low: &[-1.0], high: &[2.0] };
        draw(actions(seed, 0), 0, &numbers, from, &mut out);
        prop_assert!(out.iter().all(|v| (-1.0..=2.0).contains(v)));
    }
}

#[test]
fn seeds_are_blocks_of_counters_that_no_candidate_has() {
    let stream =
        Stream { seed: 0x0123_4567_89ab_cdef, purpose: Purpose::Latents, problem: 7 << 33 };
    let mut seeds = [0; 40];
    draw_seeds(stream, 3, &mut seeds);
    for (sample, &seed) in seeds.iter().enumerate() {
        let counter = [sample as u32 | 1 << 31, 1 << 31 | 3 << 16, 0, 7 << 1];
        let [low, high, ..] = philox(counter, [0x89ab_cdef, 0x0123_4567]);
        assert_eq!(seed, ((u64::from(high) << 32 | u64::from(low)) >> 1) as i64);
    }
}

#[test]
fn seeds_are_uniform_and_unrelated_to_the_candidates() {
    let mut seeds = vec![0; 40_000];
    draw_seeds(actions(5, 9), 2, &mut seeds);
    let unit: Vec<f32> = seeds.iter().map(|&seed| (seed as f64 / 2f64.powi(63)) as f32).collect();
    assert!(kolmogorov(&unit, |x| x.clamp(0.0, 1.0)) < 1.95);
    let low: Vec<f32> = seeds.iter().map(|seed| (seed & 0xffff) as f32).collect();
    let normals = standard_normals(actions(5, 9), 2, 40_000, 2);
    let first: Vec<f32> = normals.iter().step_by(2).copied().collect();
    // Five standard errors of the correlation of unrelated numbers.
    assert!(correlation(&unit, &first).abs() < 5.0 / 200.0);
    assert!(correlation(&low, &first).abs() < 5.0 / 200.0);
    assert!(correlation(&unit, &low).abs() < 5.0 / 200.0);
}

proptest! {
    #[test]
    fn a_seed_depends_on_its_counter_only(
        seed: u64, problem: u64, iteration in 0usize..MAX_ITERATIONS, count in 0usize..70,
    ) {
        let stream = actions(seed, problem);
        let (mut some, mut many) = (vec![0; count], vec![0; 80]);
        draw_seeds(stream, iteration, &mut some);
        draw_seeds(stream, iteration, &mut many);
        prop_assert_eq!(&some, &many[..count]);
        prop_assert!(many.iter().all(|&seed| seed >= 0));
        for other in [actions(seed ^ 1, problem), actions(seed, problem ^ 1)] {
            let mut theirs = vec![0; 80];
            draw_seeds(other, iteration, &mut theirs);
            prop_assert!(many.iter().zip(&theirs).all(|(mine, theirs)| mine != theirs));
        }
    }
}
