#![allow(clippy::unwrap_used)]

use ndarray::{s, Array1, ArrayView2, ShapeBuilder};
use proptest::prelude::*;

use super::super::toys::{actions, frames, gru, mlp};
use super::super::Readout;
use super::*;
use crate::nn::toys::{Draws, GruToy, ResidualToy};
use crate::nn::Activation;
use crate::planner::mpc::plan;
use crate::planner::sampler::{Purpose, Stream};
use crate::planner::{MpcConfig, Problems};

const OVER: [OverHorizon; 3] = [OverHorizon::Last, OverHorizon::Sum, OverHorizon::Min];
const LOW: [f32; 2] = [-3.0, 1.0];
const HIGH: [f32; 2] = [3.0, 2.0];

/// A world and what it means, in float64.
struct Toy {
    world: LatentWorld,
    mlp: ResidualToy,
    scale: Array1<f32>,
    gru: GruToy,
    recurrent: bool,
    reader: ResidualToy,
    matrix: Array2<f32>,
    weights: Array1<f32>,
    kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Latent,
    Matrix,
    Network,
}

/// What of a world is drawn: its dynamics, read-out, weights, over-horizon and hold.
type Settings = (bool, Kind, bool, OverHorizon, usize);

fn settings() -> impl Strategy<Value = Settings> {
    (
        any::<bool>(),
        prop::sample::select(vec![Kind::Latent, Kind::Matrix, Kind::Network]),
        any::<bool>(),
        prop::sample::select(OVER.to_vec()),
        1_usize..3,
    )
}

const Z: usize = 6;

impl Toy {
    fn new(seed: u64, (recurrent, kind, weighted, over, hold): Settings) -> Self {
        let mut draws = Draws::new(seed);
        let mlp = ResidualToy::new(&mut draws, Z + 2, 13, &[9], Z);
        let scale = Array1::from_shape_simple_fn(Z, || draws.between(0.1, 0.4));
        let gru = GruToy::new(&mut draws, 2, Z);
        let mut reader = ResidualToy::new(&mut draws, Z, 10, &[], 9);
        reader.activation = Activation::Sin;
        let matrix = draws.matrix(15, Z, 0.5);
        let outputs = match kind {
            Kind::Latent => Z,
            Kind::Matrix => 15,
            Kind::Network => 9,
        };
        let low = if weighted { 0.2 } else { 1.0 };
        let weights = Array1::from_shape_simple_fn(outputs, || draws.between(low, 1.0));
        let dynamics = match recurrent {
            false => Dynamics::mlp(&mlp.weights(), scale.view()),
            true => Dynamics::gru(&gru.weights()),
        };
        let readout = match kind {
            Kind::Latent => Readout::Latent,
            Kind::Matrix => Readout::Matrix(matrix.view()),
            Kind::Network => Readout::Network(reader.weights()),
        };
        let cost = LatentCost::new(Z, &readout, weighted.then_some(weights.view())).unwrap();
        let actions = ActionSpace::new(LOW.to_vec(), HIGH.to_vec()).unwrap();
        let world = LatentWorld::new(dynamics.unwrap(), cost, actions, over, hold).unwrap();
        Self { world, mlp, scale, gru, recurrent, reader, matrix, weights, kind }
    }

    fn step(&self, z: &Array1<f64>, action: &[f32]) -> Array1<f64> {
        let u: Array1<f64> = (0..2)
            .map(|a| {
                let [low, high, taken] = [LOW[a], HIGH[a], action[a]].map(f64::from);
                (taken - low) / (high - low) * 2.0 - 1.0
            })
            .collect();
        if self.recurrent {
            return self.gru.slow(&u, z);
        }
        let inputs = z.iter().chain(&u).copied().collect();
        z + self.scale.mapv(f64::from) * self.mlp.slow(&inputs)
    }

    fn read(&self, z: &Array1<f64>) -> Array1<f64> {
        match self.kind {
            Kind::Latent => z.clone(),
            Kind::Matrix => self.matrix.mapv(f64::from).dot(z),
            Kind::Network => self.reader.slow(z),
        }
    }

    fn path(&self, start: &[f32], actions: ArrayView2<'_, f32>) -> Vec<Array1<f64>> {
        let mut z: Array1<f64> = start.iter().map(|&x| f64::from(x)).collect();
        let mut path = Vec::new();
        for action in actions.rows().into_iter().step_by(self.world.hold) {
            z = self.step(&z, &action.to_vec());
            path.push(z.clone());
        }
        path
    }

