//! The maze's camera, there and back.
#![allow(clippy::unwrap_used)]

use hvf_core::maze::geometry::{AGENT_HALF, ARENA, BORDER, GAP_HALF, WALL_HALF, WALL_X};
use hvf_core::maze::render::{AGENT, FLOOR, IMAGE_SIZES, VIEW, WALL};
use hvf_core::maze::{
    collect, locate_batch, render_batch, step, Difficulty, Episode, Renderer, Scene, State,
};
use proptest::prelude::*;

fn frame(renderer: &Renderer, state: &State) -> Vec<u8> {
    let mut frame = vec![0; renderer.frame_len()];
    renderer.render(state, &mut frame);
    frame
}

/// Colour of the maze at one point.
fn colour(state: &State, x: f64, y: f64) -> [u8; 3] {
    let [agent_x, agent_y] = state.position;
    if (x - agent_x).abs() < AGENT_HALF && (y - agent_y).abs() < AGENT_HALF {
        return AGENT;
    }
    let extent = x.abs().max(y.abs());
    let in_border = extent > ARENA && extent < ARENA + BORDER;
    let in_wall = WALL_X.iter().zip(state.scene.gap_y).any(|(&wall, gap)| {
        (x - wall).abs() < WALL_HALF && (y - gap).abs() > GAP_HALF && extent < ARENA
    });
    if in_border || in_wall {
        WALL
    } else {
        FLOOR
    }
}

/// Mean colour over `n * n` points of every pixel.
fn supersampled(state: &State, size: usize, n: usize) -> Vec<f64> {
    let pixel = 2.0 * VIEW / size as f64;
    let mut frame = vec![0.0; size * size * 3];
    for (index, value) in frame.chunks_exact_mut(3).enumerate() {
        for sample in 0..n * n {
            let part = |i: usize| (i as f64 + 0.5) / n as f64;
            let x = (index % size) as f64 + part(sample % n);
            let y = (index / size) as f64 + part(sample / n);
            let rgb = colour(state, x * pixel - VIEW, VIEW - y * pixel);
            for (sum, channel) in value.iter_mut().zip(rgb) {
                *sum += f64::from(channel) / (n * n) as f64;
            }
        }
    }
    frame
}

