#![allow(clippy::unwrap_used)]

use super::distribution::{Bounds, Gaussian, Initial};
use super::noise::Coloured;
use super::*;
use crate::planner::sampler::Purpose;
use proptest::prelude::*;

/// A valley along the diagonal, with its lowest place at (1, 1); remembers what it was asked.
#[derive(Default)]
struct Valley {
    seen: Vec<Array3<f32>>,
    told: Vec<Vec<Solution>>,
}

impl Objective for Valley {
    fn costs(&mut self, _call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>> {
        let (problems, samples, _) = candidates.dim();
        let costs = Array2::from_shape_fn((problems, samples), |(b, n)| {
            cost(&candidates.slice(ndarray::s![b, n, ..]).to_vec())
        });
        self.seen.push(candidates);
        Ok(costs)
    }

    fn iterated(&mut self, _: &[usize], solutions: &[&Solution]) -> Result<()> {
        self.told.push(solutions.iter().map(|&solution| solution.clone()).collect());
        Ok(())
    }
}

fn cost(row: &[f32]) -> f32 {
    let across: f32 = row.windows(2).map(|pair| (pair[0] - pair[1]).powi(2)).sum();
    10.0 * across + row.iter().map(|value| (value - 1.0).powi(2)).sum::<f32>()
}

const DIMENSIONS: usize = 4;

fn streams(count: u64) -> Vec<Stream> {
    (0..count).map(|problem| Stream { seed: 5, purpose: Purpose::Actions, problem }).collect()
}

fn start() -> Start {
    Initial::Normal { mean: vec![-1.0; DIMENSIONS], std: vec![2.0; DIMENSIONS] }.into()
}

fn white() -> Space {
    Bounds::unbounded(DIMENSIONS).into()
}

fn run(config: &CemConfig, space: &Space, start: Start, problems: u64) -> (Vec<Solution>, Valley) {
    let mut valley = Valley::default();
    let solutions = minimise(config, space, &[start], &streams(problems), &mut valley).unwrap();
    (solutions, valley)
}

fn small() -> CemConfig {
    CemConfig { samples: 40, elites: 10, iterations: 6, min_variance: 0.0, ..CemConfig::default() }
}

/// Settings of every option, alone and together.
fn any_config() -> impl Strategy<Value = CemConfig> {
    let covariance = prop_oneof![
        Just(Covariance::Diagonal),
        (0.01..1.0_f64).prop_map(|shrinkage| Covariance::Full { shrinkage }),
    ];
    (
        0usize..5,
        prop_oneof![Just(0.0), 0.0..0.9_f64],
        prop_oneof![Just(1.0), 1.0..2.0_f64],
        prop_oneof![Just(None), (0.01..50.0_f64).prop_map(Some)],
        prop_oneof![Just(0.0), 0.0..0.5_f64],
        covariance,
    )
        .prop_map(
            |(keep_elites, momentum, samples_decay, temperature, min_std, covariance)| {
                let options = CemConfig { keep_elites, momentum, samples_decay, ..small() };
                CemConfig { temperature, min_std, covariance, ..options }
            },
        )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn a_refit_equals_a_plain_reimplementation(
        config in any_config(),
        rows in prop::collection::vec(prop::collection::vec(-3.0..3.0_f32, 3), 2..12),
    ) {
        let before = Gaussian {
            mean: vec![0.5, -1.0, 2.0],
            std: vec![1.0, 0.1, 3.0],
            correlation: None,
        };
        let mut rows = rows;
        rows.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
        let costs: Vec<f32> = rows.iter().map(|row| cost(row)).collect();
        let found = before.refitted(&config, &rows.concat(), &costs);

        let weight = |n: usize| match config.temperature {
            None => 1.0,
            Some(temperature) => (-f64::from(costs[n] - costs[0]) / temperature).exp(),
        };
        let average = |of: &dyn Fn(&[f32]) -> f64| {
            let sum: f64 = rows.iter().enumerate().map(|(n, row)| weight(n) * of(row)).sum();
            sum / (0..rows.len()).map(weight).sum::<f64>()
        };
        let mean: Vec<f64> = (0..3).map(|a| average(&|row| f64::from(row[a]))).collect();
        let deviation = |row: &[f32], a: usize| f64::from(row[a]) - mean[a];
        let covariance =
            |a: usize, b: usize| average(&|row| deviation(row, a) * deviation(row, b));
        let m = config.momentum;
        let close = |found: f64, expected: f64| (found - expected).abs() < 1e-5 * (1.0 + expected.abs());
        for (a, &mean) in mean.iter().enumerate() {
            let expected = m * f64::from(before.mean[a]) + (1.0 - m) * mean;
            prop_assert!(close(f64::from(found.mean[a]), expected));
            let blended = m * f64::from(before.std[a]) + (1.0 - m) * covariance(a, a).sqrt();
            prop_assert!(close(f64::from(found.std[a]), blended.max(config.min_std)));
        }
        match (config.covariance, found.correlation) {
            (Covariance::Diagonal, found) => prop_assert!(found.is_none()),
            (Covariance::Full { shrinkage }, found) => {
                let found = found.unwrap().matrix();
                for (a, b) in [(0, 1), (0, 2), (1, 2)] {
                    let scale = (covariance(a, a) * covariance(b, b)).sqrt();
                    prop_assume!(scale > 1e-6);
                    let expected = (1.0 - m) * (1.0 - shrinkage) * covariance(a, b) / scale;
                    prop_assert!(close(found[a * 3 + b], expected));
                }
            }
        }
    }

    #[test]
    fn kept_elites_never_let_the_best_cost_rise(config in any_config(), keep in 1usize..10) {
        let config = CemConfig { keep_elites: keep, ..config };
        let (solutions, _) = run(&config, &white(), start(), 3);
        for solution in solutions {
            prop_assert_eq!(solution.history.len(), config.iterations);
            prop_assert!(solution.history.windows(2).all(|pair| pair[1].best <= pair[0].best));
            prop_assert_eq!(solution.cost, solution.history.last().unwrap().best);
        }
    }

    #[test]
    fn no_option_depends_on_threads_or_on_other_problems(config in any_config(), beta in 0.0..3.0_f64) {
        let noise = match config.covariance {
            Covariance::Diagonal => Some(Coloured::new(beta, 2, 2)),
            Covariance::Full { .. } => None,
        };
        let space = Space { noise, ..white() };
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| run(&config, &space, start(), 5).0)
        };
        let together = on(1);
        prop_assert_eq!(&together, &on(3));
        let mut valley = Valley::default();
        let alone =
            minimise(&config, &space, &[start()], &streams(5)[3..4], &mut valley).unwrap();
        prop_assert_eq!(&alone[0], &together[3]);
    }
}

