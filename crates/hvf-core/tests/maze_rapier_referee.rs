//! The event-driven maze against Rapier's own dynamics: the same scene as bodies and colliders,
//! stepped by its contact solver in substeps of 2 ms.
#![allow(clippy::unwrap_used)]

use hvf_core::maze::episodes::random_interaction;
use hvf_core::maze::geometry::{AGENT_HALF, ARENA};
use hvf_core::maze::motion::{DAMPING, MASS, SUBSTEP};
use hvf_core::maze::physics::{FRICTION, GEAR, STEP_SECONDS};
use hvf_core::maze::{step, Scene, State};
use rapier2d_f64::prelude::*;

/// A scene as Rapier's bodies, the agent among them.
fn world(scene: &Scene, position: [f64; 2]) -> (PhysicsWorld, RigidBodyHandle) {
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
    let walls = scene.walls().map(|wall| {
        let (centre, half) = (wall.center(), wall.half_extents());
        [centre.x, centre.y, half.x, half.y]
    });
    for [x, y, half_x, half_y] in borders.into_iter().chain(walls) {
        let shape = ColliderBuilder::cuboid(half_x, half_y);
        let shape = shape.translation(Vector::new(x, y)).friction(FRICTION);
        world.insert_collider(shape, Some(fixed));
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

fn rapier_step(state: &State, action: [f64; 2]) -> [f64; 2] {
    let (mut world, agent) = world(&state.scene, state.position);
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
            let referee = State { scene: state.scene, position: rapier_step(&state, action) };
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
