//! Steps in any layout, against the paper's two walls, a slow integration and what must hold.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use hvf_core::maze::geometry::{AGENT_HALF, ARENA};
use hvf_core::maze::layout::{preset, step_in, Gap, LayoutScene, Region, Wall, SLACK};
use hvf_core::maze::motion::{DAMPING, MASS};
use hvf_core::maze::physics::{FRICTION, GEAR, STEP_SECONDS};
use hvf_core::maze::{step, Layout, Scene, State};
use proptest::prelude::*;
use proptest::strategy::ValueTree;

const ANYWHERE: Region = Region { x: [-0.275, 0.275], y: [-0.275, 0.275] };

/// Up to `most` boxes of all sizes and turns, some along the axes, some from border to border.
fn walls(most: usize) -> impl Strategy<Value = Vec<Wall>> {
    let angle = prop_oneof![3 => 0.0..180.0f64, 1 => Just(0.0), 1 => Just(90.0), 1 => Just(45.0)];
    let half = prop_oneof![3 => 0.004..0.08f64, 1 => Just(0.005), 1 => 0.1..0.3f64];
    let wall = ([-0.3..0.3f64, -0.3..0.3f64], [half.clone(), half], angle)
        .prop_map(|(centre, half, angle)| Wall { angle, ..Wall::new(centre, half) });
    prop::collection::vec(wall, 1..most)
}

/// A scene of these walls; `None` where they leave too little room.
fn scene_of(walls: Vec<Wall>) -> Option<Arc<LayoutScene>> {
    // Anywhere for both: what counts is that there is room at all.
    let layout = Layout::new("random", [ARENA; 2], walls, ANYWHERE, ANYWHERE).ok()?;
    Some(Arc::new(layout.scene(&[]).unwrap()))
}

/// Whether the agent's square and a wall overlap by more than `slack`, by separating axes.
fn overlaps(position: [f64; 2], centre: [f64; 2], half: [f64; 2], angle: f64, slack: f64) -> bool {
    let turn = angle.to_radians();
    let axes = [[turn.cos(), turn.sin()], [-turn.sin(), turn.cos()]];
    [[1.0, 0.0], [0.0, 1.0], axes[0], axes[1]].iter().all(|n| {
        let apart = n[0] * (position[0] - centre[0]) + n[1] * (position[1] - centre[1]);
        let wall: f64 =
            (0..2).map(|i| half[i] * (n[0] * axes[i][0] + n[1] * axes[i][1]).abs()).sum();
        let agent = AGENT_HALF * (n[0].abs() + n[1].abs());
        apart.abs() < wall + agent - slack
    })
}

fn is_free(scene: &LayoutScene, position: [f64; 2], slack: f64) -> bool {
    let [x, y] = position;
    let inside = x.abs().max(y.abs()) + AGENT_HALF - ARENA <= slack;
    inside && !scene.wall_boxes().iter().any(|&(c, h, a)| overlaps(position, c, h, a, slack))
}

