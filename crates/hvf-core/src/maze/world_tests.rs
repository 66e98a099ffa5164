#![allow(clippy::unwrap_used)]

use ndarray::{Array4, ArrayView4};
use proptest::prelude::*;

use super::*;
use crate::image::{paired_costs, GaussianBlur};
use crate::maze::{step, Difficulty, Episode, MazeSubgoals};
use crate::planner::SubgoalModel;

/// Numbers in `[0, 1)` from a linear congruential generator.
fn draws(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed ^ 0x5DEE_CE66;
    move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f64 / (1_u64 << 24) as f64
    }
}

fn actions(shape: (usize, usize, usize), seed: u64) -> Array4<f32> {
    let mut draw = draws(seed);
    let (b, d, h) = shape;
    Array4::from_shape_simple_fn((b, d, h, 2), || (7.0 * draw() - 3.5) as f32)
}

/// Episodes of all kinds: starts, and goals of the same scene.
fn problems(count: usize, seed: u64) -> (Vec<State>, Vec<State>) {
    let kinds = [Difficulty::Easy, Difficulty::Medium, Difficulty::Hard];
    (0..count)
        .map(|i| {
            let episode = Episode::new(seed, i as u64, kinds[i % 3]);
            (episode.start, episode.goal())
        })
        .unzip()
}

fn world(image_size: usize, blur: f64, over_horizon: OverHorizon) -> MazeWorld {
    MazeWorld::new(MazeWorldConfig { image_size, blur, over_horizon }).unwrap()
}

/// What the cost means: step, draw every frame, compare with the goal image.
fn slow_costs(
    world: &MazeWorld,
    starts: &[State],
    goals: &MazeFrames,
    actions: &Array4<f32>,
) -> Array2<f32> {
    let (size, config) = (world.renderer().size(), world.config());
    let blur = GaussianBlur::new(config.blur, "blur").unwrap();
    let (problems, candidates, steps, _) = actions.dim();
    Array2::from_shape_fn((problems, candidates), |(b, d)| {
        let goal = goals.image(world.renderer(), b).unwrap();
        let mut state = starts[b];
        let costs: Vec<f32> = (0..steps)
            .map(|h| {
                state = step(&state, [0, 1].map(|axis| f64::from(actions[[b, d, h, axis]])));
                let mut frame = vec![0; world.renderer().frame_len()];
                world.renderer().render(&state, &mut frame);
                let view = |bytes| ArrayView4::from_shape((1, size, size, 3), bytes).unwrap();
                paired_costs(view(&frame), view(&goal), blur.as_ref()).unwrap()[0] as f32
            })
            .collect();
        match config.over_horizon {
            OverHorizon::Last => costs[steps - 1],
            OverHorizon::Sum => costs.iter().sum(),
            OverHorizon::Min => costs.iter().copied().fold(f32::INFINITY, f32::min),
        }
    })
}

fn noise(world: &MazeWorld, count: usize) -> MazeFrames {
    let mut draw = draws(5);
    let bytes: Vec<u8> =
        (0..count * world.renderer().frame_len()).map(|_| (256.0 * draw()) as u8).collect();
    world.observe(&bytes).unwrap()
}

