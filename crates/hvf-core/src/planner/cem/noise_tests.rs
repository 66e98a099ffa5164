#![allow(clippy::unwrap_used)]

use super::*;
use crate::planner::sampler::Purpose;
use proptest::prelude::*;

const STREAM: Stream = Stream { seed: 3, purpose: Purpose::Actions, problem: 9 };

/// Draws of a unit Gaussian, `[samples, N]`.
fn drawn(mixing: Mixing<'_>, samples: u32, dimensions: usize) -> Vec<f32> {
    let (mean, std) = (vec![0.0; dimensions], vec![1.0; dimensions]);
    let (low, high) = (vec![-1e9; dimensions], vec![1e9; dimensions]);
    let from = Draw::Normal { mean: &mean, std: &std, low: &low, high: &high };
    let mut out = vec![0.0; samples as usize * dimensions];
    draw(STREAM, 2, &(0..samples).collect::<Vec<_>>(), mixing, from, &mut out);
    out
}

/// Mean of the product of two dimensions.
fn product(rows: &[f32], dimensions: usize, a: usize, b: usize) -> f64 {
    let rows = rows.chunks_exact(dimensions);
    let count = rows.len() as f64;
    rows.map(|row| f64::from(row[a]) * f64::from(row[b])).sum::<f64>() / count
}

#[test]
fn power_falls_with_frequency_by_the_exponent() {
    const STEPS: usize = 12;
    const DIM: usize = 2;
    const SAMPLES: u32 = 20_000;
    for beta in [0.5, 1.0, 2.0, 4.0] {
        let noise = Coloured::new(beta, STEPS, DIM);
        let rows = drawn(Mixing::Coloured(&noise), SAMPLES, STEPS * DIM);
        let law = |k: usize| (k.max(1) as f64).powf(-beta);
        let total: f64 = (0..STEPS).map(|k| law(k.min(STEPS - k))).sum();
        for (k, value) in (0..=STEPS / 2).flat_map(|k| [(k, 0), (k, 1)]) {
            // Periodogram by the definition of the discrete Fourier transform.
            let power = rows.chunks_exact(STEPS * DIM).map(|row| {
                let part = |wave: fn(f64) -> f64| -> f64 {
                    let turn = |t: usize| TAU * (k * t) as f64 / STEPS as f64;
                    (0..STEPS).map(|t| f64::from(row[t * DIM + value]) * wave(turn(t))).sum()
                };
                part(f64::cos).powi(2) + part(f64::sin).powi(2)
            });
            let found = power.sum::<f64>() / f64::from(SAMPLES) / (STEPS * STEPS) as f64;
            let expected = law(k) / total;
            // The standard error of a real component's power is a hundredth.
            assert!((found / expected - 1.0).abs() < 0.06, "{beta} {k}: {found} {expected}");
        }
    }
}

#[test]
fn neighbouring_steps_are_alike_by_the_closed_form() {
    // Frequencies 0 and 1 have power 1, frequency 2 has 1/4, and all but 0 come twice.
    let turn = TAU / 5.0;
    let closed = |lag: f64| (1.0 + 2.0 * (turn * lag).cos() + 0.5 * (2.0 * turn * lag).cos()) / 3.5;
    let Coloured { kernel, .. } = Coloured::new(2.0, 5, 1);
    for lag in 0..5 {
        let found: f64 = (0..5).map(|t| kernel[t] * kernel[(t + lag) % 5]).sum();
        assert!((found - closed(lag as f64)).abs() < 1e-12, "{lag}: {found}");
    }
    assert!((closed(0.0) - 1.0).abs() < 1e-15);
}

#[test]
fn without_an_exponent_or_more_than_two_steps_noise_is_white() {
    for (beta, steps) in [(0.0, 7), (3.0, 1), (3.0, 2), (0.0, 1)] {
        let noise = Coloured::new(beta, steps, 2);
        let mixed = drawn(Mixing::Coloured(&noise), 50, 2 * steps);
        for (mixed, white) in mixed.iter().zip(drawn(Mixing::None, 50, 2 * steps)) {
            assert!((mixed - white).abs() < 1e-6);
        }
    }
}

