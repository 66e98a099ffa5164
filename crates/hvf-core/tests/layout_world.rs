//! Planning costs and the oracle in layouts, against drawn frames.
#![allow(clippy::unwrap_used)]

use hvf_core::image::{paired_costs, OverHorizon};
use hvf_core::maze::layout::{preset, step_in};
use hvf_core::maze::{LayoutState, MazeFrames, MazeSubgoals, MazeWorld, MazeWorldConfig, States};
use hvf_core::planner::{Frames, SubgoalModel, WorldModel};
use ndarray::{Array3, Array4, ArrayView4, Axis};

fn frames_of(states: &[LayoutState]) -> MazeFrames {
    MazeFrames::from_states(states.to_vec(), 64)
}

#[test]
fn costs_are_those_of_drawn_frames_and_sharing_rollouts_changes_no_bit() {
    let world = MazeWorld::new(MazeWorldConfig::default()).unwrap();
    for name in ["corridor-4", "u-maze", "spiral"] {
        let layout = preset(name).unwrap();
        let episodes: Vec<_> = (0..3).map(|index| layout.episode(2, index)).collect();
        let starts: Vec<LayoutState> = episodes.iter().map(|e| e.start.clone()).collect();
        let goals: Vec<LayoutState> = episodes.iter().map(|e| e.goal()).collect();
        let actions = Array4::from_shape_fn((3, 6, 3, 2), |(b, d, h, a)| {
            (3.0 * f64::sin(1.0 + (((b * 6 + d) * 3 + h) * 2 + a) as f64 * 1.7)) as f32
        });
        let (from, to) = (frames_of(&starts), frames_of(&goals));
        let costs = world.rollout_costs(&from, &to, actions.clone().into()).unwrap();
        for b in 0..3 {
            for d in 0..6 {
                let mut state = starts[b].clone();
                for h in 0..3 {
                    let action = [0, 1].map(|a| f64::from(actions[[b, d, h, a]]));
                    state.position = step_in(state.scene.obstacles(), state.position, action);
                }
                let draw = |state: &LayoutState| {
                    let mut frame = vec![0; world.renderer().frame_len()];
                    world.renderer().render(state, &mut frame);
                    frame
                };
                let (frame, goal) = (draw(&state), draw(&goals[b]));
                let view = |bytes| ArrayView4::from_shape((1, 64, 64, 3), bytes).unwrap();
                let cost = paired_costs(view(&frame), view(&goal), None).unwrap()[0] as f32;
                assert_eq!(costs[[b, d]], cost, "{name}");
            }
        }
        let one = from.select(&[1]).unwrap();
        let candidates = actions.index_axis(Axis(0), 1).to_owned();
        let shared = world.shared_rollout_costs(&one, &to, candidates.into()).unwrap().unwrap();
        let same = from.select(&[1; 3]).unwrap();
        let repeated = actions.index_axis(Axis(0), 1).insert_axis(Axis(0)).to_owned();
        let repeated = repeated.broadcast((3, 6, 3, 2)).unwrap().to_owned();
        assert_eq!(shared, world.rollout_costs(&same, &to, repeated.into()).unwrap());
    }
}

#[test]
fn blurred_costs_are_those_of_blurred_frames() {
    let config =
        MazeWorldConfig { blur: 2.0, over_horizon: OverHorizon::Last, ..Default::default() };
    let world = MazeWorld::new(config).unwrap();
    let layout = preset("corridor-4").unwrap();
    let episode = layout.episode(2, 5);
    let (from, to) =
        (frames_of(std::slice::from_ref(&episode.start)), frames_of(&[episode.goal()]));
    let stay = Array4::zeros((1, 1, 1, 2));
    let cost = world.rollout_costs(&from, &to, stay.into()).unwrap()[[0, 0]];
    let draw = |frames: &MazeFrames| frames.image(world.renderer(), 0).unwrap().into_owned();
    let (frame, goal) = (draw(&from), draw(&to));
    let view = |bytes| ArrayView4::from_shape((1, 64, 64, 3), bytes).unwrap();
    let blur = hvf_core::image::GaussianBlur::new(2.0, "blur").unwrap();
    let expected = paired_costs(view(&frame), view(&goal), blur.as_ref()).unwrap()[0] as f32;
    assert!((cost - expected).abs() <= 1e-5 * expected, "{cost}, not {expected}");
}

#[test]
fn images_are_read_as_showing_the_worlds_layout() {
    let layout = preset("corridor-4").unwrap();
    let world = MazeWorld::new(MazeWorldConfig::default()).unwrap().with_layout(layout.clone());
    let state = layout.episode(4, 4).start;
    let image =
        frames_of(std::slice::from_ref(&state)).image(world.renderer(), 0).unwrap().into_owned();
    let States::Laid(seen) = world.observe(&image).unwrap().states() else { panic!("the paper's") };
    assert!((seen[0].position[0] - state.position[0]).abs() < 1e-3);
    assert_eq!(seen[0].scene.gaps().len(), 4);
}

#[test]
fn the_oracle_draws_from_all_of_free_space() {
    let layout = preset("spiral").unwrap();
    let state = layout.episode(0, 0).start;
    let grid = |i: usize| (4.0 * (i as f64 + 0.5) / 40.0 - 2.0) as f32;
    let latents = Array3::from_shape_fn((40, 40, 8), |(m, k, l)| match l {
        0 => grid(m),
        1 => grid(k),
        _ => 9.0,
    });
    let drawn =
        MazeSubgoals::default().decode(&frames_of(std::slice::from_ref(&state)), latents).unwrap();
    assert_eq!(drawn.len(), 1600);
    let States::Laid(states) = drawn.states() else { panic!("the paper's") };
    assert!(states.iter().all(|s| s.scene.obstacles().contains(s.position)));
    let in_the_middle = |s: &&LayoutState| s.position[0].abs() < 0.12 && s.position[1].abs() < 0.12;
    let middle = states.iter().filter(in_the_middle).count();
    assert!((150..900).contains(&middle), "{middle}");
}