/// Goals of the start's scene, of other scenes, and images of nothing.
fn kinds_of_goals(world: &MazeWorld, count: usize, seed: u64) -> [MazeFrames; 3] {
    let size = world.renderer().size();
    [
        MazeFrames::from_states(problems(count, seed).1, size),
        MazeFrames::from_states(problems(count, seed + 1).1, size),
        noise(world, count),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(6))]

    #[test]
    fn sharp_cost_is_that_of_the_drawn_frame_bit_for_bit(
        size in prop::sample::select(vec![8_usize, 33, 64, 100]),
        over_horizon in prop::sample::select(vec![
            OverHorizon::Last, OverHorizon::Sum, OverHorizon::Min
        ]),
        seed in 0_u64..1000,
    ) {
        let world = world(size, 0.0, over_horizon);
        let starts = problems(3, seed).0;
        let actions = actions((3, 5, 3), seed);
        for goals in kinds_of_goals(&world, 3, seed) {
            let frames = MazeFrames::from_states(starts.clone(), size);
            let costs = world.rollout_costs(&frames, &goals, actions.clone().into()).unwrap();
            prop_assert_eq!(costs, slow_costs(&world, &starts, &goals, &actions));
        }
    }

    #[test]
    fn blurred_cost_is_that_of_the_blurred_drawn_frame(
        size in prop::sample::select(vec![8_usize, 33, 64, 100]),
        // Blurs far beyond the size leave differences of means only.
        relative_blur in prop::sample::select(vec![0.006, 0.05, 0.125]),
        seed in 0_u64..1000,
    ) {
        let world = world(size, relative_blur * size as f64, OverHorizon::Last);
        let starts = problems(3, seed).0;
        let actions = actions((3, 4, 2), seed);
        for goals in kinds_of_goals(&world, 3, seed) {
            let frames = MazeFrames::from_states(starts.clone(), size);
            let costs = world.rollout_costs(&frames, &goals, actions.clone().into()).unwrap();
            let expected = slow_costs(&world, &starts, &goals, &actions);
            let typical = expected.mean().unwrap();
            for (cost, expected) in costs.iter().zip(&expected) {
                let tolerance = 1e-5 * expected + 1e-6 * typical;
                prop_assert!((cost - expected).abs() <= tolerance, "{cost}, not {expected}");
            }
        }
    }
}

#[test]
fn sharing_rollouts_changes_no_bit() {
    for blur in [0.0, 2.0] {
        for over_horizon in [OverHorizon::Last, OverHorizon::Sum, OverHorizon::Min] {
            let world = world(64, blur, over_horizon);
            let candidates = actions((1, 12, 3), 3);
            for goals in kinds_of_goals(&world, 7, 11) {
                let start = MazeFrames::from_states(vec![problems(2, 11).0[1]], 64);
                let shared = world
                    .shared_rollout_costs(
                        &start,
                        &goals,
                        candidates.index_axis(Axis(0), 0).to_owned().into(),
                    )
                    .unwrap()
                    .unwrap();
                let apart = world
                    .rollout_costs(
                        &start.select(&[0; 7]).unwrap(),
                        &goals,
                        candidates.broadcast((7, 12, 3, 2)).unwrap().to_owned().into(),
                    )
                    .unwrap();
                assert_eq!(shared, apart);
            }
        }
    }
}

#[test]
fn costs_do_not_depend_on_the_number_of_threads() {
    let world = world(64, 3.0, OverHorizon::Sum);
    let (starts, goals) = problems(9, 2);
    let (starts, goals) = (MazeFrames::from_states(starts, 64), MazeFrames::from_states(goals, 64));
    let costs = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            world.rollout_costs(&starts, &goals, actions((9, 70, 3), 4).into()).unwrap()
        })
    };
    assert_eq!(costs(1), costs(3));
}

#[test]
fn a_goal_that_is_reached_costs_nothing() {
    for blur in [0.0, 3.0] {
        let world = world(64, blur, OverHorizon::Last);
        let goal = MazeFrames::from_states(problems(1, 8).1, 64);
        let stay = Array4::zeros((1, 1, 1, 2));
        let cost = world.rollout_costs(&goal, &goal, stay.clone().into()).unwrap()[[0, 0]];
        let far =
            world.rollout_costs(&goal, &MazeFrames::from_states(problems(1, 8).0, 64), stay.into());
        assert!(cost <= 1e-6 * far.unwrap()[[0, 0]], "{cost}");
    }
}

#[test]
fn observed_images_start_where_they_show_the_agent() {
    let world = world(64, 0.0, OverHorizon::Last);
    let starts = problems(9, 21).0;
    let mut images = vec![0; 9 * world.renderer().frame_len()];
    for (image, state) in images.chunks_exact_mut(world.renderer().frame_len()).zip(&starts) {
        world.renderer().render(state, image);
    }
    let observed = world.observe(&images).unwrap();
    for (i, state) in starts.iter().enumerate() {
        let (seen, real) = (observed.state(i).to_row(), state.to_row());
        assert!(seen.iter().zip(real).all(|(s, r)| (s - r).abs() < 2e-4), "{seen:?}, {real:?}");
        let image = observed.image(world.renderer(), i).unwrap();
        assert_eq!(&image[..], &images[i * image.len()..][..image.len()]);
    }
}