    fn slow_cost(
        &self,
        starts: &LatentFrames,
        goals: &LatentFrames,
        problem: usize,
        actions: ArrayView2<'_, f32>,
    ) -> f64 {
        let wide = |row: &[f32]| row.iter().map(|&x| f64::from(x)).collect::<Array1<f64>>();
        let target = match goals.target(problem) {
            Some(target) => wide(target),
            None => self.read(&wide(goals.latent(problem))),
        };
        let costs: Vec<f64> = self
            .path(starts.latent(problem), actions)
            .iter()
            .map(|z| {
                let apart = (self.read(z) - &target).mapv(|x| x * x);
                (apart * self.weights.mapv(f64::from)).sum() + f64::from(goals.constant(problem))
            })
            .collect();
        match self.world.over_horizon {
            OverHorizon::Last => costs[costs.len() - 1],
            OverHorizon::Sum => costs.iter().sum(),
            OverHorizon::Min => costs.iter().copied().fold(f64::INFINITY, f64::min),
        }
    }

    /// Starts and goals; goals have targets where the read-out takes them and `targets` says so.
    fn frames(&self, draws: &mut Draws, count: usize, targets: bool) -> [LatentFrames; 2] {
        let length = match self.kind {
            Kind::Latent => Some(Z),
            Kind::Matrix => None,
            Kind::Network => Some(9),
        };
        [frames(draws, count, Z, None), frames(draws, count, Z, length.filter(|_| targets))]
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn rollouts_and_costs_are_those_of_the_formula(
        seed in 0_u64..10_000,
        settings in settings(),
        shape in (1_usize..5, 1_usize..20, 1_usize..4),
        targets in any::<bool>(),
    ) {
        let toy = Toy::new(seed, settings);
        let mut draws = Draws::new(seed + 1);
        let (problems, candidates, steps) = shape;
        let [starts, goals] = toy.frames(&mut draws, problems, targets);
        let shape = [problems, candidates, steps * toy.world.hold, 2];
        let actions = actions(&mut draws, shape, 3.0);
        let costs = toy.world.rollout_costs(&starts, &goals, actions.clone().into()).unwrap();
        let paths = toy.world.rollout(&starts, actions.view()).unwrap();
        prop_assert_eq!(paths.dim(), (problems, candidates, steps, Z));
        for ((b, d), &found) in costs.indexed_iter() {
            let mine = actions.slice(s![b, d, .., ..]);
            let expected = toy.slow_cost(&starts, &goals, b, mine);
            prop_assert!(
                (f64::from(found) - expected).abs() <= 1e-4 * (1.0 + expected),
                "{found}, not {expected}"
            );
            for (step, z) in toy.path(starts.latent(b), mine).iter().enumerate() {
                for (found, exact) in paths.slice(s![b, d, step, ..]).iter().zip(z) {
                    prop_assert!((f64::from(*found) - exact).abs() <= 2e-5 * (1.0 + exact.abs()));
                }
            }
        }
    }

    #[test]
    fn costs_have_the_same_bits_alone_in_a_batch_shared_and_on_any_number_of_threads(
        seed in 0_u64..10_000,
        settings in settings(),
        goals in 1_usize..40,
        candidates in 1_usize..70,
        targets in any::<bool>(),
    ) {
        let toy = Toy::new(seed, settings);
        let world = &toy.world;
        let mut draws = Draws::new(seed + 1);
        let [starts, goals] = toy.frames(&mut draws, goals, targets);
        let start = starts.select(&[0]).unwrap();
        let starts = starts.select(&vec![0; goals.len()]).unwrap();
        let one = actions(&mut draws, [1, candidates, 2 * world.hold, 2], 3.0);
        let all = one.broadcast((goals.len(), candidates, 2 * world.hold, 2)).unwrap().to_owned();
        let one = one.index_axis_move(Axis(0), 0);
        let costs = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| world.rollout_costs(&starts, &goals, all.clone().into()).unwrap())
        };
        let (separate, threaded) = (costs(1), costs(3));
        prop_assert_eq!(&separate, &threaded);
        let shared = world.shared_costs(&start, &goals, one.view()).unwrap();
        prop_assert_eq!(&separate, &shared);
        let last = goals.len() - 1;
        let alone = world.shared_costs(
            &start, &goals.select(&[last]).unwrap(), one.slice(s![candidates - 1.., .., ..])
        ).unwrap();
        prop_assert_eq!(alone[[0, 0]], shared[[last, candidates - 1]]);
    }
}

