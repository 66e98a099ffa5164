//! Frames of any layout: areas against supersampling, and the paper's scenes as they are.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use hvf_core::maze::geometry::{ARENA, BORDER};
use hvf_core::maze::layout::{locate_in, preset, Gap, LayoutState, Region, Wall};
use hvf_core::maze::render::VIEW;
use hvf_core::maze::{Layout, LayoutScene, Renderer, Scene, State};
use proptest::prelude::*;

fn scene_of(walls: Vec<Wall>, arena: [f64; 2]) -> Option<Arc<LayoutScene>> {
    let [x, y] = arena;
    let anywhere = Region { x: [-x, x], y: [-y, y] };
    let layout = Layout::new("random", arena, walls, anywhere, anywhere).ok()?;
    Some(Arc::new(layout.scene(&[]).unwrap()))
}

fn walls(most: usize) -> impl Strategy<Value = Vec<Wall>> {
    let angle = prop_oneof![4 => 0.0..180.0f64, 1 => Just(0.0), 1 => Just(90.0)];
    let wall = ([-0.3..0.3f64, -0.3..0.3f64], [0.004..0.05f64, 0.01..0.3f64], angle)
        .prop_map(|(centre, half, angle)| Wall { angle, ..Wall::new(centre, half) });
    prop::collection::vec(wall, 1..most)
}

