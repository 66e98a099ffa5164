//! The event-driven maze against Rapier's own dynamics: the same scene as bodies and colliders,
//! stepped by its contact solver in substeps of 2 ms.
#![allow(clippy::unwrap_used)]

use hvf_core::maze::episodes::random_interaction;
use hvf_core::maze::geometry::{AGENT_HALF, ARENA};
use hvf_core::maze::layout::{preset, step_in, Region, Wall};
use hvf_core::maze::motion::{DAMPING, MASS, SUBSTEP};
use hvf_core::maze::physics::{FRICTION, GEAR, STEP_SECONDS};
use hvf_core::maze::{step, Layout, Scene, State};
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use rapier2d_f64::prelude::{Vector, *};

/// Centre, half extents and turn, degrees, of a wall.
type WallBox = ([f64; 2], [f64; 2], f64);

fn paper_walls(scene: &Scene) -> Vec<WallBox> {
    let wall = |wall: Aabb| (wall.center().into(), wall.half_extents().into(), 0.0);
    scene.walls().map(wall).to_vec()
}

/// Walls as Rapier's bodies, the agent among them.
fn world(walls: &[WallBox], position: [f64; 2]) -> (PhysicsWorld, RigidBodyHandle) {
    let mut world = PhysicsWorld { gravity: Vector::ZERO, ..PhysicsWorld::default() };
    world.integration_parameters.dt = SUBSTEP;
    // One integration a step, and tolerances for objects of centimetres.
    world.integration_parameters.num_solver_iterations = 1;
    world.integration_parameters.num_internal_pgs_iterations = 20;
    world.integration_parameters.length_unit = 0.001;
    world.integration_parameters.normalized_max_linear_velocity = 1e6;
    let fixed = world.insert_body(RigidBodyBuilder::fixed());
    let thick = 0.1;
    let borders = [
        [-ARENA - thick, 0.0, thick, 1.0],
        [ARENA + thick, 0.0, thick, 1.0],
        [0.0, -ARENA - thick, 1.0, thick],
        [0.0, ARENA + thick, 1.0, thick],
    ];
    let borders = borders.map(|[x, y, half_x, half_y]| ([x, y], [half_x, half_y], 0.0));
    for (centre, [half_x, half_y], angle) in borders.into_iter().chain(walls.iter().copied()) {
        let shape = ColliderBuilder::cuboid(half_x, half_y);
        let shape = shape.translation(Vector::from(centre)).rotation(angle.to_radians());
        world.insert_collider(shape.friction(FRICTION), Some(fixed));
    }
    let (agent, _) = world.insert(
        RigidBodyBuilder::dynamic()
            .translation(Vector::from(position))
            .lock_rotations()
            .linear_damping(DAMPING / MASS)
            .can_sleep(false),
        ColliderBuilder::cuboid(AGENT_HALF, AGENT_HALF).mass(MASS).friction(FRICTION),
    );
    (world, agent)
}

fn rapier_step(walls: &[WallBox], position: [f64; 2], action: [f64; 2]) -> [f64; 2] {
    let (mut world, agent) = world(walls, position);
    world.bodies[agent].add_force(Vector::from(action) * GEAR, true);
    for _ in 0..(STEP_SECONDS / SUBSTEP).round() as usize {
        world.step();
    }
    world.bodies[agent].translation().into()
}

#[test]
fn steps_end_where_rapiers_dynamics_end() {
    // Rapier notices a contact one substep late, which at most speeds is half a millimetre.
    let (mut errors, mut same_section) = (Vec::new(), 0usize);
    for episode in 0..15 {
        let (mut state, actions) = random_interaction(7, episode, 20);
        for action in actions {
            let action = action.map(f64::from);
            let next = step(&state, action);
            let position = rapier_step(&paper_walls(&state.scene), state.position, action);
            let referee = State { scene: state.scene, position };
            let [dx, dy] = [0, 1].map(|i| next.position[i] - referee.position[i]);
            errors.push(1e3 * dx.hypot(dy));
            same_section += usize::from(next.section() == referee.section());
            state = next;
        }
    }
    errors.sort_by(f64::total_cmp);
    let quantile = |q: f64| errors[(q * (errors.len() - 1) as f64).round() as usize];
    let same = same_section as f64 / errors.len() as f64;
    println!(
        "{} steps: median {:.4} mm, 90% {:.3} mm, 95% {:.2} mm, max {:.1} mm, same section {:.1}%",
        errors.len(),
        quantile(0.5),
        quantile(0.9),
        quantile(0.95),
        quantile(1.0),
        100.0 * same
    );
    assert!(quantile(0.5) <= 0.05 && quantile(0.95) <= 1.0 && quantile(1.0) <= 2.0);
    assert_eq!(same_section, errors.len());
}

/// Distances of steps in a layout from Rapier's, mm, sorted.
fn errors_in(layout: &std::sync::Arc<Layout>, episodes: u64, steps: usize) -> Vec<f64> {
    let mut errors = Vec::new();
    for episode in 0..episodes {
        let (state, actions) = layout.random_interaction(3, episode, steps);
        let (walls, mut here) = (state.scene.wall_boxes(), state.position);
        for action in actions {
            let action = action.map(f64::from);
            let next = step_in(state.scene.obstacles(), here, action);
            let referee = rapier_step(&walls, here, action);
            errors.push(1e3 * (next[0] - referee[0]).hypot(next[1] - referee[1]));
            here = next;
        }
    }
    errors.sort_by(f64::total_cmp);
    errors
}

fn quantiles(name: &str, errors: &[f64]) -> [f64; 4] {
    let quantile = |q: f64| errors[(q * (errors.len() - 1) as f64).round() as usize];
    let found = [0.5, 0.95, 0.99, 1.0].map(quantile);
    println!("{name}: {} steps: median, 95%, 99%, max {found:.3?} mm", errors.len());
    found
}

#[test]
fn steps_in_named_layouts_end_where_rapiers_dynamics_end() {
    for name in ["corridor-4", "u-maze", "spiral"] {
        let found = quantiles(name, &errors_in(&preset(name).unwrap(), 6, 20));
        assert!(found[0] <= 0.1 && found[1] <= 1.0 && found[3] <= 2.0, "{name}: {found:?}");
    }
}

#[test]
fn steps_in_random_layouts_end_where_rapiers_dynamics_end() {
    let anywhere = Region { x: [-0.275, 0.275], y: [-0.275, 0.275] };
    let wall = ([-0.28..0.28f64, -0.28..0.28f64], [0.005..0.06f64, 0.005..0.06f64], 0.0..180.0f64)
        .prop_map(|(centre, half, angle)| Wall { angle, ..Wall::new(centre, half) });
    let walls = prop::collection::vec(wall, 3..10);
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let mut errors = Vec::new();
    for _ in 0..25 {
        let walls = walls.new_tree(&mut runner).unwrap().current();
        let Ok(layout) = Layout::new("random", [ARENA; 2], walls, anywhere, anywhere) else {
            continue;
        };
        errors.extend(errors_in(&layout, 1, 15));
    }
    errors.sort_by(f64::total_cmp);
    let found = quantiles("random layouts", &errors);
    assert!(found[0] <= 0.1 && found[1] <= 1.5, "{found:?}");
}
