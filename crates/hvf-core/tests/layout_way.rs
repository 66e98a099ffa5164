//! Shortest ways and episodes of layouts, against a slow reference.
#![allow(clippy::unwrap_used)]

use std::collections::BinaryHeap;
use std::sync::Arc;

use hvf_core::maze::layout::{preset, Region, Wall, Way, PRESETS};
use hvf_core::maze::{collect_in, step_batch, success, Layout, LayoutScene, Renderer};
use proptest::prelude::*;

const ANYWHERE: Region = Region { x: [-0.275, 0.275], y: [-0.275, 0.275] };
const GRID: usize = 111;

/// Length of the shortest way on a grid of 5 mm, with moves to the 32 neighbours of two rings:
/// no shorter than the true one, and little longer.
fn on_a_grid(scene: &LayoutScene, start: [f64; 2], goal: [f64; 2]) -> Option<f64> {
    let space = scene.obstacles();
    let place = |i: usize| [(i % GRID) as f64 * 0.005 - 0.275, (i / GRID) as f64 * 0.005 - 0.275];
    let free: Vec<bool> = (0..GRID * GRID).map(|i| space.contains(place(i))).collect();
    let moves: Vec<(i32, i32)> = (-3..=3)
        .flat_map(|x| (-3..=3).map(move |y| (x, y)))
        .filter(|&(x, y): &(i32, i32)| (x, y) != (0, 0))
        .collect();
    let apart = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
    let near = |p: [f64; 2]| -> Vec<usize> {
        let close = |&i: &usize| free[i] && apart(place(i), p) < 0.015 && space.sees(p, place(i));
        (0..GRID * GRID).filter(close).collect()
    };
    let mut lengths = vec![f64::INFINITY; GRID * GRID];
    let mut open = BinaryHeap::new();
    let key = |length: f64| std::cmp::Reverse((length * 1e12) as u64);
    for i in near(start) {
        lengths[i] = apart(start, place(i));
        open.push((key(lengths[i]), i));
    }
    while let Some((std::cmp::Reverse(at), i)) = open.pop() {
        if (lengths[i] * 1e12) as u64 != at {
            continue;
        }
        for &(x, y) in &moves {
            let (col, row) = ((i % GRID) as i32 + x, (i / GRID) as i32 + y);
            if !(0..GRID as i32).contains(&col) || !(0..GRID as i32).contains(&row) {
                continue;
            }
            let next = row as usize * GRID + col as usize;
            let length = lengths[i] + apart(place(i), place(next));
            if free[next] && length < lengths[next] - 1e-12 && space.sees(place(i), place(next)) {
                lengths[next] = length;
                open.push((key(length), next));
            }
        }
    }
    let ends = near(goal).into_iter().map(|i| lengths[i] + apart(place(i), goal));
    let least = ends.fold(f64::INFINITY, f64::min);
    least.is_finite().then_some(least)
}

fn is_free_line(scene: &LayoutScene, a: [f64; 2], b: [f64; 2]) -> bool {
    (0..=200).all(|i| {
        let part = f64::from(i) / 200.0;
        scene.obstacles().contains([0, 1].map(|k| a[k] + part * (b[k] - a[k])))
    })
}

