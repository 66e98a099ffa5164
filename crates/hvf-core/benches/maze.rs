//! Throughput of the maze on one core: steps, frames, and finding states in frames.
//!
//! Elements per second are steps or frames per second.
#![allow(clippy::unwrap_used)]

use std::hint::black_box;
use std::sync::Arc;

use criterion::{criterion_group, criterion_main, Criterion, Throughput};
use hvf_core::maze::episodes::random_interaction;
use hvf_core::maze::layout::{preset, step_in, Region, Wall};
use hvf_core::maze::{collect, step, Layout, LayoutState, Renderer, State, IMAGE_SIZE};

const EPISODES: u64 = 64;
const STEPS: usize = 50;

/// Random interaction of many episodes, one after another on this thread.
fn rollouts(mut each: impl FnMut(&State)) {
    for episode in 0..EPISODES {
        let (mut state, actions) = random_interaction(0, episode, STEPS);
        for action in actions {
            state = step(&state, action.map(f64::from));
            each(&state);
        }
    }
}

/// Ten turned walls all over the arena, and a corridor of seven walls with gaps.
fn layouts() -> [(&'static str, Arc<Layout>); 2] {
    let anywhere = Region { x: [-0.275, 0.275], y: [-0.275, 0.275] };
    let wall = |i: i32| {
        let [x, y] = [0.15 * f64::from(i % 4) - 0.22, 0.19 * f64::from(i / 4) - 0.19];
        Wall { angle: 36.0 * f64::from(i), ..Wall::new([x, y], [0.01, 0.06]) }
    };
    let walls = (0..10).map(wall).collect();
    let turned = Layout::new("ten turned walls", [0.3; 2], walls, anywhere, anywhere).unwrap();
    [("10_turned_walls", turned), ("corridor_7", preset("corridor-7").unwrap())]
}

/// The same as [`rollouts`] in a layout.
fn layout_rollouts(layout: &Arc<Layout>, mut each: impl FnMut(&LayoutState)) {
    for episode in 0..EPISODES {
        let (mut state, actions) = layout.random_interaction(0, episode, STEPS);
        for action in actions {
            let space = state.scene.obstacles();
            state.position = step_in(space, state.position, action.map(f64::from));
            each(&state);
        }
    }
}

fn layout(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("layout_one_core");
    group.throughput(Throughput::Elements(EPISODES * STEPS as u64));
    group.sample_size(30);
    let renderer = Renderer::new(IMAGE_SIZE).unwrap();
    let mut frame = vec![0; renderer.frame_len()];
    for (name, layout) in layouts() {
        group.bench_function(format!("step_{name}"), |bencher| {
            bencher.iter(|| {
                layout_rollouts(&layout, |state| {
                    black_box(state);
                })
            });
        });
        group.bench_function(format!("step_and_render_64_{name}"), |bencher| {
            bencher.iter(|| {
                layout_rollouts(&layout, |state| {
                    renderer.render(state, &mut frame);
                    black_box(&frame);
                });
            });
        });
    }
    group.finish();
}

fn maze(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("maze_one_core");
    group.throughput(Throughput::Elements(EPISODES * STEPS as u64));
    group.sample_size(30);
    group.bench_function("step", |bencher| {
        bencher.iter(|| {
            rollouts(|state| {
                black_box(state);
            })
        });
    });
    let renderer = Renderer::new(IMAGE_SIZE).unwrap();
    let mut frame = vec![0; renderer.frame_len()];
    group.bench_function("step_and_render_64", |bencher| {
        bencher.iter(|| {
            rollouts(|state| {
                renderer.render(state, &mut frame);
                black_box(&frame);
            });
        });
    });
    let large = Renderer::new(256).unwrap();
    let mut large_frame = vec![0; large.frame_len()];
    group.bench_function("step_and_render_256", |bencher| {
        bencher.iter(|| {
            rollouts(|state| {
                large.render(state, &mut large_frame);
                black_box(&large_frame);
            });
        });
    });
    group.throughput(Throughput::Elements(1));
    group.bench_function("locate_64", |bencher| {
        bencher.iter(|| black_box(renderer.locate(black_box(&frame))));
    });
    group.finish();

    let mut group = criterion.benchmark_group("maze_all_cores");
    let count = 40;
    let mut frames = vec![0; count * (STEPS + 1) * renderer.frame_len()];
    group.throughput(Throughput::Elements((count * STEPS) as u64));
    group.sample_size(20);
    group.bench_function("collect_64", |bencher| {
        bencher.iter(|| collect(&renderer, 0, 0, count, STEPS, &mut frames).unwrap());
    });
    group.finish();
}

criterion_group!(benches, maze, layout);
criterion_main!(benches);