#[test]
fn coloured_values_of_a_uniform_distribution_stay_uniform() {
    const SAMPLES: u32 = 20_000;
    let noise = Coloured::new(2.0, 6, 1);
    let (low, high) = (vec![-3.0; 6], vec![1.0; 6]);
    let from = Draw::Uniform { low: &low, high: &high };
    let mut out = vec![0.0; SAMPLES as usize * 6];
    let numbers: Vec<u32> = (0..SAMPLES).collect();
    draw(STREAM, 0, &numbers, Mixing::Coloured(&noise), from, &mut out);
    for step in 0..6 {
        let mut values: Vec<f32> = out.iter().skip(step).step_by(6).copied().collect();
        values.sort_by(f32::total_cmp);
        let distance = values.iter().enumerate().fold(0.0_f64, |worst, (n, &value)| {
            let share = (f64::from(value) + 3.0) / 4.0;
            worst.max((share - n as f64 / f64::from(SAMPLES)).abs())
        });
        // Kolmogorov: 1.95 has p = 0.001.
        assert!(distance * f64::from(SAMPLES).sqrt() < 1.95, "{step}: {distance}");
    }
    let centred: Vec<f32> = out.iter().map(|value| value + 1.0).collect();
    let correlation = product(&centred, 6, 2, 3) / product(&centred, 6, 2, 2);
    assert!(correlation > 0.3, "{correlation}");
}

/// A covariance matrix: that of as many random rows as it has, and a half, with scales of its own.
fn any_covariance(numbers: &[f64], dimensions: usize) -> DMatrix<f64> {
    let rows = DMatrix::from_fn(dimensions * 3 / 2 + 1, dimensions, |row, column| {
        numbers[(row * dimensions + column) % numbers.len()] * (column + 1) as f64
    });
    rows.transpose() * rows
}

proptest! {
    #[test]
    fn the_factor_is_that_of_the_shrunk_correlations(
        numbers in prop::collection::vec(-1.0..1.0_f64, 71),
        dimensions in 1usize..8,
        shrinkage in 0.01..1.0_f64,
    ) {
        let covariance = any_covariance(&numbers, dimensions);
        let found = Correlation::of(&covariance, shrinkage).unwrap();
        for a in 0..dimensions {
            for b in 0..dimensions {
                let scale = (covariance[(a, a)] * covariance[(b, b)]).sqrt();
                let expected = match a == b {
                    true => 1.0,
                    false => (1.0 - shrinkage) * covariance[(a, b)] / scale,
                };
                let factored: f64 =
                    (0..dimensions).map(|n| found.factor[(a, n)] * found.factor[(b, n)]).sum();
                prop_assert!((factored - expected).abs() < 1e-12);
                prop_assert!((found.matrix()[a * dimensions + b] - expected).abs() < 1e-12);
                prop_assert!(b <= a || found.factor[(a, b)] == 0.0);
            }
        }
    }

    #[test]
    fn any_samples_drawn_again_are_the_same(
        beta in 0.0..4.0_f64,
        which in prop::collection::vec(0u32..40, 1..9),
    ) {
        let coloured = Coloured::new(beta, 3, 2);
        let correlated = Correlation::of(&any_covariance(&[0.3, -0.7, 0.9, 0.1, -0.2], 6), 0.2);
        let correlated = correlated.unwrap();
        for mixing in [Mixing::Coloured(&coloured), Mixing::Correlated(&correlated)] {
            let all = drawn(mixing, 40, 6);
            let (mean, std) = ([0.0; 6], [1.0; 6]);
            let (low, high) = ([-1e9; 6], [1e9; 6]);
            let from = Draw::Normal { mean: &mean, std: &std, low: &low, high: &high };
            let mut again = vec![0.0; which.len() * 6];
            draw(STREAM, 2, &which, mixing, from, &mut again);
            for (row, &sample) in again.chunks(6).zip(&which) {
                prop_assert_eq!(row, &all[sample as usize * 6..][..6]);
            }
        }
    }
}

#[test]
fn draws_have_the_correlations() {
    let covariance = DMatrix::from_row_slice(3, 3, &[4.0, 1.8, 0.0, 1.8, 1.0, 0.0, 0.0, 0.0, 0.0]);
    let correlation = Correlation::of(&covariance, 0.5).unwrap();
    let rows = drawn(Mixing::Correlated(&correlation), 20_000, 3);
    for (a, b, expected) in [(0, 0, 1.0), (1, 1, 1.0), (2, 2, 1.0), (0, 1, 0.45), (1, 2, 0.0)] {
        let found = product(&rows, 3, a, b);
        assert!((found - expected).abs() < 0.05, "{a} {b}: {found}");
    }
}

#[test]
fn momentum_blends_correlations() {
    let of = |r: f64| DMatrix::from_row_slice(2, 2, &[1.0, r, r, 1.0]);
    let old = Correlation::of(&of(0.8), 0.5).unwrap();
    let new = |before| Correlation::of(&of(-0.8), 0.5).unwrap().blended(before, 0.25).unwrap();
    assert!((new(Some(&old)).matrix()[1] - (0.25 * 0.4 - 0.75 * 0.4)).abs() < 1e-15);
    assert!((new(None).matrix()[1] + 0.75 * 0.4).abs() < 1e-15);
}