fn plain(dynamics: Dynamics, over_horizon: OverHorizon) -> LatentWorld {
    let cost = LatentCost::new(dynamics.latent_dim(), &Readout::Latent, None).unwrap();
    let dim = dynamics.action_dim();
    let actions = ActionSpace::new(vec![-1.0; dim], vec![1.0; dim]).unwrap();
    LatentWorld::new(dynamics, cost, actions, over_horizon, 1).unwrap()
}

#[test]
fn an_action_that_is_not_a_number_costs_nan_and_only_its_candidate() {
    for (dynamics, over) in [(mlp(1, 5, 2, 16, 1), OVER[0]), (gru(1, 5, 2), OVER[1])] {
        let world = plain(dynamics, over);
        let mut draws = Draws::new(1);
        let frames = frames(&mut draws, 2, 5, None);
        let mut actions = actions(&mut draws, [2, 20, 3, 2], 1.0);
        actions[[1, 3, 0, 1]] = f32::NAN;
        actions[[0, 19, 2, 0]] = f32::INFINITY;
        let costs = world.rollout_costs(&frames, &frames, actions.into()).unwrap();
        assert!(costs[[1, 3]].is_nan());
        let finite = costs.iter().filter(|cost| cost.is_finite()).count();
        assert!((38..=39).contains(&finite));
    }
}

#[test]
fn the_planner_reaches_a_latent_that_actions_lead_to() {
    let world = plain(mlp(3, 4, 2, 32, 1), OverHorizon::Last);
    let mut draws = Draws::new(2);
    let starts = frames(&mut draws, 3, 4, None);
    let done = actions(&mut draws, [3, 1, 5, 2], 0.9);
    let reached = world.rollout(&starts, done.view()).unwrap();
    let ends = reached.slice(s![.., 0, 4, ..]);
    let goals = LatentFrames::new(ends, Default::default()).unwrap();
    let streams = [1, 2, 3].map(|seed| Stream { seed, purpose: Purpose::Actions, problem: 0 });
    let problems = Problems {
        starts: &starts,
        goals: &goals,
        streams: &streams,
        warm_start: None,
        share_rollouts: true,
        describe: &|problem| problem.to_string(),
    };
    let still = world.rollout_costs(&starts, &goals, Array4::zeros((3, 1, 5, 2)).into()).unwrap();
    let plans = plan(&MpcConfig::default(), &world, &problems, &|| Ok(())).unwrap();
    for (plan, still) in plans.iter().zip(&still) {
        assert!(plan.cost < 0.05 * still, "{} of {still}", plan.cost);
    }
}

#[test]
fn a_model_that_is_dear_is_asked_for_fewer_candidates_at_once() {
    let small = plain(mlp(1, 4, 2, 8, 0), OverHorizon::Last);
    let large = plain(mlp(1, 128, 2, 512, 2), OverHorizon::Last);
    assert_eq!(small.max_candidates(), 1 << 16);
    assert!((1024..4096).contains(&large.max_candidates()));
}

#[test]
fn settings_that_do_not_fit_are_refused_by_name() {
    let dynamics = || mlp(1, 5, 2, 8, 1);
    let space = |dim: usize| ActionSpace::new(vec![-1.0; dim], vec![1.0; dim]).unwrap();
    let cost = |latent| LatentCost::new(latent, &Readout::Latent, None).unwrap();
    let said = |made: Result<LatentWorld>| made.unwrap_err().to_string();
    let last = OverHorizon::Last;
    let made = LatentWorld::new(dynamics(), cost(4), space(2), last, 1);
    assert!(said(made).starts_with("readout: "));
    let made = LatentWorld::new(dynamics(), cost(5), space(3), last, 1);
    assert!(said(made).starts_with("action_low: "));
    let made = LatentWorld::new(dynamics(), cost(5), space(2), last, 0);
    assert!(said(made).starts_with("hold: "));
    let thin = ActionSpace::new(vec![0.0; 2], vec![1e-45; 2]).unwrap();
    let made = LatentWorld::new(dynamics(), cost(5), thin, last, 1);
    assert!(said(made).starts_with("action_high: "));
}

