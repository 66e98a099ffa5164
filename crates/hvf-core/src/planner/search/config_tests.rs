#![allow(clippy::unwrap_used)]

use proptest::prelude::*;

use super::Reduction;

const ALL: [Reduction; 3] = [Reduction::Max, Reduction::Mean, Reduction::MaxSum];

fn cost(reduction: Reduction, segments: &[f32]) -> f32 {
    reduction.of(segments.iter().copied())
}

proptest! {
    /// Of costs in whole units, which integers add without rounding.
    #[test]
    fn costs_are_the_hardest_segment_the_mean_and_the_hardest_with_a_tenth_of_the_sum(
        units in prop::collection::vec(-1_000_000i32..1_000_000, 1..12),
    ) {
        let segments: Vec<f32> = units.iter().map(|&unit| unit as f32 / 1024.0).collect();
        let (hardest, sum) = (*units.iter().max().unwrap(), units.iter().sum::<i32>());
        let near = |found: f32, numerator: f64, denominator: f64| {
            let expected = numerator / denominator / 1024.0;
            let error = (f64::from(found) - expected).abs();
            assert!(error <= 1e-7 * expected.abs() + 1e-12, "{found} for {expected}");
        };
        near(cost(Reduction::Max, &segments), f64::from(hardest), 1.0);
        near(cost(Reduction::Mean, &segments), f64::from(sum), units.len() as f64);
        near(cost(Reduction::MaxSum, &segments), f64::from(10 * hardest + sum), 10.0);
    }

    #[test]
    fn a_segment_of_nan_makes_a_sample_of_nan(
        segments in prop::collection::vec(-10.0f32..10.0, 1..6),
        at: prop::sample::Index,
    ) {
        let mut segments = segments;
        let at = at.index(segments.len());
        segments[at] = f32::NAN;
        for reduction in ALL {
            prop_assert!(cost(reduction, &segments).is_nan());
        }
    }

    /// Each segment but the hardest is worth a tenth of it at most, so no sample is chosen for its
    /// sum whose hardest segment is harder by more.
    #[test]
    fn the_sum_decides_between_samples_that_are_about_as_hard_and_no_others(
        others in prop::collection::vec(0.01f32..1.0, 1..6),
        easier: prop::sample::Index,
    ) {
        let segments = [&[1.0], &others[..]].concat();
        let mut less = segments.clone();
        less[1 + easier.index(others.len())] *= 0.5;
        prop_assert!(cost(Reduction::MaxSum, &less) < cost(Reduction::MaxSum, &segments));
        let mut harder = vec![0.0; segments.len()];
        harder[0] = 1.0 + 0.1 * others.len() as f32;
        prop_assert!(cost(Reduction::MaxSum, &harder) > cost(Reduction::MaxSum, &segments));
    }
}

/// By the maximum it is all one what the easier segment costs.
#[test]
fn where_the_hardest_are_equal_the_least_sum_is_cheapest() {
    let costs = |reduction| [[1.0, 0.25], [1.0, 1.0]].map(|segments| cost(reduction, &segments));
    let [a, b] = costs(Reduction::Max);
    assert_eq!(a, b);
    assert_eq!(costs(Reduction::MaxSum), [1.125, 1.2]);
}

#[test]
fn infinite_segments_are_infinite_samples() {
    for reduction in ALL {
        assert_eq!(cost(reduction, &[1.0, f32::INFINITY, 2.0]), f32::INFINITY);
    }
    assert!(cost(Reduction::MaxSum, &[f32::INFINITY, f32::NEG_INFINITY]).is_nan());
}