#[test]
fn bad_input_names_the_argument() {
    let world = world(64, 0.0, OverHorizon::Last);
    let frames = MazeFrames::from_states(problems(2, 0).0, 64);
    let said = |result: Result<Array2<f32>>| result.unwrap_err().to_string();
    let one = frames.select(&[1]).unwrap();
    assert!(said(world.rollout_costs(&one, &frames, actions((2, 3, 1), 0).into()))
        .starts_with("starts"));
    assert!(
        said(world.rollout_costs(&frames, &one, actions((2, 3, 1), 0).into())).starts_with("goals")
    );
    let wide = Array4::zeros((2, 3, 1, 3));
    assert!(said(world.rollout_costs(&frames, &frames, wide.into())).starts_with("actions"));
    let mut nan = actions((2, 3, 1), 0);
    nan[[1, 2, 0, 1]] = f32::NAN;
    let costs = world.rollout_costs(&frames, &frames, nan.clone().into()).unwrap();
    let is_nan = |(b, d): (usize, usize)| (b, d) == (1, 2);
    assert_eq!(costs.mapv(f32::is_nan), Array2::from_shape_fn((2, 3), is_nan));
    assert!(world.rollout(frames.state(1), nan.index_axis(Axis(0), 1)).is_err());
    let small =
        MazeFrames::from_images(&Renderer::new(32).unwrap(), &[0; 2 * 32 * 32 * 3]).unwrap();
    assert!(said(world.rollout_costs(&frames, &small, actions((2, 3, 1), 0).into()))
        .starts_with("frames"));
    assert!(frames.select(&[2]).is_err());
    assert!(world.observe(&[0; 5]).is_err());
    for blur in [-1.0, f64::NAN] {
        let config = MazeWorldConfig { blur, ..MazeWorldConfig::default() };
        assert!(MazeWorld::new(config).unwrap_err().to_string().starts_with("blur"));
    }
}

#[test]
fn oracle_draws_uniformly_from_where_the_agent_can_stand() {
    let scene = MazeFrames::from_states(vec![problems(1, 4).0[0]], 64);
    // Latents whose normal distribution functions are a grid.
    let grid: Vec<f32> = (0..60).map(|i| quantile((f64::from(i) + 0.5) / 60.0)).collect();
    let latents = ndarray::Array3::from_shape_fn((60, 60, 8), |(m, k, l)| match l {
        0 => grid[m],
        1 => grid[k],
        _ => 9.0,
    });
    let drawn = MazeSubgoals::default().decode(&scene, latents).unwrap();
    let space = scene.state(0).scene.free_space();
    let mut in_left_half = 0;
    for i in 0..3600 {
        let [x, y] = drawn.state(i).position;
        assert!(space.contains([x, y]), "[{x}, {y}]");
        in_left_half += u32::from(x < 0.0);
        if i >= 60 {
            assert!(drawn.state(i - 60).position[0] <= x);
        }
        if i % 60 > 0 {
            assert!(drawn.state(i - 1).position[1] < y);
        }
    }
    assert_eq!(in_left_half, 1800);
    // A gap strip of 0.06 x 0.05 m is 0.7% of free space.
    let in_gaps = (0..3600).filter(|&i| {
        let x = drawn.state(i).position[0].abs();
        x > 0.12 && x < 0.18
    });
    assert!((1..=3 * 60).contains(&in_gaps.count()));
}

/// Inverse of the normal distribution function by bisection of its series (Marsaglia, 2004).
fn quantile(p: f64) -> f32 {
    let distribution = |z: f64| {
        let (mut sum, mut term) = (z, z);
        for i in 1..60 {
            term *= z * z / f64::from(2 * i + 1);
            sum += term;
        }
        0.5 + sum * (-0.5 * z * z).exp() / (2.0 * std::f64::consts::PI).sqrt()
    };
    let (mut low, mut high) = (-5.0, 5.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if distribution(middle) < p {
            low = middle;
        } else {
            high = middle;
        }
    }
    low as f32
}
