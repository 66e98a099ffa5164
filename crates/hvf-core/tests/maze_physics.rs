//! What the maze's steps always do, for any scene, start and actions.
#![allow(clippy::unwrap_used)]

use hvf_core::maze::geometry::{AGENT_HALF, ARENA, GAP_HALF, REACH, WALL_HALF, WALL_X};
use hvf_core::maze::physics::{FRICTION, GEAR, STEP_SECONDS};
use hvf_core::maze::{step, step_batch, Scene, State};
use proptest::prelude::*;

/// How deep the agent's square is in a wall or the border, m, from their outlines alone.
fn overlap(state: &State) -> f64 {
    let [x, y] = state.position;
    let border = x.abs().max(y.abs()) + AGENT_HALF - ARENA;
    let walls = WALL_X.iter().zip(state.scene.gap_y).map(|(&wall, gap)| {
        let across = WALL_HALF + AGENT_HALF - (x - wall).abs();
        let along = (y - gap).abs() + AGENT_HALF - GAP_HALF;
        across.min(along)
    });
    walls.fold(border, f64::max)
}

fn scenes() -> impl Strategy<Value = Scene> {
    let gap = prop_oneof![8 => -0.2..0.2f64, 1 => Just(0.25), 1 => Just(-0.25), 1 => Just(0.0)];
    [gap.clone(), gap].prop_map(|gap_y| Scene { gap_y })
}

fn states() -> impl Strategy<Value = State> {
    let place =
        prop_oneof![6 => -0.3..0.3f64, 1 => Just(REACH), 1 => Just(-REACH), 1 => Just(0.12)];
    (scenes(), [place.clone(), place]).prop_map(|(scene, position)| State { scene, position })
}

/// Actions of all sizes, also along one axis, along diagonals, far beyond the box and not finite.
fn actions() -> impl Strategy<Value = [f64; 2]> {
    let component = || {
        prop_oneof![
            10 => -3.0..3.0f64,
            2 => Just(3.0),
            2 => Just(-3.0),
            2 => Just(0.0),
            1 => -1e-6..1e-6f64,
            1 => any::<f64>(),
        ]
    };
    [component(), component()]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn no_sequence_of_actions_ends_in_a_wall_or_outside(
        start in states(), actions in prop::collection::vec(actions(), 1..60)
    ) {
        let mut state = start;
        for action in actions {
            state = step(&state, action);
            prop_assert!(overlap(&state) <= 1e-12, "{state:?} after {action:?}");
            prop_assert_eq!(state.scene, start.scene);
        }
    }

    #[test]
    fn walls_are_passed_only_through_their_gaps(start in states(), action in actions()) {
        let start = step(&start, [0.0; 2]);
        let end = step(&start, action);
        for (wall, gap) in WALL_X.into_iter().zip(start.scene.gap_y) {
            let near = WALL_HALF + AGENT_HALF;
            let passed = (start.position[0] - wall) * (end.position[0] - wall) < 0.0
                && (start.position[0] - wall).abs() >= near
                && (end.position[0] - wall).abs() >= near;
            if passed {
                // Motion is monotone: y cannot have been in the gap if it is on one side of it.
                let free = GAP_HALF - AGENT_HALF;
                let [from, to] = [start.position[1], end.position[1]];
                prop_assert!(from.min(to) <= gap + free && from.max(to) >= gap - free);
            }
        }
    }

    #[test]
    fn motion_never_turns_against_the_action(start in states(), action in [-3.0..3.0f64, -3.0..3.0f64]) {
        let start = step(&start, [0.0; 2]);
        let end = step(&start, action);
        let moves = end.position.into_iter().zip(start.position).map(|(end, start)| end - start);
        for (moved, action) in moves.zip(action) {
            let (moved, free) = (moved * action.signum(), 0.0496 * action.abs());
            prop_assert!((-1e-15..=free + 1e-9).contains(&moved));
        }
    }

    #[test]
    fn a_mirrored_maze_gives_mirrored_steps(start in states(), action in [-3.0..3.0f64, -3.0..3.0f64]) {
        let [x, y] = start.position;
        let [left, right] = start.scene.gap_y;
        let end = step(&start, action).position;
        let upside_down = State { scene: Scene { gap_y: [-left, -right] }, position: [x, -y] };
        let down = step(&upside_down, [action[0], -action[1]]).position;
        prop_assert!((down[0] - end[0]).abs() < 1e-9 && (down[1] + end[1]).abs() < 1e-9);
        let other_way = State { scene: Scene { gap_y: [right, left] }, position: [-x, y] };
        let other = step(&other_way, [-action[0], action[1]]).position;
        prop_assert!((other[0] + end[0]).abs() < 1e-9 && (other[1] - end[1]).abs() < 1e-9);
    }

    #[test]
    fn free_motion_is_the_recurrence_of_the_original_simulator(action in [-1.5..1.5f64, -1.5..1.5f64]) {
        // In the middle section, where nothing is within reach.
        let start = State { scene: Scene { gap_y: [0.0; 2] }, position: [0.0; 2] };
        let end = step(&start, action).position;
        for (end, action) in end.into_iter().zip(action) {
            let (mut x, mut v) = (0.0, 0.0);
            for _ in 0..250 {
                v = (v + 0.002 * 0.05 * action / 0.125) / (1.0 + 0.002 * 0.01 / 0.125);
                x += 0.002 * v;
            }
            prop_assert!((end - x).abs() < 1e-12);
        }
    }

    #[test]
    fn along_a_wall_friction_takes_off_what_presses(press in 0.0..3.0f64, along in 0.0..1.5f64) {
        let start = State { scene: Scene { gap_y: [0.0; 2] }, position: [0.0, REACH] };
        let end = step(&start, [along, press]).position;
        let free = step(&State { position: [0.0; 2], ..start }, [(along - FRICTION * press).max(0.0), 0.0]);
        prop_assert!((end[0] - free.position[0]).abs() < 1e-12);
        prop_assert_eq!(end[1], REACH);
    }
}

