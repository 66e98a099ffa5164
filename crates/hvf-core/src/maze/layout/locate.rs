//! States found again in frames of a layout.

use std::sync::Arc;

use super::coverage::part_of_pixels;
use super::description::{Gap, Layout};
use super::polygon::{box_of, clipped_to_rectangle};
use super::scene::LayoutState;
use crate::maze::geometry::State;
use crate::maze::render::{wall_part, Renderer};

/// Places along a wall at which a gap is first looked for.
const PLACES: usize = 41;
/// Rounds of narrowing down between neighbours of the best one; each by a factor of 0.6.
const ROUNDS: usize = 30;

/// The state of a layout that a frame `[size, size, 3]` shows: where the agent is, and where along
/// its wall each gap is, the one that explains best where wall is missing.
///
/// Always a legal state: gaps are where episodes may have them, the agent where it can stand.
///
/// # Panics
/// If `frame` does not have [`Renderer::frame_len`] bytes.
pub fn locate_in(layout: &Arc<Layout>, renderer: &Renderer, frame: &[u8]) -> LayoutState {
    let position = renderer.locate_agent(frame);
    let inside = layout.arena().map(|half| [-half, half]);
    let size = renderer.size();
    let mut gaps = Vec::new();
    for wall in layout.walls() {
        let Some(Gap { half, range: [low, high] }) = wall.gap else {
            continue;
        };
        let whole = box_of(&wall.centre, &wall.half, wall.angle);
        let mut missing: Vec<(usize, f64)> = Vec::new();
        let polygon = clipped_to_rectangle(&whole.corners(), inside);
        part_of_pixels(&polygon, size, |pixel, part| {
            let seen = wall_part(&frame[3 * pixel..3 * pixel + 3]).clamp(0.0, 1.0);
            missing.push((pixel, part - seen.min(part)));
        });
        // Squared error of an opening there, up to what does not depend on it.
        let error = |at: f64| {
            let open = clipped_to_rectangle(&whole.piece(at - half, at + half).corners(), inside);
            let mut error = 0.0;
            let mut next = 0;
            part_of_pixels(&open, size, |pixel, part| {
                // Both visit pixels in order.
                while missing.get(next).is_some_and(|(at, _)| *at < pixel) {
                    next += 1;
                }
                if let Some((_, missing)) = missing.get(next).filter(|(at, _)| *at == pixel) {
                    error += part * (part - 2.0 * missing);
                }
            });
            error
        };
        let step = (high - low) / (PLACES - 1) as f64;
        let place = |i: usize| (low + step * i as f64).min(high);
        let best = (0..PLACES)
            .map(|i| (error(place(i)), place(i)))
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map_or(low, |(_, at)| at);
        gaps.push(narrowed(error, (best - step).max(low), (best + step).min(high)));
    }
    let scene = Arc::new(super::LayoutScene::new(Arc::clone(layout), gaps));
    let [x, y] = layout.arena();
    let position = [position[0].clamp(-x, x), position[1].clamp(-y, y)];
    let position = scene.obstacles().push_out(position);
    State { scene, position }
}

/// Where a function of one dip between two places is least: golden-section search.
fn narrowed(error: impl Fn(f64) -> f64, mut low: f64, mut high: f64) -> f64 {
    const PART: f64 = 0.618_033_988_749_894_8;
    let (mut a, mut b) = (high - PART * (high - low), low + PART * (high - low));
    let (mut at_a, mut at_b) = (error(a), error(b));
    for _ in 0..ROUNDS {
        if at_a <= at_b {
            (high, b, at_b) = (b, a, at_a);
            a = high - PART * (high - low);
            at_a = error(a);
        } else {
            (low, a, at_a) = (a, b, at_b);
            b = low + PART * (high - low);
            at_b = error(b);
        }
    }
    0.5 * (low + high)
}
