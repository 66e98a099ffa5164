#![allow(clippy::unwrap_used)]

use ndarray::{Array2, Array3};
use proptest::prelude::*;

use crate::planner::cem::CemConfig;
use crate::planner::model::{Proposals, SubgoalModel};
use crate::planner::point_mass::{PointMass, Points, Positions};
use crate::planner::search::{search, search_batch, HvfConfig, SearchResult, SegmentCost, Watch};
use crate::Result;

/// [`Positions`] that proposes.
struct Proposing {
    drawn: Positions,
    proposals: fn(&Points, &Points, usize) -> Option<Proposals>,
}

impl Proposing {
    fn new(proposals: fn(&Points, &Points, usize) -> Option<Proposals>) -> Self {
        Self { drawn: Positions::new(), proposals }
    }
}

impl SubgoalModel<Points> for Proposing {
    fn latent_dim(&self) -> usize {
        SubgoalModel::<Points>::latent_dim(&self.drawn)
    }

    fn decode(&self, scene: &Points, latents: Array3<f32>) -> Result<Points> {
        self.drawn.decode(scene, latents)
    }

    fn segment_costs(
        &self,
        start: &Points,
        goal: &Points,
        latents: Array3<f32>,
    ) -> Result<Array2<f32>> {
        self.drawn.segment_costs(start, goal, latents)
    }

    fn proposals(
        &self,
        start: &Points,
        goal: &Points,
        subgoals: usize,
    ) -> Result<Option<Proposals>> {
        Ok((self.proposals)(start, goal, subgoals))
    }
}

fn config(iterations: usize, segment_cost: SegmentCost) -> HvfConfig {
    let cem = CemConfig { samples: 30, elites: 5, iterations, ..CemConfig::default() };
    HvfConfig { subgoals: 2, cem, segment_cost, ..HvfConfig::default() }
}

fn ends(goal: [f32; 2]) -> [Points; 2] {
    [Points(vec![[0.0, 0.0]]), Points(vec![goal])]
}

fn run(
    config: &HvfConfig,
    generator: &Proposing,
    goal: [f32; 2],
    seed: u64,
) -> SearchResult<Points> {
    let [start, goal] = ends(goal);
    search(config, &PointMass::new(), generator, &start, &goal, seed, Watch::nobody()).unwrap()
}

fn normal(mean: f32, std: f32, subgoals: usize) -> Proposals {
    Proposals {
        mean: Array2::from_elem((subgoals, 3), mean),
        std: Array2::from_elem((subgoals, 3), std),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// To the last bit, whoever says what a segment costs.
    #[test]
    fn proposing_the_prior_is_proposing_nothing(
        seed in any::<u64>(), planned in any::<bool>(), x in -2.0f32..2.0, y in -2.0f32..2.0,
    ) {
        let cost = if planned { SegmentCost::Planned } else { SegmentCost::Likelihood };
        let config = config(2, cost);
        let none = run(&config, &Proposing::new(|_, _, _| None), [x, y], seed);
        let prior = run(&config, &Proposing::new(|_, _, k| Some(normal(0.0, 1.0, k))), [x, y], seed);
        prop_assert_eq!(none.latents, prior.latents);
        prop_assert_eq!(none.cost.to_bits(), prior.cost.to_bits());
        prop_assert_eq!(none.history, prior.history);
        prop_assert_eq!(none.plans, prior.plans);
    }

    /// Their first samples are the prior's, moved and scaled.
    #[test]
    fn first_samples_are_drawn_from_the_proposals(seed in any::<u64>()) {
        let config = config(1, SegmentCost::Likelihood);
        let none = Proposing::new(|_, _, _| None);
        let some = Proposing::new(|_, _, k| Some(normal(0.5, 0.25, k)));
        for generator in [&none, &some] {
            run(&config, generator, [1.0, 1.0], seed);
        }
        let (prior, drawn) = (none.drawn.seen.borrow(), some.drawn.seen.borrow());
        for (&from, &to) in prior[0].iter().zip(&drawn[0]) {
            prop_assert!((0.5 + 0.25 * from - to).abs() < 1e-5, "{from} {to}");
        }
    }

    /// Proposals depend on the pair, and every search of a batch has its own.
    #[test]
    fn each_search_of_a_batch_begins_at_its_own_proposals(seeds in any::<[u64; 3]>()) {
        let thirds = |start: &Points, goal: &Points, subgoals: usize| {
            // Only some pairs are proposed for.
            (goal.0[0][0] > 0.0).then(|| {
                let mut found = normal(0.0, 0.1, subgoals);
                for (k, mut row) in found.mean.outer_iter_mut().enumerate() {
                    let share = (k + 1) as f32 / (subgoals + 1) as f32;
                    for i in 0..2 {
                        row[i] = start.0[0][i] + share * (goal.0[0][i] - start.0[0][i]);
                    }
                }
                found
            })
        };
        let generator = Proposing::new(thirds);
        let goals = [[3.0, -1.5], [-2.0, 1.0], [1.0, 2.0]];
        let config = config(2, SegmentCost::Likelihood);
        let alone: Vec<_> =
            goals.iter().zip(seeds).map(|(&goal, seed)| run(&config, &generator, goal, seed)).collect();
        let (starts, goals) = (Points(vec![[0.0, 0.0]]), Points(goals.to_vec()));
        let world = PointMass::new();
        let together =
            search_batch(&config, &world, &generator, [&starts, &goals], &seeds, Watch::nobody());
        for (alone, together) in alone.iter().zip(together.unwrap()) {
            prop_assert_eq!(&alone.latents, &together.latents);
            prop_assert_eq!(alone.cost.to_bits(), together.cost.to_bits());
        }
    }
}

#[test]
fn certain_proposals_are_the_answer() {
    let generator = Proposing::new(|_, _, k| Some(normal(0.75, 0.0, k)));
    let found = run(&config(3, SegmentCost::Likelihood), &generator, [1.5, 1.5], 1);
    assert!(found.latents.iter().all(|&x| x == 0.75), "{found:?}");
}

#[test]
fn proposals_that_are_none_are_errors() {
    type Case = (fn(&Points, &Points, usize) -> Option<Proposals>, &'static str);
    let cases: [Case; 4] = [
        (|_, _, k| Some(normal(0.0, 1.0, k + 1)), "a mean of shape [2, 3], got [3, 3]"),
        (|_, _, k| Some(normal(f32::NAN, 1.0, k)), "mean must be finite, got NaN"),
        (|_, _, k| Some(normal(0.0, -1.0, k)), "std must be finite and not negative, got -1"),
        (|_, _, k| Some(normal(0.0, f32::INFINITY, k)), "std must be finite"),
    ];
    for (proposals, expected) in cases {
        let [start, goal] = ends([1.0, 1.0]);
        let generator = Proposing::new(proposals);
        let config = config(1, SegmentCost::Likelihood);
        let found =
            search(&config, &PointMass::new(), &generator, &start, &goal, 0, Watch::nobody());
        let said = found.unwrap_err().to_string();
        assert!(said.contains(expected), "{said}");
    }
}
