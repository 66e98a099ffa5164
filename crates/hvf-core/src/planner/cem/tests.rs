#![allow(clippy::unwrap_used)]

use super::distribution::{Bounds, Gaussian, Initial};
use super::*;
use crate::planner::sampler::Purpose;
use proptest::prelude::*;

/// Squared distance to a target per problem; remembers the candidates it saw.
struct Quadratic {
    targets: Vec<Vec<f32>>,
    per_call: usize,
    seen: Vec<(usize, Vec<usize>, Array3<f32>)>,
}

impl Quadratic {
    fn new(targets: Vec<Vec<f32>>) -> Self {
        Self { targets, per_call: usize::MAX, seen: Vec::new() }
    }
}

impl Objective for Quadratic {
    fn problems_per_call(&self) -> usize {
        self.per_call
    }

    fn costs(&mut self, call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>> {
        let (problems, samples, dimensions) = candidates.dim();
        let costs = Array2::from_shape_fn((problems, samples), |(b, n)| {
            let target = &self.targets[call.problems[b]];
            (0..dimensions).map(|d| (candidates[[b, n, d]] - target[d]).powi(2)).sum()
        });
        self.seen.push((call.iteration, call.problems.to_vec(), candidates));
        Ok(costs)
    }
}

fn stream(problem: u64) -> Stream {
    Stream { seed: 11, purpose: Purpose::Actions, problem }
}

fn box_of(dimensions: usize, size: f32) -> (Space, Start) {
    let (low, high) = (vec![-size; dimensions], vec![size; dimensions]);
    let bounds = Bounds { low: low.clone(), high: high.clone() };
    (bounds.into(), Initial::Uniform { low, high }.into())
}

#[test]
fn finds_the_minimum_of_a_quadratic_and_the_corner_of_the_box() {
    let config = CemConfig { iterations: 20, min_variance: 0.0, ..CemConfig::default() };
    let (bounds, initial) = box_of(3, 2.0);
    let mut objective = Quadratic::new(vec![vec![0.5, -1.0, 1.5], vec![5.0, -5.0, 0.0]]);
    let solutions =
        minimise(&config, &bounds, &[initial], &[stream(0), stream(1)], &mut objective).unwrap();
    for (solution, optimum) in solutions.iter().zip([[0.5, -1.0, 1.5], [2.0, -2.0, 0.0]]) {
        for (value, best) in solution.candidate.iter().zip(optimum) {
            assert!((value - best).abs() < 1e-2, "{solution:?}");
        }
    }
}

/// The whole method, written again with plain loops over the candidates that the objective saw.
#[test]
fn elites_refit_and_statistics_equal_a_plain_reimplementation() {
    let config = CemConfig {
        samples: 30,
        elites: 7,
        iterations: 4,
        min_variance: 0.0,
        keep_elites: 3,
        ..CemConfig::default()
    };
    let (bounds, initial) = box_of(2, 2.0);
    let target = vec![0.3, -0.4];
    let mut objective = Quadratic::new(vec![target.clone()]);
    let solutions = minimise(&config, &bounds, &[initial], &[stream(4)], &mut objective).unwrap();

    let cost = |row: &[f32]| (row[0] - target[0]).powi(2) + (row[1] - target[1]).powi(2);
    let mut carried: Vec<Vec<f32>> = Vec::new();
    let mut best: Vec<f32> = Vec::new();
    for (iteration, (number, _, candidates)) in objective.seen.iter().enumerate() {
        assert_eq!(*number, iteration);
        let new = candidates.outer_iter().next().unwrap();
        let new: Vec<Vec<f32>> = new.outer_iter().map(|row| row.to_vec()).collect();
        let mut pool = carried.clone();
        pool.extend(new.iter().cloned());
        pool.sort_by(|a, b| cost(a).partial_cmp(&cost(b)).unwrap());
        let elites = &pool[..7];
        if best.is_empty() || cost(&elites[0]) < cost(&best) {
            best = elites[0].clone();
        }
        let stats = solutions[0].history[iteration];
        let close = |a: f32, b: f64| (f64::from(a) - b).abs() < 1e-6 * (1.0 + b.abs());
        let average = |rows: &[Vec<f32>]| {
            rows.iter().map(|row| f64::from(cost(row))).sum::<f64>() / rows.len() as f64
        };
        assert_eq!(stats.best, cost(&elites[0]));
        assert_eq!(stats.elite_worst, cost(&elites[6]));
        assert!(close(stats.elite_mean, average(elites)));
        assert!(close(stats.population_mean, average(&new)));
        let std = |d: usize| {
            let mean = elites.iter().map(|row| f64::from(row[d])).sum::<f64>() / 7.0;
            (elites.iter().map(|row| (f64::from(row[d]) - mean).powi(2)).sum::<f64>() / 7.0).sqrt()
        };
        assert!(close(stats.max_std, std(0).max(std(1))));
        carried = elites[..3].to_vec();
    }
    assert_eq!(solutions[0].candidate, best);
    assert_eq!(solutions[0].cost, cost(&best));
}

#[test]
fn later_iterations_draw_from_the_refitted_gaussian() {
    let config = CemConfig {
        samples: 5000,
        elites: 50,
        iterations: 2,
        min_variance: 0.0,
        ..CemConfig::default()
    };
    let (_, initial) = box_of(1, 2.0);
    let mut objective = Quadratic::new(vec![vec![0.7]]);
    minimise(&config, &Bounds::unbounded(1).into(), &[initial], &[stream(0)], &mut objective)
        .unwrap();
    let mut first: Vec<f32> = objective.seen[0].2.iter().copied().collect();
    first.sort_by(|a, b| (a - 0.7).abs().partial_cmp(&(b - 0.7).abs()).unwrap());
    let fit = Gaussian::fit(&first[..50], &[1.0; 50], 1);
    let drawn: Vec<f32> = objective.seen[1].2.iter().copied().collect();
    let second = Gaussian::fit(&drawn, &vec![1.0; drawn.len()], 1);
    assert!((second.mean[0] - fit.mean[0]).abs() < 5.0 * fit.std[0] / 5000f32.sqrt());
    assert!((second.std[0] / fit.std[0] - 1.0).abs() < 5.0 / (2.0 * 5000f32).sqrt());
}

#[test]
fn problems_stop_on_their_own() {
    let config = CemConfig { iterations: 50, min_variance: 1e-3, ..CemConfig::default() };
    let (bounds, initial) = box_of(2, 2.0);
    let targets = vec![vec![0.0, 0.0], vec![30.0, 30.0]];
    let mut objective = Quadratic::new(targets);
    let solutions =
        minimise(&config, &bounds, &[initial], &[stream(0), stream(1)], &mut objective).unwrap();
    for solution in &solutions {
        let (last, before) = solution.history.split_last().unwrap();
        assert!(last.max_std.powi(2) < 1e-3);
        assert!(before.iter().all(|stats| stats.max_std.powi(2) >= 1e-3));
    }
    let calls_with_both = objective.seen.iter().filter(|(_, problems, _)| problems.len() == 2);
    let shortest = solutions.iter().map(|solution| solution.history.len()).min().unwrap();
    assert_eq!(calls_with_both.count(), shortest);
}

/// Costs by sample number; the same every iteration.
struct Table(Vec<f32>);

impl Objective for Table {
    fn costs(&mut self, call: Call<'_>, candidates: Array3<f32>) -> Result<Array2<f32>> {
        assert_eq!(candidates.dim().1, self.0.len());
        Ok(Array2::from_shape_fn((call.problems.len(), self.0.len()), |(_, n)| self.0[n]))
    }
}

fn once(costs: &[f32], elites: usize) -> Result<Solution> {
    let config = CemConfig {
        samples: costs.len(),
        elites,
        iterations: 1,
        min_variance: 0.0,
        ..CemConfig::default()
    };
    let (bounds, initial) = box_of(1, 1.0);
    let mut objective = Table(costs.to_vec());
    minimise(&config, &bounds, &[initial], &[stream(0)], &mut objective)
        .map(|mut all| all.remove(0))
}

#[test]
fn nan_is_never_an_elite() {
    let solution = once(&[f32::NAN, 3.0, f32::NAN, 1.0, f32::INFINITY], 4).unwrap();
    assert_eq!(solution.cost, 1.0);
    assert_eq!(solution.history[0].elite_worst, f32::INFINITY);
    assert_eq!(solution.history[0].population_mean, 2.0);
}

#[test]
fn all_nan_is_an_error_that_says_which_problem() {
    let error = once(&[f32::NAN; 3], 2).unwrap_err().to_string();
    assert!(error.contains("problem 0") && error.contains("NaN"), "{error}");
}

#[test]
fn costs_of_the_wrong_shape_are_an_error() {
    struct Wrong;
    impl Objective for Wrong {
        fn costs(&mut self, _: Call<'_>, _: Array3<f32>) -> Result<Array2<f32>> {
            Ok(Array2::zeros((1, 7)))
        }
    }
    let (bounds, initial) = box_of(1, 1.0);
    let error =
        minimise(&CemConfig::default(), &bounds, &[initial], &[stream(0)], &mut Wrong).unwrap_err();
    assert!(error.to_string().contains("(1, 200)"), "{error}");
}

#[test]
fn more_samples_than_memory_could_hold_are_refused() {
    let config = CemConfig { samples: 1 << 30, ..CemConfig::default() };
    let (bounds, initial) = box_of(3, 2.0);
    let mut objective = Quadratic::new(vec![vec![0.0; 3]]);
    let error = minimise(&config, &bounds, &[initial], &[stream(0)], &mut objective).unwrap_err();
    assert!(error.to_string().starts_with("samples"), "{error}");
}

#[test]
fn kept_elites_make_the_best_cost_of_an_iteration_monotone() {
    let config = CemConfig {
        samples: 10,
        elites: 5,
        keep_elites: 1,
        iterations: 12,
        min_variance: 0.0,
        ..CemConfig::default()
    };
    let (bounds, initial) = box_of(6, 2.0);
    let mut objective = Quadratic::new(vec![vec![0.1; 6]]);
    let solution =
        minimise(&config, &bounds, &[initial], &[stream(3)], &mut objective).unwrap().remove(0);
    assert!(solution.history.windows(2).all(|pair| pair[1].best <= pair[0].best));
}

proptest! {
    #[test]
    fn the_answer_may_be_of_the_last_iteration_only(
        problem: u64,
        keep_elites in 0usize..4,
        iterations in 1usize..6,
    ) {
        let last = CemConfig {
            samples: 12,
            elites: 4,
            iterations,
            min_variance: 0.02,
            keep_elites,
            best: BestOf::Last,
            ..CemConfig::default()
        };
        let (bounds, initial) = box_of(2, 2.0);
        let initial = [initial];
        let solved = |config: &CemConfig| {
            let mut objective = Quadratic::new(vec![vec![0.3, 5.0]]);
            let stream = [stream(problem)];
            let solution = minimise(config, &bounds, &initial, &stream, &mut objective);
            (solution.unwrap().remove(0), objective.seen)
        };
        let (answer, seen) = solved(&last);
        let (over_all, _) = solved(&CemConfig { best: BestOf::All, ..last });
        prop_assert_eq!(&answer.history, &over_all.history);
        if keep_elites > 0 {
            // The best of all is among those kept.
            prop_assert_eq!(answer, over_all);
        } else {
            let cost = |row: &[f32]| (row[0] - 0.3).powi(2) + (row[1] - 5.0).powi(2);
            let rows = seen.last().unwrap().2.rows().into_iter().map(|row| row.to_vec());
            let best = rows.min_by(|a, b| cost(a).partial_cmp(&cost(b)).unwrap()).unwrap();
            prop_assert_eq!(answer.cost, cost(&best));
            prop_assert_eq!(&answer.candidate, &best);
        }
    }
}

#[test]
fn fields_out_of_range_are_named() {
    let good = CemConfig::default();
    for (field, config) in [
        ("samples", CemConfig { samples: 0, ..good.clone() }),
        ("elites", CemConfig { elites: 0, ..good.clone() }),
        ("elites", CemConfig { elites: 201, ..good.clone() }),
        ("iterations", CemConfig { iterations: 0, ..good.clone() }),
        ("iterations", CemConfig { iterations: 1 << 20, ..good.clone() }),
        ("min_variance", CemConfig { min_variance: -1.0, ..good.clone() }),
        ("min_variance", CemConfig { min_variance: f64::NAN, ..good.clone() }),
        ("keep_elites", CemConfig { keep_elites: 41, ..good.clone() }),
    ] {
        let error = config.validate().unwrap_err().to_string();
        assert!(error.starts_with(field), "{field}: {error}");
    }
}

proptest! {
    #[test]
    fn a_problem_does_not_depend_on_its_batch(
        order in Just((0..7usize).collect::<Vec<_>>()).prop_shuffle(),
        per_call in 1usize..9,
    ) {
        let config =
            CemConfig { samples: 40, elites: 8, iterations: 4, min_variance: 0.02, keep_elites: 2, ..CemConfig::default() };
        let (bounds, initial) = box_of(3, 2.0);
        let target = |problem: usize| vec![problem as f32 * 0.3 - 1.0; 3];
        let mut all = Quadratic::new((0..7).map(target).collect());
        let streams: Vec<Stream> = (0..7).map(stream).collect();
        let expected =
            minimise(&config, &bounds, std::slice::from_ref(&initial), &streams, &mut all).unwrap();
        let mut shuffled = Quadratic::new(order.iter().map(|&problem| target(problem)).collect());
        shuffled.per_call = per_call;
        let streams: Vec<Stream> = order.iter().map(|&problem| stream(problem as u64)).collect();
        let found = minimise(&config, &bounds, &[initial], &streams, &mut shuffled).unwrap();
        for (solution, &problem) in found.iter().zip(&order) {
            prop_assert_eq!(solution, &expected[problem]);
        }
    }
}