/// The step as thousands of small ones: free motion, then what it ran into stops it. First order
/// in the length of a substep.
fn integrated(scene: &LayoutScene, start: [f64; 2], action: [f64; 2], substeps: usize) -> [f64; 2] {
    let space = scene.obstacles();
    let h = STEP_SECONDS / substeps as f64;
    let force = action.map(|a| GEAR * a.clamp(-3.0, 3.0));
    let (mut p, mut v) = (space.push_out(start), [0.0f64; 2]);
    // Lines of all faces, worked out from the boxes alone.
    let faces: Vec<Vec<([f64; 2], f64)>> = scene
        .wall_boxes()
        .iter()
        .map(|&(centre, half, angle)| {
            let turn = angle.to_radians();
            let (u, w) = ([turn.cos(), turn.sin()], [-turn.sin(), turn.cos()]);
            let around = [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]];
            let own = [u, u.map(|c| -c), w, w.map(|c| -c)];
            around
                .into_iter()
                .chain(own)
                .map(|n: [f64; 2]| {
                    let dot = |a: [f64; 2]| n[0] * a[0] + n[1] * a[1];
                    let reach = half[0] * dot(u).abs()
                        + half[1] * dot(w).abs()
                        + AGENT_HALF * (n[0].abs() + n[1].abs());
                    (n, dot(centre) + reach)
                })
                .collect()
        })
        .collect();
    let reach = ARENA - AGENT_HALF;
    for _ in 0..substeps {
        v = [0, 1].map(|i| (v[i] + h * force[i] / MASS) / (1.0 + h * DAMPING / MASS));
        // Impulses of contacts: each takes what runs into it, and friction.
        let mut touched: Vec<[f64; 2]> = Vec::new();
        for wall in &faces {
            let ahead = |(n, d): &([f64; 2], f64)| n[0] * p[0] + n[1] * p[1] - d;
            let nearest = wall.iter().max_by(|a, b| ahead(a).total_cmp(&ahead(b))).unwrap();
            let far = ahead(nearest);
            let tied = wall.iter().filter(|face| ahead(face) > far - 1e-9);
            let face = tied
                .max_by(|a, b| {
                    let into = |n: [f64; 2]| n[0] * v[0] + n[1] * v[1];
                    into(a.0).total_cmp(&into(b.0))
                })
                .unwrap();
            if far <= 1e-9 {
                touched.push(face.0);
            }
        }
        for i in 0..2 {
            for sign in [-1.0, 1.0] {
                if sign * p[i] >= reach - 1e-9 {
                    let mut n = [0.0; 2];
                    n[i] = -sign;
                    touched.push(n);
                }
            }
        }
        for _ in 0..8 {
            let into = |n: &[f64; 2]| n[0] * v[0] + n[1] * v[1];
            let Some(n) = touched.iter().min_by(|a, b| into(a).total_cmp(&into(b))) else { break };
            let lost = -into(n);
            if lost <= 1e-15 {
                break;
            }
            let t = [-n[1], n[0]];
            let along = t[0] * v[0] + t[1] * v[1];
            let kept = (along.abs() - FRICTION * lost).max(0.0) * along.signum();
            v = t.map(|c| c * kept);
        }
        if touched.iter().any(|n| n[0] * v[0] + n[1] * v[1] < -1e-12) {
            v = [0.0; 2];
        }
        p = [p[0] + h * v[0], p[1] + h * v[1]];
        // Out of what was entered, by the nearest face.
        p = p.map(|c| c.clamp(-reach, reach));
        for wall in &faces {
            let ahead = |(n, d): &([f64; 2], f64)| n[0] * p[0] + n[1] * p[1] - d;
            let nearest = wall.iter().max_by(|a, b| ahead(a).total_cmp(&ahead(b))).unwrap();
            let far = ahead(nearest);
            if far < 0.0 {
                p = [p[0] - far * nearest.0[0], p[1] - far * nearest.0[1]];
            }
        }
    }
    p
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn two_walls_as_a_layout_step_as_the_papers_maze(
        gaps in [-0.2..0.2f64, -0.2..0.2f64],
        position in [-0.275..0.275f64, -0.275..0.275f64],
        actions in prop::collection::vec([-3.0..3.0f64, -3.0..3.0f64], 1..40),
    ) {
        let scene = preset("hard").unwrap().scene(&gaps).unwrap();
        let mut paper = step(&State { scene: Scene { gap_y: gaps }, position }, [0.0; 2]);
        for action in actions {
            let here = step_in(scene.obstacles(), paper.position, action);
            paper = step(&paper, action);
            let off = (here[0] - paper.position[0]).hypot(here[1] - paper.position[1]);
            prop_assert!(off < 1e-7, "{here:?}, not {paper:?}, after {action:?}");
        }
    }

    #[test]
    fn no_sequence_of_actions_ends_in_a_wall_or_outside(
        walls in walls(14),
        position in [-0.3..0.3f64, -0.3..0.3f64],
        actions in prop::collection::vec(
            [
                prop_oneof![8 => -3.0..3.0f64, 1 => Just(3.0), 1 => Just(0.0), 1 => any::<f64>()],
                prop_oneof![8 => -3.0..3.0f64, 1 => Just(-3.0), 1 => Just(0.0), 1 => any::<f64>()],
            ],
            1..40
        ),
    ) {
        if let Some(scene) = scene_of(walls) {
            let mut here = scene.obstacles().push_out(position);
            for action in actions {
                here = step_in(scene.obstacles(), here, action);
                prop_assert!(is_free(&scene, here, 2.0 * SLACK), "{here:?} after {action:?}");
            }
        }
    }

    #[test]
    fn walls_are_never_passed_through(
        walls in walls(10),
        position in [-0.275..0.275f64, -0.275..0.275f64],
        action in [-3.0..3.0f64, -3.0..3.0f64],
    ) {
        // Where a step ends, a slow one of the same length in many parts can also get: both stay
        // in one connected part of free space.
        if let Some(scene) = scene_of(walls) {
            let space = scene.obstacles();
            let start = space.push_out(position);
            let end = step_in(space, start, action);
            let far = (end[0] - start[0]).hypot(end[1] - start[1]);
            let free = 0.0496 * action[0].hypot(action[1]);
            prop_assert!(far <= free + 1e-7);
            let way = hvf_core::maze::layout::Way::shortest(&scene, start, end);
            let way = way.expect("a step leads to where there is a way");
            prop_assert!(way.length() <= free + 1e-6, "{} > {free}", way.length());
        }
    }

    #[test]
    fn a_turned_maze_gives_turned_steps(
        walls in walls(10),
        position in [-0.275..0.275f64, -0.275..0.275f64],
        action in [-3.0..3.0f64, -3.0..3.0f64],
    ) {
        let quarter = |[x, y]: [f64; 2]| [-y, x];
        let turned = walls
            .iter()
            .map(|wall| Wall { centre: quarter(wall.centre), angle: wall.angle + 90.0, ..*wall });
        if let (Some(scene), Some(other)) = (scene_of(walls.clone()), scene_of(turned.collect())) {
            let start = scene.obstacles().push_out(position);
            let end = quarter(step_in(scene.obstacles(), start, action));
            let there = step_in(other.obstacles(), quarter(start), quarter(action));
            let off = (end[0] - there[0]).hypot(end[1] - there[1]);
            prop_assert!(off < 1e-6, "{end:?}, not {there:?}");
        }
    }
}

