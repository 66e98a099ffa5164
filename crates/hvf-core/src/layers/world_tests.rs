#![allow(clippy::unwrap_used)]

use ndarray::{s, Ix3, Ix4};
use proptest::prelude::*;

use super::super::toys::{
    actions, frames, frames_at, state, world, world_without_arm, Draws, PARTS, SIZE, STATE,
};
use super::*;
use crate::image::paired_costs;

const OVER: [OverHorizon; 3] = [OverHorizon::Last, OverHorizon::Sum, OverHorizon::Min];

fn batch(shape: [usize; 4], seed: u64) -> Array4<f32> {
    actions(&shape, seed).into_dimensionality::<Ix4>().unwrap()
}

/// What the cost means: roll out, draw every frame whole, compare with the goal image.
fn slow_costs(
    world: &LayerWorld,
    starts: &LayerFrames,
    goals: &LayerFrames,
    actions: &Array4<f32>,
    blur: f64,
) -> Array2<f64> {
    let blur = GaussianBlur::new(blur, "blur").unwrap();
    let paths = world.rollout(starts, actions.view()).unwrap();
    let (problems, candidates, steps, _) = actions.dim();
    Array2::from_shape_fn((problems, candidates), |(b, d)| {
        let start = starts.select(&vec![b; steps]).unwrap();
        let drawn = world.draw(&start, paths.slice(s![b, d, .., ..])).unwrap();
        let goal = Array4::from_shape_vec((1, SIZE, SIZE, 3), goals.image(b)).unwrap();
        let goal = goal.mapv(|x| f32::from(x) / 255.0);
        let goal = goal.broadcast((steps, SIZE, SIZE, 3)).unwrap().to_owned();
        let costs = paired_costs(drawn.view(), goal.view(), blur.as_ref()).unwrap();
        // From the end: the last of each held action.
        let counted = costs.iter().rev().step_by(world.hold).copied();
        match world.over_horizon {
            OverHorizon::Last => costs[steps - 1],
            OverHorizon::Sum => counted.sum(),
            OverHorizon::Min => counted.fold(f64::INFINITY, f64::min),
        }
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn costs_are_those_of_whole_frames(
        seed in 0_u64..1000,
        tile in prop::sample::select(vec![4_usize, 8, 12, 24]),
        blur in prop::sample::select(vec![0.0, 0.8, 3.0]),
        over in prop::sample::select(OVER.to_vec()),
        hold in 1_usize..5,
    ) {
        let world = world(seed, tile, blur, over).holding(hold).unwrap();
        let frames = frames(&world, 4, seed);
        let (starts, goals) = (frames.select(&[0, 1]).unwrap(), frames.select(&[2, 3]).unwrap());
        let actions = batch([2, 5, 3, 3], seed);
        let found = world.rollout_costs(&starts, &goals, actions.clone().into()).unwrap();
        let expected = slow_costs(&world, &starts, &goals, &actions, blur);
        for (found, expected) in found.iter().zip(&expected) {
            prop_assert!(
                (f64::from(*found) - expected).abs() <= 2e-5 * expected + 1e-7,
                "{found}, not {expected}"
            );
        }
    }

    #[test]
    fn what_is_behind_the_arm_counts_once_more_where_the_goal_shows_it(
        seed in 0_u64..1000,
        tile in prop::sample::select(vec![4_usize, 8, 12]),
        blur in prop::sample::select(vec![0.0, 2.0]),
        weight in 0.1_f64..20.0,
    ) {
        let mut draws = Draws::new(seed);
        let shape = (4, SIZE, SIZE, 3);
        let clean = Array4::from_shape_simple_fn(shape, || draws.between(-0.1, 1.1));
        let mut images = clean.mapv(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8);
        // The arm is before a third of pixels: it differs there, maybe in one colour only.
        let hidden = Array4::from_shape_simple_fn((4, SIZE, SIZE, 1), || draws.unit() < 0.3);
        for ((i, row, column, _), _) in hidden.indexed_iter().filter(|(_, hidden)| **hidden) {
            let colour = (draws.unit() * 3.0) as usize;
            images[[i, row, column, colour]] ^= 128;
        }
        let regions = (4, PARTS, SIZE, SIZE);
        let regions = Array4::from_shape_simple_fn(regions, || draws.unit() < 0.05);
        let states: Vec<f32> = (0..4).flat_map(|_| state(&mut draws)).collect();
        let states = Array2::from_shape_vec((4, STATE), states).unwrap();
        let both = |world: &LayerWorld| {
            let all = world
                .frames(images.view(), clean.view(), regions.view(), states.view())
                .unwrap();
            (all.select(&[0, 1]).unwrap(), all.select(&[2, 3]).unwrap())
        };
        let actions = batch([2, 5, 2, 3], seed);
        let world = world(seed, tile, blur, OverHorizon::Last);
        let (starts, goals) = both(&world);
        let plain = world.rollout_costs(&starts, &goals, actions.clone().into()).unwrap();
        let weighing = world.clone().weighing_scene(weight).unwrap();
        let found = weighing.rollout_costs(&starts, &goals, actions.clone().into()).unwrap();

        let bare = world_without_arm(seed, tile);
        let (starts, _) = both(&bare);
        let paths = bare.rollout(&starts, actions.view()).unwrap();
        for ((b, d), found) in found.indexed_iter() {
            let start = starts.select(&[b]).unwrap();
            let drawn = bare.draw(&start, paths.slice(s![b, d, 1..2, ..])).unwrap();
            let mut sum = 0.0;
            for ((_, row, column, colour), drawn) in drawn.indexed_iter() {
                if !hidden[[2 + b, row, column, 0]] {
                    let goal = clean[[2 + b, row, column, colour]].clamp(0.0, 1.0);
                    sum += f64::from(drawn - goal).powi(2);
                }
            }
            let expected = f64::from(plain[[b, d]]) + weight * sum / (SIZE * SIZE) as f64;
            prop_assert!(
                (f64::from(*found) - expected).abs() <= 1e-4 * expected,
                "{found}, not {expected}"
            );
        }
    }

    #[test]
    fn shared_costs_are_the_same_to_the_last_bit_as_is_a_candidate_alone(
        seed in 0_u64..1000,
        candidates in 1_usize..150,
        blur in prop::sample::select(vec![0.0, 1.5]),
        over in prop::sample::select(OVER.to_vec()),
        weight in prop::sample::select(vec![0.0, 3.0]),
    ) {
        let world = world(seed, 8, blur, over).weighing_scene(weight).unwrap();
        let goals = frames(&world, 3, seed);
        let starts = goals.select(&[1; 3]).unwrap();
        let one = batch([1, candidates, 4, 3], seed).index_axis_move(Axis(0), 0);
        let all = Array4::from_shape_fn((3, candidates, 4, 3), |(_, d, h, a)| one[[d, h, a]]);
        let separate = world.rollout_costs(&starts, &goals, all.into()).unwrap();
        let start = starts.select(&[0]).unwrap();
        let shared = world.shared_costs(&start, &goals, one.view()).unwrap();
        prop_assert_eq!(&separate, &shared);
        let last = one.slice(s![candidates - 1.., .., ..]);
        let alone = world.shared_costs(&start, &goals, last).unwrap();
        prop_assert_eq!(alone.column(0), shared.column(candidates - 1));
    }
}

#[test]
fn what_does_not_change_is_the_start_frame_without_its_arm() {
    let world = world(3, 8, 0.0, OverHorizon::Last);
    // Before the first place of the grid: as at that place.
    let mut state = Array2::from_elem((1, STATE), -9.0);
    let frames = frames_at(&world, &[state.row(0).to_vec()], 3);
    let drawn = world.draw(&frames, state.view()).unwrap();
    let scene = world.painter.scene(frames.start(0));
    let mut canvas = world.painter.canvas(false);
    world.painter.paint(&scene, frames.state(0), &mut canvas);
    let tiles = world.painter.tiles();
    let armed: Vec<usize> = canvas.drawn(tiles).map(|(tile, _)| tile).collect();
    assert!(!armed.is_empty() && armed.len() < tiles.count());
    let mut still = vec![0.0; SIZE * SIZE * 3];
    for (tile, values) in scene.still().chunks_exact(tiles.values()).enumerate() {
        tiles.place(tile, values, &mut still);
    }
    for tile in (0..tiles.count()).filter(|tile| !armed.contains(tile)) {
        let [row, column] = tiles.corner(tile);
        let at = (row * SIZE + column) * 3;
        assert_eq!(drawn[[0, row, column, 0]], still[at] / 255.0);
    }
    // A part that moves by less than half a pixel changes nothing; then, where it was it is not.
    state[[0, 5]] += 0.4;
    assert_eq!(world.draw(&frames, state.view()).unwrap(), drawn);
    state[[0, 5]] += 0.2;
    assert_ne!(world.draw(&frames, state.view()).unwrap(), drawn);
}

#[test]
fn frames_keep_their_images_and_states() {
    let world = world(1, 4, 0.0, OverHorizon::Last);
    let image = |i: usize| Array4::from_elem((1, SIZE, SIZE, 3), i as u8);
    let clean = Array4::zeros((1, SIZE, SIZE, 3));
    let regions = Array4::from_elem((1, PARTS, SIZE, SIZE), false);
    let states = Array2::zeros((1, STATE));
    let frames =
        |i| world.frames(image(i).view(), clean.view(), regions.view(), states.view()).unwrap();
    assert_eq!(frames(7).image(0), vec![7; SIZE * SIZE * 3]);
    let made = super::super::toys::frames(&world, 3, 1);
    let picked = made.select(&[2, 0]).unwrap();
    assert_eq!(picked.len(), 2);
    assert_eq!(picked.image(0), made.image(2));
    assert_eq!(picked.state(1), made.state(0));
    assert!(made.select(&[3]).is_err());
}

#[test]
fn foreign_frames_and_actions_are_refused_by_name() {
    let (one, other) = (world(1, 8, 0.0, OverHorizon::Last), world(1, 8, 0.0, OverHorizon::Last));
    let mine = frames(&one, 2, 1);
    let said = |error: Error| error.to_string();
    let good = || batch([2, 3, 2, 3], 1);
    assert!(
        said(other.rollout_costs(&mine, &mine, good().into()).unwrap_err()).starts_with("starts: ")
    );
    let theirs = frames(&other, 2, 1);
    assert!(
        said(one.rollout_costs(&mine, &theirs, good().into()).unwrap_err()).starts_with("goals: ")
    );
    let wrong = batch([1, 3, 2, 3], 1);
    assert!(
        said(one.rollout_costs(&mine, &mine, wrong.into()).unwrap_err()).starts_with("actions: ")
    );
    let narrow = actions(&[3, 2, 2], 1).into_dimensionality::<Ix3>().unwrap();
    let start = mine.select(&[0]).unwrap();
    let error = one.shared_costs(&start, &mine, narrow.view()).unwrap_err();
    assert!(said(error).starts_with("actions: "));
    assert!(one.rollout_costs(&mine, &mine, good().into()).is_ok());
}

#[test]
fn actions_are_held_for_one_step_or_more() {
    let error = world(1, 8, 0.0, OverHorizon::Min).holding(0).unwrap_err();
    assert_eq!(error.to_string(), "hold: must be at least 1, got 0");
}

#[test]
fn no_candidates_no_steps_and_no_problems_cost_nothing() {
    let world = world(1, 8, 0.0, OverHorizon::Last);
    let some = frames(&world, 2, 1);
    let none = some.select(&[]).unwrap();
    let costs = |frames: &LayerFrames, shape| {
        world.rollout_costs(frames, frames, Array4::zeros(shape).into()).unwrap()
    };
    assert_eq!(costs(&none, (0, 4, 3, 3)).dim(), (0, 4));
    assert_eq!(costs(&some, (2, 0, 3, 3)).dim(), (2, 0));
    assert_eq!(costs(&some, (2, 4, 0, 3)).dim(), (2, 4));
}