#[test]
fn infinite_costs_count_as_the_best_or_not_at_all() {
    let config = CemConfig { temperature: Some(1.0), ..small() };
    let fit = |costs: [f32; 2]| Gaussian::default().refitted(&config, &[1.0, 3.0], &costs).mean[0];
    assert_eq!(fit([0.0, f32::INFINITY]), 1.0);
    assert_eq!(fit([f32::NEG_INFINITY, 0.0]), 1.0);
    assert_eq!(fit([f32::INFINITY; 2]), 2.0);
    assert_eq!(fit([f32::NEG_INFINITY; 2]), 2.0);
}

#[test]
fn shrunk_to_nothing_a_full_covariance_is_a_diagonal_one() {
    let full = CemConfig { covariance: Covariance::Full { shrinkage: 1.0 }, ..small() };
    assert_eq!(run(&full, &white(), start(), 3).0, run(&small(), &white(), start(), 3).0);
}

#[test]
fn a_full_covariance_follows_a_valley_that_a_diagonal_one_does_not() {
    let budget = CemConfig { samples: 100, iterations: 8, ..small() };
    let full = CemConfig { covariance: Covariance::Full { shrinkage: 0.1 }, ..budget.clone() };
    let cost = |config| {
        let (solutions, _) = run(config, &white(), start(), 40);
        solutions.iter().map(|solution| solution.cost).sum::<f32>()
    };
    let (full, diagonal) = (cost(&full), cost(&budget));
    assert!(full < 0.5 * diagonal, "{full} {diagonal}");
}

