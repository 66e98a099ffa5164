//! Layouts by name.

use std::sync::Arc;

use super::description::{Gap, Layout, Region, Wall};
use crate::maze::episodes::Difficulty;
use crate::maze::geometry::{ARENA, GAP_HALF, GAP_RANGE, REACH, WALL_HALF, WALL_X};
use crate::{Error, Result};

/// Names of layouts; `N` in one stands for a number.
pub const PRESETS: [&str; 6] = ["easy", "medium", "hard", "corridor-N", "u-maze", "spiral"];
/// Most walls of a corridor: the agent must fit between them.
pub const MOST_CORRIDOR_WALLS: usize = 7;

/// The layout of a name: the paper's difficulties; `corridor-N`, N walls from border to border
/// with a gap each, drawn by every episode; `u-maze`, a wall to go round; `spiral`, a lane of
/// four turns to the middle.
///
/// # Errors
/// Another name.
pub fn preset(name: &str) -> Result<Arc<Layout>> {
    let (walls, start, goal) = match name {
        "easy" => paper([0.15, 0.27]),
        "medium" => paper([-0.15, 0.15]),
        "hard" => paper([-0.27, -0.15]),
        "u-maze" => u_maze(),
        "spiral" => spiral(),
        _ => match name.strip_prefix("corridor-").map(str::parse::<usize>) {
            Some(Ok(count)) if (1..=MOST_CORRIDOR_WALLS).contains(&count) => corridor(count),
            _ => {
                return Err(Error::invalid(
                    "layout",
                    format!(
                        "must be one of {}, with N from 1 to {MOST_CORRIDOR_WALLS}; got '{name}'",
                        PRESETS.join(", ")
                    ),
                ))
            }
        },
    };
    let layout = Layout::new(name, [ARENA; 2], walls, start, goal)?;
    Ok(match name.parse::<Difficulty>() {
        Ok(difficulty) => layout.of_paper(difficulty),
        Err(_) => layout,
    })
}

/// A wall from border to border at `x`, with a gap as in the paper's maze.
fn gapped(x: f64) -> Wall {
    let gap = Gap { half: GAP_HALF, range: [-GAP_RANGE, GAP_RANGE] };
    Wall { gap: Some(gap), ..Wall::new([x, 0.0], [WALL_HALF, ARENA]) }
}

/// Section 6.1 of Nair & Finn (2020), with starts in `start_x`.
fn paper(start_x: [f64; 2]) -> (Vec<Wall>, Region, Region) {
    let start = Region { x: start_x, y: [-0.27, 0.27] };
    let goal = Region { x: [0.2, 0.28], y: [-0.28, 0.28] };
    (WALL_X.map(gapped).to_vec(), start, goal)
}

fn corridor(count: usize) -> (Vec<Wall>, Region, Region) {
    let apart = 2.0 * ARENA / (count + 1) as f64;
    let walls = (1..=count).map(|wall| gapped(-ARENA + apart * wall as f64)).collect();
    // The first and the last chamber.
    let inner = ARENA - apart + (WALL_HALF + ARENA - REACH);
    let y = [-0.27, 0.27];
    (walls, Region { x: [-REACH, -inner], y }, Region { x: [inner, REACH], y })
}

fn u_maze() -> (Vec<Wall>, Region, Region) {
    let wall = Wall::new([-0.1, 0.0], [0.2, 0.03]);
    let x = [-0.25, -0.1];
    (vec![wall], Region { x, y: [0.1, 0.25] }, Region { x, y: [-0.25, -0.1] })
}

fn spiral() -> (Vec<Wall>, Region, Region) {
    let t = WALL_HALF;
    let walls = vec![
        // Below the lane at the top, open at the right.
        Wall::new([-0.075, 0.15], [0.225, t]),
        // Down the lane at the right.
        Wall::new([0.15, 0.0], [t, 0.15 + t]),
        // Along the lane at the bottom, open at the left.
        Wall::new([0.0, -0.15], [0.15, t]),
        // Up the lane at the left, open at its top.
        Wall::new([-0.15, -0.075], [t, 0.075]),
    ];
    let start = Region { x: [-0.27, -0.18], y: [0.19, 0.27] };
    let goal = Region { x: [0.0, 0.11], y: [-0.11, 0.0] };
    (walls, start, goal)
}
