#![allow(clippy::unwrap_used)]

use crate::planner::cem::CemConfig;
use crate::planner::point_mass::{PointMass, Points, Positions};
use crate::planner::search::{search, HvfConfig, Reduction, SearchResult, SegmentCost, Watch};
use crate::Result;

const START: [f32; 2] = [0.0, 0.0];
const GOAL: [f32; 2] = [3.0, -1.5];

fn config(subgoals: usize) -> HvfConfig {
    let cem = CemConfig { samples: 200, elites: 20, iterations: 12, ..CemConfig::default() };
    HvfConfig { subgoals, cem, segment_cost: SegmentCost::Likelihood, ..HvfConfig::default() }
}

fn run(config: &HvfConfig, world: &PointMass, seed: u64) -> Result<SearchResult<Points>> {
    let (start, goal) = (Points(vec![START]), Points(vec![GOAL]));
    search(config, world, &Positions::new(), &start, &goal, seed, Watch::nobody())
}

/// Three segments are shortest, the longest and all together, where they are equal parts of the
/// straight way.
#[test]
fn finds_what_the_generator_says_is_best() {
    for (reduction, thirds) in
        [(Reduction::Max, 1.0), (Reduction::Mean, 1.0), (Reduction::MaxSum, 1.3)]
    {
        let found = run(&HvfConfig { reduction, ..config(2) }, &PointMass::new(), 3).unwrap();
        for (part, subgoal) in (1u8..).zip(&found.subgoals.0) {
            for (at, end) in subgoal.iter().zip(GOAL) {
                assert!((at - end * f32::from(part) / 3.0).abs() < 0.1, "{found:?}");
            }
        }
        let third = GOAL.iter().map(|x| (x / 3.0).powi(2)).sum::<f32>();
        assert!((found.cost - thirds * third).abs() < 0.05, "{found:?}");
    }
}

#[test]
fn only_the_segments_of_the_answer_are_planned() {
    let world = PointMass::new();
    let found = run(&config(2), &world, 3).unwrap();
    let each = found.plans.iter().map(|plan| plan.history.len() * 200).sum::<usize>();
    assert_eq!(found.plans.len(), 3);
    assert_eq!(world.rollouts.get(), each);
    assert!(found.plans.iter().all(|plan| plan.cost < 0.05), "{found:?}");
    assert!(found.history.iter().all(|stats| stats.evaluated == 0 && stats.skipped == 0));
    assert_eq!(
        found.subgoals.0,
        [0, 1].map(|k| Positions::position(&found.latents.row(k).to_vec()))
    );
}

#[test]
fn costs_of_the_wrong_shape_and_generators_that_do_not_know_are_errors() {
    let (start, goal) = (Points(vec![START]), Points(vec![GOAL]));
    let short = Positions { costs_missing: 1, ..Positions::new() };
    let error = search(&config(1), &PointMass::new(), &short, &start, &goal, 0, Watch::nobody());
    let said = error.unwrap_err().to_string();
    assert!(said.contains("segment_costs must give shape [200, 2], got [199, 2]"), "{said}");

    struct Mute;
    impl crate::planner::SubgoalModel<Points> for Mute {
        fn latent_dim(&self) -> usize {
            3
        }
        fn decode(&self, _: &Points, latents: ndarray::Array3<f32>) -> Result<Points> {
            Ok(Points(vec![START; latents.dim().0 * latents.dim().1]))
        }
    }
    let error = search(&config(1), &PointMass::new(), &Mute, &start, &goal, 0, Watch::nobody());
    assert!(error.unwrap_err().to_string().contains("segment_cost"));
}

#[test]
fn a_sample_with_a_segment_of_nan_is_never_the_answer() {
    for seed in 0..20 {
        let found = run(&config(2), &PointMass::new(), seed).unwrap();
        assert!(found.latents.column(2).iter().all(|&x| x <= 1.0));
    }
}