#[test]
fn samples_decay_to_twice_the_elites() {
    let config = CemConfig { samples_decay: 1.25, ..small() };
    let (_, valley) = run(&config, &white(), start(), 2);
    let counts: Vec<usize> = valley.seen.iter().map(|seen| seen.dim().1).collect();
    // 40 / 1.25^i, rounded down, but not below 20.
    assert_eq!(counts, [40, 32, 25, 20, 20, 20]);
    let few = CemConfig { samples: 15, ..config };
    assert_eq!(few.samples_in(3), 15);
}

#[test]
fn given_candidates_compete_in_the_first_iteration() {
    let given = Start { candidates: [vec![1.0; 4], vec![0.5; 4]].concat(), ..start() };
    let (solutions, valley) = run(&small(), &white(), given, 1);
    let first = valley.seen[0].index_axis(Axis(0), 0);
    assert_eq!(first.row(0).to_vec(), [1.0; 4]);
    assert_eq!(first.row(1).to_vec(), [0.5; 4]);
    assert_eq!((solutions[0].cost, &solutions[0].candidate[..]), (0.0, &[1.0; 4][..]));
    let (_, plain) = run(&small(), &white(), start(), 1);
    assert_eq!(first.slice(ndarray::s![2.., ..]), plain.seen[0].slice(ndarray::s![0, 2.., ..]));
}

#[test]
fn objectives_are_told_how_problems_stand() {
    let (solutions, valley) = run(&small(), &white(), start(), 2);
    assert_eq!(valley.told.len(), 6);
    assert_eq!(valley.told[5], solutions);
    assert!(valley.told.iter().enumerate().all(|(n, told)| told[0].history.len() == n + 1));
}

#[test]
fn options_out_of_range_are_named() {
    let named = |config: CemConfig, argument: &str| {
        let error = config.validate().unwrap_err().to_string();
        assert!(error.starts_with(argument), "{error}");
    };
    for momentum in [-0.1, 1.0, f64::NAN] {
        named(CemConfig { momentum, ..small() }, "momentum: must be from 0 to below 1");
    }
    for samples_decay in [0.99, f64::INFINITY, f64::NAN] {
        named(CemConfig { samples_decay, ..small() }, "samples_decay: must be");
    }
    for temperature in [0.0, -1.0, f64::INFINITY, f64::NAN] {
        named(CemConfig { temperature: Some(temperature), ..small() }, "temperature: must be");
    }
    for min_std in [-1e-9, 1e38, f64::INFINITY, f64::NAN] {
        named(CemConfig { min_std, ..small() }, "min_std: must be");
    }
    for shrinkage in [0.0, 1e-9, 1.1, f64::NAN] {
        let covariance = Covariance::Full { shrinkage };
        named(CemConfig { covariance, ..small() }, "shrinkage: must be");
    }
    let full = CemConfig { covariance: Covariance::Full { shrinkage: 0.1 }, ..small() };
    let refused = |space: Space| {
        let dimensions = space.bounds.low.len();
        let (mean, std) = (vec![0.0; dimensions], vec![1.0; dimensions]);
        let start = Start::from(Initial::Normal { mean, std });
        let error = minimise(&full, &space, &[start], &streams(1), &mut Valley::default());
        error.unwrap_err().to_string()
    };
    let many = refused(Bounds::unbounded(MAX_CORRELATED + 1).into());
    assert!(many.starts_with("covariance: 'full' is for at most 256"), "{many}");
    let coloured = refused(Space { noise: Some(Coloured::new(1.0, 2, 2)), ..white() });
    assert!(coloured.contains("noise_beta must be 0"), "{coloured}");
}