fn check(scene: &LayoutScene, start: [f64; 2], goal: [f64; 2]) {
    let way = Way::shortest(scene, start, goal);
    let grid = on_a_grid(scene, start, goal);
    let Some(way) = way else {
        assert_eq!(grid, None);
        return;
    };
    assert!(way.turns.windows(2).all(|pair| is_free_line(scene, pair[0], pair[1])), "{way:?}");
    assert_eq!((way.at(0.0), way.at(1.0)), (start, goal));
    // A lane narrower than the grid's spacing may be missing from the grid.
    if let Some(grid) = grid {
        assert!(way.length() <= grid + 1e-9, "{} > {grid}", way.length());
        assert!(way.length() >= 0.97 * grid - 0.02, "{} << {grid}", way.length());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn ways_are_free_and_as_short_as_on_a_fine_grid(
        walls in prop::collection::vec(
            ([-0.3..0.3f64, -0.3..0.3f64], [0.004..0.03f64, 0.05..0.2f64], 0.0..180.0f64).prop_map(
                |(centre, half, angle)| Wall { angle, ..Wall::new(centre, half) }
            ),
            1..8
        ),
        ends in [-0.275..0.275f64, -0.275..0.275f64, -0.275..0.275f64, -0.275..0.275f64],
    ) {
        if let Ok(layout) = Layout::new("random", [0.3; 2], walls, ANYWHERE, ANYWHERE) {
            let scene = layout.scene(&[]).unwrap();
            let space = scene.obstacles();
            check(&scene, space.push_out([ends[0], ends[1]]), space.push_out([ends[2], ends[3]]));
        }
    }
}

#[test]
fn ways_through_named_layouts_are_free_and_short() {
    for name in ["hard", "corridor-4", "u-maze", "spiral"] {
        let layout = preset(name).unwrap();
        for index in 0..2 {
            let episode = layout.episode(5, index);
            check(&episode.start.scene, episode.start.position, episode.target);
        }
    }
}

#[test]
fn a_place_apart_has_no_way() {
    let walls = vec![Wall::new([0.1, 0.0], [0.005, 0.3])];
    let layout = Layout::new("two rooms", [0.3; 2], walls, ANYWHERE, ANYWHERE).unwrap();
    assert_eq!(Way::shortest(&layout.scene(&[]).unwrap(), [-0.2, 0.0], [0.2, 0.0]), None);
}

#[test]
fn episodes_start_and_aim_in_their_regions_and_subgoals_are_on_the_way() {
    for name in PRESETS.map(|name| name.replace('N', "5")) {
        let layout = preset(&name).unwrap();
        for index in 0..60 {
            let episode = layout.episode(1, index);
            let space = episode.start.scene.obstacles();
            for (p, region) in
                [(episode.start.position, layout.start()), (episode.target, layout.goal())]
            {
                assert!(space.contains(p));
                assert!(region.x[0] <= p[0] && p[0] <= region.x[1]);
                assert!(region.y[0] <= p[1] && p[1] <= region.y[1]);
            }
            assert_eq!(episode, layout.episode(1, index));
            assert!(success(&episode.goal(), episode.target));
            let way = Way::shortest(&episode.start.scene, episode.start.position, episode.target);
            let way = way.unwrap();
            for count in [0, 1, 2, 3, 5, 20] {
                let places = way.places(count);
                assert_eq!(places.len(), count);
                // On the way, in order; as many as the turns or more are in sight of each other.
                let mut ends = vec![episode.start.position];
                ends.extend(&places);
                ends.push(episode.target);
                let along: f64 =
                    ends.windows(2).map(|p| (p[0][0] - p[1][0]).hypot(p[0][1] - p[1][1])).sum();
                let turns = way.turns.len() - 2;
                if count >= turns {
                    assert!((along - way.length()).abs() < 1e-9, "{along}, not {}", way.length());
                    assert!(ends.windows(2).all(|pair| space.sees(pair[0], pair[1])));
                } else {
                    let mut left = way.turns.iter();
                    assert!(places.iter().all(|place| left.any(|turn| turn == place)));
                }
                for (subgoal, [x, y]) in episode.subgoals(count).iter().zip(places) {
                    assert!(space.contains(subgoal.position));
                    assert!((subgoal.position[0] - x).hypot(subgoal.position[1] - y) <= 0.0201);
                }
            }
        }
    }
}

#[test]
fn gaps_of_a_corridor_are_drawn_by_each_episode() {
    let layout = preset("corridor-4").unwrap();
    let mean = |gap: usize| {
        (0..2000).map(|i| layout.episode(9, i).start.scene.gaps()[gap]).sum::<f64>() / 2000.0
    };
    // Five standard errors of a uniform mean.
    assert!((0..4).all(|gap| mean(gap).abs() < 5.0 * 0.4 / 12f64.sqrt() / 2000f64.sqrt()));
    assert_ne!(layout.episode(9, 0).start.scene.gaps(), layout.episode(9, 1).start.scene.gaps());
}

#[test]
fn collected_frames_show_collected_states_whatever_the_chunking() {
    let layout = preset("corridor-4").unwrap();
    let renderer = Renderer::new(16).unwrap();
    let (count, steps) = (5, 4);
    let length = renderer.frame_len() * (steps + 1);
    let mut frames = vec![0; count * length];
    let all = collect_in(&layout, &renderer, 3, 10, count, steps, &mut frames).unwrap();
    for (state, shown) in all.states.iter().zip(frames.chunks(renderer.frame_len())) {
        let mut frame = vec![0; renderer.frame_len()];
        renderer.render(state, &mut frame);
        assert_eq!(frame, shown);
    }
    for episode in 0..count {
        let states = &all.states[episode * (steps + 1)..][..steps + 1];
        let actions = &all.actions[episode * steps..][..steps];
        assert_eq!(step_batch(&states[..steps], actions).unwrap(), states[1..]);
        let mut alone = vec![0; length];
        let first = 10 + episode as u64;
        let again = collect_in(&layout, &renderer, 3, first, 1, steps, &mut alone).unwrap();
        assert!(again.states == states && again.actions == actions);
        assert_eq!(alone, frames[episode * length..][..length]);
        assert!(Arc::ptr_eq(&states[0].scene, &states[steps].scene));
    }
}
