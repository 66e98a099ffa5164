//! The maze against recorded transitions of the original simulator.
#![allow(clippy::unwrap_used)]

use std::path::Path;

use hvf_core::maze::{step, State};

/// 500 transitions of the original (MuJoCo): its soft contacts let the agent sink a few
/// millimetres into walls, which a rigid simulator cannot follow.
#[test]
fn steps_end_where_the_original_simulator_ended() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../../shared/maze/reference_transitions.csv");
    let Ok(text) = std::fs::read_to_string(&path) else {
        println!("skipped: {} is not there", path.display());
        return;
    };
    let rows = text
        .lines()
        .skip(1)
        .map(|line| line.split(',').map(|field| field.parse::<f64>().unwrap()).collect::<Vec<_>>());
    let (mut errors, mut same_section) = (Vec::new(), 0usize);
    for row in rows {
        let [w1, w2, x, y, action_x, action_y, next_x, next_y] = row[2..].try_into().unwrap();
        let state = State::from_row([x, y, w1, w2]).unwrap();
        let next = step(&state, [action_x, action_y]);
        let expected = State { scene: state.scene, position: [next_x, next_y] };
        errors.push((next.position[0] - next_x).hypot(next.position[1] - next_y));
        same_section += usize::from(next.section() == expected.section());
    }
    errors.sort_by(f64::total_cmp);
    let quantile = |q: f64| 1e3 * errors[(q * (errors.len() - 1) as f64).round() as usize];
    let same = same_section as f64 / errors.len() as f64;
    println!(
        "{} transitions: median {:.3} mm, 95% {:.2} mm, max {:.2} mm, same section {:.1}%",
        errors.len(),
        quantile(0.5),
        quantile(0.95),
        quantile(1.0),
        100.0 * same
    );
    assert_eq!(errors.len(), 500);
    assert!(quantile(0.5) <= 0.5 && quantile(0.95) <= 8.0 && same >= 0.995);
}