#[test]
fn costs_that_do_not_fit_are_refused_by_name() {
    let mut draws = Draws::new(1);
    let said = |readout: &Readout<'_>, weights: Option<Array1<f32>>| {
        let weights = weights.as_ref().map(|weights| weights.view());
        LatentCost::new(4, readout, weights).unwrap_err().to_string()
    };
    for weights in [vec![1.0; 3], vec![0.0; 4], vec![1.0, -1.0, 1.0, 1.0], vec![f32::NAN; 4]] {
        assert!(said(&Readout::Latent, Some(weights.into())).starts_with("weights: "));
    }
    let toy = ResidualToy::new(&mut draws, 5, 8, &[], 3);
    assert!(said(&Readout::Network(toy.weights()), None).starts_with("readout: input: "));
    for matrix in [
        Array2::zeros((3, 5)),
        Array2::zeros((0, 4)),
        Array2::zeros((3, 4)),
        Array2::from_elem((3, 4), f32::INFINITY),
    ] {
        assert!(said(&Readout::Matrix(matrix.view()), None).starts_with("readout: "));
    }
    let matrix = draws.matrix(3, 4, 1.0);
    let weights = Some(Array1::ones(4));
    assert!(said(&Readout::Matrix(matrix.view()), weights).starts_with("weights: "));
}

#[test]
fn frames_and_actions_that_do_not_fit_are_refused_by_name() {
    let settings = (false, Kind::Network, false, OverHorizon::Last, 2);
    let toy = Toy::new(1, settings);
    let world = &toy.world;
    let mut draws = Draws::new(1);
    let [starts, goals] = toy.frames(&mut draws, 2, true);
    let good = || Array4::<f32>::zeros((2, 3, 4, 2));
    assert!(world.rollout_costs(&starts, &goals, good().into()).is_ok());
    let said = |starts, goals, actions: Array4<f32>| {
        world.rollout_costs(starts, goals, actions.into()).unwrap_err().to_string()
    };
    let narrow = frames(&mut draws, 2, Z - 1, None);
    assert!(said(&narrow, &goals, good()).starts_with("starts: "));
    assert!(said(&starts, &narrow, good()).starts_with("goals: "));
    let other = frames(&mut draws, 2, Z, Some(Z));
    assert!(said(&starts, &other, good()).starts_with("goals: expected targets of 9"));
    for shape in [(1, 3, 4, 2), (2, 3, 4, 3), (2, 3, 5, 2)] {
        assert!(said(&starts, &goals, Array4::zeros(shape)).starts_with("actions: "));
    }
    let actions = good().index_axis_move(Axis(0), 0);
    let error = world.shared_costs(&starts, &goals, actions.view()).unwrap_err();
    assert!(error.to_string().starts_with("start: "));
    let huge = ArrayView4::from_shape((2, 1 << 20, 1 << 9, 2).strides((0, 0, 0, 0)), &[0.0; 1]);
    let error = world.rollout(&starts, huge.unwrap()).unwrap_err();
    assert!(error.to_string().starts_with("actions: would lead to"));
    let matrix = Toy::new(1, (false, Kind::Matrix, false, OverHorizon::Last, 1));
    let error = matrix.world.rollout_costs(&starts, &other, good().into()).unwrap_err();
    assert!(error.to_string().starts_with("goals: have targets"));
}

#[test]
fn no_candidates_no_steps_and_no_problems_cost_nothing() {
    let world = plain(mlp(1, 5, 2, 8, 1), OverHorizon::Sum);
    let some = frames(&mut Draws::new(1), 2, 5, None);
    let none = some.select(&[]).unwrap();
    let costs = |frames: &LatentFrames, shape| {
        world.rollout_costs(frames, frames, Array4::zeros(shape).into()).unwrap()
    };
    assert_eq!(costs(&none, (0, 4, 3, 2)).dim(), (0, 4));
    assert_eq!(costs(&some, (2, 0, 3, 2)).dim(), (2, 0));
    assert_eq!(costs(&some, (2, 4, 0, 2)), Array2::zeros((2, 4)));
    let start = some.select(&[0]).unwrap();
    let actions = Array4::zeros((1, 0, 3, 2)).index_axis_move(Axis(0), 0);
    assert_eq!(world.shared_costs(&start, &some, actions.view()).unwrap().dim(), (2, 0));
    assert_eq!(world.shared_costs(&start, &none, actions.view()).unwrap().dim(), (0, 0));
    let paths = world.rollout(&some, Array4::zeros((2, 3, 0, 2)).view()).unwrap();
    assert_eq!(paths.dim(), (2, 3, 0, 5));
}