/// A state where the agent can stand.
fn states() -> impl Strategy<Value = State> {
    [-0.275..0.275f64, -0.275..0.275f64, -0.2..0.2f64, -0.2..0.2f64]
        .prop_map(|row| step(&State::from_row(row).unwrap(), [0.0; 2]))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn pixels_are_means_over_their_area(state in states(), size in 8usize..40) {
        let n = 20;
        let expected = supersampled(&state, size, n);
        for (value, mean) in frame(&Renderer::new(size).unwrap(), &state).iter().zip(expected) {
            // A column of samples on the wrong side of each of two edges, and rounding.
            prop_assert!((f64::from(*value) - mean).abs() <= 2.0 * 180.0 / n as f64 + 0.5);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn the_agent_covers_its_own_area_wherever_it_is(
        x in -0.05..0.05f64, y in -0.2..0.2f64, size in 8usize..200
    ) {
        // Away from walls, where its pixels are mixed with floor only.
        let state = State { scene: Scene { gap_y: [0.0; 2] }, position: [x, y] };
        let renderer = Renderer::new(size).unwrap();
        let (mut covered, mut pixels) = (0.0, 0.0);
        renderer.render_agent(&state, |_, colour| {
            covered += (f64::from(colour[1]) - f64::from(FLOOR[1])) / f64::from(AGENT[1] - FLOOR[1]);
            pixels += 1.0;
        });
        let area = covered * (2.0 * VIEW / size as f64).powi(2);
        let rounding = 0.5 * pixels / 164.0 * (2.0 * VIEW / size as f64).powi(2);
        prop_assert!((area - (2.0 * AGENT_HALF).powi(2)).abs() <= rounding + 1e-12);
    }

    #[test]
    fn the_agent_is_a_patch_on_its_scene(state in states(), size in 8usize..100) {
        let renderer = Renderer::new(size).unwrap();
        let mut patched = vec![0; renderer.frame_len()];
        renderer.render_scene(&state.scene, &mut patched);
        let mut last = None;
        renderer.render_agent(&state, |pixel, colour| {
            assert!(last < Some(pixel));
            last = Some(pixel);
            patched[3 * pixel..3 * pixel + 3].copy_from_slice(&colour);
        });
        prop_assert_eq!(patched, frame(&renderer, &state));
    }

    #[test]
    fn motion_far_below_a_pixel_changes_the_frame(
        x in -0.08..0.08f64, y in -0.2..0.2f64, angle in 0.0..6.3f64
    ) {
        let renderer = Renderer::new(64).unwrap();
        let here = State { scene: Scene { gap_y: [0.0; 2] }, position: [x, y] };
        let moved = [x + 5e-4 * angle.cos(), y + 5e-4 * angle.sin()];
        prop_assert_ne!(frame(&renderer, &here), frame(&renderer, &State { position: moved, ..here }));
    }

    #[test]
    fn states_are_found_again_in_their_frames(state in states(), size in 64usize..128) {
        let renderer = Renderer::new(size).unwrap();
        let found = renderer.locate(&frame(&renderer, &state));
        for (found, truth) in found.to_row().into_iter().zip(state.to_row()) {
            prop_assert!((found - truth).abs() <= 1.5e-4, "{found} for {truth}");
        }
    }

    #[test]
    fn any_frame_locates_to_a_legal_state(seed in any::<u64>(), size in 8usize..40) {
        let renderer = Renderer::new(size).unwrap();
        let mut noise = seed;
        let frame: Vec<u8> = (0..renderer.frame_len())
            .map(|_| {
                noise = noise.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (noise >> 56) as u8
            })
            .collect();
        for frame in [frame, vec![0; renderer.frame_len()], vec![255; renderer.frame_len()]] {
            let found = renderer.locate(&frame);
            prop_assert!(State::from_row(found.to_row()).is_ok());
            prop_assert!(found.scene.free_space().contains(found.position));
        }
    }
}

#[test]
fn frames_are_symmetric_where_the_maze_is() {
    for size in [17, 64] {
        let renderer = Renderer::new(size).unwrap();
        let state = State { scene: Scene { gap_y: [0.0; 2] }, position: [0.0; 2] };
        let frame = frame(&renderer, &state);
        let pixel = |row: usize, col: usize| &frame[3 * (row * size + col)..][..3];
        for (row, col) in (0..size).flat_map(|row| (0..size).map(move |col| (row, col))) {
            assert_eq!(pixel(row, col), pixel(size - 1 - row, col));
            assert_eq!(pixel(row, col), pixel(row, size - 1 - col));
        }
    }
}

#[test]
fn up_is_up_and_right_is_right() {
    let state = State { scene: Scene { gap_y: [0.0; 2] }, position: [0.25, 0.25] };
    let frame = frame(&Renderer::new(64).unwrap(), &state);
    let (row, col) = (7, 57);
    assert_eq!(frame[3 * (row * 64 + col)..][..3], AGENT);
}

#[test]
fn sizes_out_of_range_are_refused() {
    for size in [0, IMAGE_SIZES[0] - 1, IMAGE_SIZES[1] + 1] {
        assert!(Renderer::new(size).unwrap_err().to_string().starts_with("size: "));
    }
    let renderer = Renderer::new(8).unwrap();
    let state = State { scene: Scene { gap_y: [0.0; 2] }, position: [0.0; 2] };
    assert!(render_batch(&renderer, &[state], &mut [0; 100]).is_err());
    assert!(locate_batch(&renderer, &[0; 100]).is_err());
    assert!(collect(&renderer, 0, 0, 1, 0, &mut []).is_err());
}

#[test]
fn collected_frames_show_collected_states_whatever_the_chunking() {
    let renderer = Renderer::new(16).unwrap();
    let (count, steps) = (6, 5);
    let episode_len = renderer.frame_len() * (steps + 1);
    let mut frames = vec![0; count * episode_len];
    let all = collect(&renderer, 3, 10, count, steps, &mut frames).unwrap();
    for (state, shown) in all.states.iter().zip(frames.chunks(renderer.frame_len())) {
        assert_eq!(frame(&renderer, state), shown);
    }
    for episode in 0..count {
        let states = &all.states[episode * (steps + 1)..][..steps + 1];
        let actions = &all.actions[episode * steps..][..steps];
        for time in 0..steps {
            assert_eq!(step(&states[time], actions[time].map(f64::from)), states[time + 1]);
        }
        let mut alone = vec![0; episode_len];
        let first = 10 + episode as u64;
        let again = collect(&renderer, 3, first, 1, steps, &mut alone).unwrap();
        assert_eq!(again.states, states);
        assert_eq!(again.actions, actions);
        assert_eq!(alone, frames[episode * episode_len..][..episode_len]);
    }
}

#[test]
fn episodes_start_and_end_where_the_difficulty_says() {
    for (difficulty, low, high, gaps) in [
        (Difficulty::Easy, 0.15, 0.27, 0),
        (Difficulty::Medium, -0.15, 0.15, 1),
        (Difficulty::Hard, -0.27, -0.15, 2),
    ] {
        for index in 0..500 {
            let episode = Episode::new(1, index, difficulty);
            let space = episode.start.scene.free_space();
            let [x, y] = episode.start.position;
            assert!((low..high).contains(&x) && (-0.27..0.27).contains(&y));
            assert!(space.contains([x, y]) && space.contains(episode.target));
            assert!(episode.target[0] >= 0.2);
            let subgoals = episode.subgoals(2);
            assert!(subgoals.iter().all(|subgoal| space.contains(subgoal.position)));
            let [left, right] = episode.start.scene.gap_y;
            let expected = [[-0.15, left], [0.15, right]];
            match gaps {
                0 => assert!(subgoals.iter().all(|s| s.section() == 2 || s.position[0] >= 0.15)),
                1 => assert!(subgoals.iter().all(|s| s.position == expected[1])),
                _ => {
                    assert!(subgoals.iter().zip(expected).all(|(s, e)| s.position == e));
                    assert_eq!(episode.subgoals(1)[0].position, expected[0]);
                }
            }
        }
    }
}

#[test]
fn episodes_fill_their_ranges_evenly() {
    let episodes: Vec<Episode> =
        (0..4000).map(|index| Episode::new(5, index, Difficulty::Hard)).collect();
    let mean = |of: fn(&Episode) -> f64| episodes.iter().map(of).sum::<f64>() / 4000.0;
    // Five standard errors of a uniform mean.
    let within = |value: f64, range: f64| value.abs() < 5.0 * range / 12f64.sqrt() / 4000f64.sqrt();
    assert!(within(mean(|e| e.start.scene.gap_y[0]), 0.4));
    assert!(within(mean(|e| e.start.scene.gap_y[1]), 0.4));
    assert!(within(mean(|e| e.start.position[1]), 0.54));
    assert!(within(mean(|e| e.target[1]), 0.56));
    let product = mean(|e| e.start.scene.gap_y[0] * e.start.scene.gap_y[1]);
    assert!(product.abs() < 5.0 * 0.04 / 3.0 / 4000f64.sqrt());
}