#[test]
fn steps_end_where_a_slow_integration_of_the_same_rules_ends() {
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let mut errors = Vec::new();
    while errors.len() < 1500 {
        let walls = walls(12).new_tree(&mut runner).unwrap().current();
        let Some(scene) = scene_of(walls) else { continue };
        let (place, force) = ([-0.275..0.275f64, -0.275..0.275f64], [-3.0..3.0f64, -3.0..3.0f64]);
        for _ in 0..5 {
            let position = place.new_tree(&mut runner).unwrap().current();
            let action = force.new_tree(&mut runner).unwrap().current();
            let start = scene.obstacles().push_out(position);
            let end = step_in(scene.obstacles(), start, action);
            let slow = integrated(&scene, start, action, 5000);
            errors.push(1e3 * (end[0] - slow[0]).hypot(end[1] - slow[1]));
        }
    }
    errors.sort_by(f64::total_cmp);
    let quantile = |q: f64| errors[(q * (errors.len() - 1) as f64).round() as usize];
    println!(
        "{} steps: median {:.4} mm, 95% {:.3} mm, 99% {:.3} mm, max {:.2} mm",
        errors.len(),
        quantile(0.5),
        quantile(0.95),
        quantile(0.99),
        quantile(1.0)
    );
    // First order in substeps of 0.1 ms; 0.2% further in 0.5 s than substeps of 2 ms.
    assert!(quantile(0.5) <= 0.3 && quantile(0.95) <= 0.6 && quantile(0.99) <= 1.0);
}

#[test]
fn pressed_on_a_turned_wall_friction_holds_or_lets_slide_in_closed_form() {
    // A wall at 30 degrees below the agent: it touches the upper face's line with its corner.
    let wall = Wall { angle: 30.0, ..Wall::new([0.0, 0.0], [0.25, 0.005]) };
    let scene = scene_of(vec![wall]).unwrap();
    let turn = 30f64.to_radians();
    let (normal, along) = ([-turn.sin(), turn.cos()], [turn.cos(), turn.sin()]);
    let touch = 0.005 + AGENT_HALF * (normal[0].abs() + normal[1].abs());
    let start = [0, 1].map(|i| touch * normal[i] - 0.05 * along[i]);
    for (press, pull) in [(1.0, 0.9), (1.0, -0.5), (0.5, 1.5), (0.3, -1.2)] {
        let action = [0, 1].map(|i| -press * normal[i] + pull * along[i]);
        let end = step_in(scene.obstacles(), start, action);
        // Along the face: what is left of the force when friction has taken its part.
        let net = f64::signum(pull) * (f64::abs(pull) - FRICTION * press).max(0.0);
        let moved = step_in(
            scene_of(vec![Wall::new([0.29, 0.29], [0.001; 2])]).unwrap().obstacles(),
            [0.0; 2],
            [net, 0.0],
        )[0];
        for i in 0..2 {
            assert!((end[i] - start[i] - moved * along[i]).abs() < 1e-9, "{end:?}");
        }
    }
}