#[test]
fn a_hit_stops_the_agent_and_friction_what_is_left_along_the_wall() {
    // From rest the agent meets the border with speeds in the ratio of the forces.
    let scene = Scene { gap_y: [0.0; 2] };
    let start = State { scene, position: [0.0, REACH - 0.01] };
    // Steeper than 45 degrees: friction of the hit takes all speed, and pressing holds it.
    let stuck = step(&start, [1.0, 2.0]).position;
    assert_eq!(stuck[1], REACH);
    assert!((stuck[0] - 0.005).abs() < 1e-6, "{stuck:?}");
    // Shallower: after the hit it has the difference of the speeds, and of the forces; that is
    // what it would have had under the difference of the forces from the start.
    let slid = step(&start, [2.0, 0.8]).position;
    assert_eq!(slid[1], REACH);
    let (mass, hit_time) = (0.125, (2.0 * 0.01 * 0.125 / (GEAR * 0.8)).sqrt());
    let accelerations = [GEAR * 2.0 / mass, GEAR * 1.2 / mass];
    let left = STEP_SECONDS - hit_time;
    let without_damping = 0.5 * accelerations[0] * hit_time.powi(2)
        + accelerations[1] * hit_time * left
        + 0.5 * accelerations[1] * left.powi(2);
    assert!((slid[0] - without_damping).abs() < 0.02 * without_damping, "{slid:?}");
}

#[test]
fn sliding_past_the_end_of_a_wall_the_agent_turns_into_the_gap() {
    let scene = Scene { gap_y: [0.0; 2] };
    let start = State { scene, position: [0.12, -0.03] };
    let end = step(&start, [1.0, 1.3]);
    assert!(end.position[0] > 0.125 && overlap(&end) <= 0.0, "{end:?}");
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let scene = Scene { gap_y: [0.1, -0.1] };
    let count = 5000;
    let grid = |i: usize, n: usize| (i % n) as f64 / n as f64 - 0.5;
    let states: Vec<State> = (0..count)
        .map(|i| State { scene, position: [0.5 * grid(i, 71), 0.5 * grid(i, 53)] })
        .collect();
    let actions: Vec<[f32; 2]> =
        (0..count).map(|i| [6.0 * grid(i, 37) as f32, 6.0 * grid(i, 41) as f32]).collect();
    let with_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| step_batch(&states, &actions).unwrap())
    };
    let one = with_threads(1);
    assert_eq!(one, with_threads(3));
    let each: Vec<State> =
        states.iter().zip(&actions).map(|(s, a)| step(s, a.map(f64::from))).collect();
    assert_eq!(one, each);
}

#[test]
fn batches_refuse_what_does_not_fit() {
    let state = State { scene: Scene { gap_y: [0.0; 2] }, position: [0.0; 2] };
    for actions in [vec![], vec![[0.0, f32::NAN]], vec![[f32::INFINITY, 0.0]]] {
        let error = step_batch(&[state], &actions).unwrap_err().to_string();
        assert!(error.starts_with("actions: "), "{error}");
    }
}