/// Whether a point is wall, by each box's own axes.
fn is_wall(scene: &LayoutScene, x: f64, y: f64) -> bool {
    let [across, up] = scene.layout().arena();
    let beyond = x.abs() > across || y.abs() > up;
    if beyond {
        return x.abs() < across + BORDER && y.abs() < up + BORDER;
    }
    scene.wall_boxes().iter().any(|(centre, half, angle)| {
        let turn = angle.to_radians();
        let (dx, dy) = (x - centre[0], y - centre[1]);
        let own = [turn.cos() * dx + turn.sin() * dy, turn.cos() * dy - turn.sin() * dx];
        own[0].abs() < half[0] && own[1].abs() < half[1]
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn cover_is_the_part_of_a_pixels_area_that_walls_take(
        walls in walls(6),
        arena in [0.15..0.3f64, 0.15..0.3f64],
        size in 8usize..48,
    ) {
        const N: usize = 48;
        if let Some(scene) = scene_of(walls, arena) {
            let backdrop = scene.backdrop(&Renderer::new(size).unwrap());
            let pixel = 2.0 * VIEW / size as f64;
            for (index, &cover) in backdrop.cover().iter().enumerate() {
                let inside = (0..N * N).filter(|sample| {
                    let part = |i: usize| (i as f64 + 0.5) / N as f64;
                    let x = (index % size) as f64 + part(sample % N);
                    let y = (index / size) as f64 + part(sample / N);
                    is_wall(&scene, x * pixel - VIEW, VIEW - y * pixel)
                });
                let expected = inside.count() as f64 / (N * N) as f64;
                // About a row of samples at each of a few edges in the pixel.
                prop_assert!((cover - expected).abs() <= 0.08, "{cover}, not {expected}");
            }
        }
    }

    #[test]
    fn the_papers_walls_as_a_layout_look_the_same(
        gap_y in [-0.2..0.2f64, -0.2..0.2f64],
        position in [-0.275..0.275f64, -0.275..0.275f64],
        size in 8usize..100,
    ) {
        let renderer = Renderer::new(size).unwrap();
        let scene = Arc::new(preset("hard").unwrap().scene(&gap_y).unwrap());
        let (mut own, mut other) = (vec![0; renderer.frame_len()], vec![0; renderer.frame_len()]);
        renderer.render(&State { scene: Scene { gap_y }, position }, &mut own);
        renderer.render(&LayoutState { scene, position }, &mut other);
        // The sums are taken in another order: a colour may round the other way.
        for (own, other) in own.iter().zip(&other) {
            prop_assert!(own.abs_diff(*other) <= 1);
        }
    }

    #[test]
    fn the_agent_is_a_patch_on_its_scene(
        walls in walls(5), position in [-0.275..0.275f64, -0.275..0.275f64], size in 8usize..100
    ) {
        if let Some(scene) = scene_of(walls, [ARENA; 2]) {
            let renderer = Renderer::new(size).unwrap();
            let state = LayoutState { position: scene.obstacles().push_out(position), scene };
            let (mut whole, mut patched) = (vec![0; renderer.frame_len()], vec![0; renderer.frame_len()]);
            renderer.render(&state, &mut whole);
            renderer.render_scene(&state.scene, &mut patched);
            renderer.render_agent(&state, |pixel, colour| {
                patched[3 * pixel..3 * pixel + 3].copy_from_slice(&colour);
            });
            prop_assert_eq!(whole, patched);
        }
    }
}

#[test]
fn crossing_walls_count_once() {
    // A cross of two walls in one pixel of 8: area 2 * 0.06 * 0.01 - 0.01^2.
    let walls = [
        Wall::new([0.04, 0.04], [0.03, 0.005]),
        Wall { angle: 90.0, ..Wall::new([0.04, 0.04], [0.03, 0.005]) },
    ];
    for angle in [0.0, 30.0] {
        let turned = walls.iter().map(|wall| Wall { angle: wall.angle + angle, ..*wall }).collect();
        let scene = scene_of(turned, [ARENA; 2]).unwrap();
        let backdrop = scene.backdrop(&Renderer::new(8).unwrap());
        let cover = backdrop.cover()[3 * 8 + 4];
        assert!((cover - (2.0 * 0.06 * 0.01 - 0.01 * 0.01) / 0.0064).abs() < 1e-12, "{cover}");
    }
}

#[test]
fn a_scene_keeps_its_backdrop_for_a_size() {
    let scene = preset("spiral").unwrap().scene(&[]).unwrap();
    let renderer = Renderer::new(64).unwrap();
    assert!(Arc::ptr_eq(&scene.backdrop(&renderer), &scene.backdrop(&renderer)));
    for size in [16, 17, 18, 19] {
        assert_eq!(scene.backdrop(&Renderer::new(size).unwrap()).size(), size);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn states_of_a_corridor_are_found_again_in_their_frames(
        index in 0u64..1000, count in 1usize..5, size in 64usize..100
    ) {
        let layout = preset(&format!("corridor-{count}")).unwrap();
        let state = layout.random_interaction(7, index, 1).0;
        let renderer = Renderer::new(size).unwrap();
        let mut frame = vec![0; renderer.frame_len()];
        renderer.render(&state, &mut frame);
        let found = locate_in(&layout, &renderer, &frame);
        let off = (0..2).map(|i| (found.position[i] - state.position[i]).abs());
        prop_assert!(off.fold(0.0, f64::max) <= 1e-3, "{:?}, not {:?}", found.position, state.position);
        for (found, gap) in found.scene.gaps().iter().zip(state.scene.gaps()) {
            prop_assert!((found - gap).abs() <= 1e-3, "{found}, not {gap}");
        }
    }

    #[test]
    fn gaps_of_turned_walls_are_found_again(at in -0.1..0.1f64, angle in 0.0..180.0f64) {
        let gap = Some(Gap { half: 0.04, range: [-0.1, 0.1] });
        let wall = Wall { angle, gap, ..Wall::new([0.0; 2], [0.006, 0.16]) };
        let anywhere = Region { x: [-0.27, 0.27], y: [-0.27, 0.27] };
        let layout = Layout::new("turned", [ARENA; 2], vec![wall], anywhere, anywhere).unwrap();
        let scene = Arc::new(layout.scene(&[at]).unwrap());
        let state = LayoutState { position: [0.25, -0.25], scene };
        let renderer = Renderer::new(64).unwrap();
        let mut frame = vec![0; renderer.frame_len()];
        renderer.render(&state, &mut frame);
        let found = locate_in(&layout, &renderer, &frame);
        prop_assert!((found.scene.gaps()[0] - at).abs() <= 1e-3, "{:?}, not {at}", found.scene.gaps());
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
        for name in ["corridor-3", "spiral"] {
            let layout = preset(name).unwrap();
            for frame in [&frame, &vec![0; renderer.frame_len()], &vec![255; renderer.frame_len()]] {
                let found = locate_in(&layout, &renderer, frame);
                prop_assert!(found.scene.obstacles().contains(found.position));
                prop_assert!(found.scene.gaps().iter().all(|gap| gap.abs() <= 0.2));
            }
        }
    }
}