#[test]
fn in_a_corner_of_two_turned_walls_nothing_sticks_that_can_leave() {
    // A V that opens upwards.
    let walls = vec![
        Wall { angle: 45.0, ..Wall::new([0.06, 0.0], [0.1, 0.005]) },
        Wall { angle: -45.0, ..Wall::new([-0.06, 0.0], [0.1, 0.005]) },
    ];
    let scene = scene_of(walls).unwrap();
    let space = scene.obstacles();
    let mut here = [0.0, 0.15];
    for _ in 0..4 {
        here = step_in(space, here, [0.0, -3.0]);
    }
    assert!(here[0].abs() < 1e-9 && here[1] > -0.03 && here[1] < 0.05, "{here:?}");
    assert_eq!(step_in(space, here, [0.0, -3.0]), here);
    let up = step_in(space, here, [0.0, 1.0]);
    assert!((up[1] - here[1] - 0.0495).abs() < 1e-4, "{up:?}");
    // Along one side of the V.
    let out = step_in(space, here, [1.0, 1.0]);
    assert!(out[0] > 0.049 && out[1] > here[1] + 0.049, "{out:?}");
}

#[test]
fn many_walls_are_found_by_the_hierarchy_as_by_looking_at_each() {
    let walls: Vec<Wall> = (0..60)
        .map(|i| {
            let [x, y] = [0.11 * f64::from(i % 6) - 0.275, 0.06 * f64::from(i / 6) - 0.28];
            Wall { angle: 17.0 * f64::from(i), ..Wall::new([x, y], [0.004, 0.006]) }
        })
        .collect();
    let scene = scene_of(walls.clone()).unwrap();
    let mut here = scene.obstacles().push_out([0.0; 2]);
    for i in 0..2000 {
        let turn = 0.7 * f64::from(i) + 0.3 * f64::from(i % 17);
        let action = [3.0 * turn.cos(), 3.0 * turn.sin()];
        let next = step_in(scene.obstacles(), here, action);
        // Walls out of reach do not matter; without them each is looked at.
        let close =
            |wall: &&Wall| (wall.centre[0] - here[0]).hypot(wall.centre[1] - here[1]) < 0.22;
        let few: Vec<Wall> = walls.iter().filter(close).take(24).copied().collect();
        if walls.iter().filter(close).count() <= 24 {
            let few = scene_of(few).unwrap();
            assert_eq!(step_in(few.obstacles(), here, action), next);
        }
        here = next;
    }
}

#[test]
fn bad_layouts_name_the_argument() {
    let corner = Region { x: [-0.27, -0.2], y: [-0.27, -0.2] };
    let other = Region { x: [0.2, 0.27], y: [0.2, 0.27] };
    let new = |arena, walls, start, goal| {
        Layout::new("bad", arena, walls, start, goal).unwrap_err().to_string()
    };
    let wall = Wall::new([0.0; 2], [0.01, 0.3]);
    for (argument, error) in [
        ("arena", new([0.4, 0.3], vec![], corner, other)),
        ("arena", new([f64::NAN, 0.3], vec![], corner, other)),
        ("walls", new([0.3; 2], vec![Wall { angle: f64::NAN, ..wall }], corner, other)),
        ("walls", new([0.3; 2], vec![Wall::new([0.0; 2], [0.0, 0.1])], corner, other)),
        ("walls", new([0.3; 2], vec![Wall::new([0.5; 2], [0.1; 2])], corner, other)),
        ("walls", new([0.3; 2], vec![wall; 257], corner, other)),
        ("start", new([0.3; 2], vec![Wall::new([-0.25; 2], [0.1; 2])], corner, other)),
        ("goal", new([0.3; 2], vec![Wall::new([0.25; 2], [0.1; 2])], corner, other)),
        ("start", new([0.3; 2], vec![], Region { x: [0.1, -0.1], ..corner }, other)),
        ("goal", new([0.3; 2], vec![], corner, Region { x: [0.1, 0.4], ..corner })),
        ("goal: cannot be reached", new([0.3; 2], vec![wall], corner, other)),
    ] {
        assert!(error.starts_with(argument), "{argument}: {error}");
    }
    let gap = |half, range| Wall { gap: Some(Gap { half, range }), ..wall };
    for wall in [gap(0.02, [0.0; 2]), gap(0.05, [0.2, -0.2]), gap(0.05, [0.0, 0.4])] {
        let error = new([0.3; 2], vec![wall], corner, other);
        assert!(error.starts_with("walls: wall 0 gap"), "{error}");
    }
    for name in ["", "corridor-0", "corridor-9", "corridor-x", "Spiral"] {
        let error = preset(name).unwrap_err().to_string();
        assert!(error.starts_with("layout: must be one of easy") && error.contains("corridor-N"));
    }
    let corridor = preset("corridor-3").unwrap();
    assert!(corridor.scene(&[0.0; 2]).unwrap_err().to_string().starts_with("gaps"));
    assert!(corridor.scene(&[0.0, 0.0, f64::NAN]).unwrap_err().to_string().starts_with("gaps"));
}
