//! What the first samples of a search are drawn from: the generator's proposals, or its prior.

use super::Ends;
use crate::planner::cem::distribution::{Initial, Start};
use crate::planner::model::{Frames, SubgoalModel};
use crate::{Error, Result};

/// The first distribution of each search, over `K` times `L` latents; one for all where the
/// generator proposes nothing.
///
/// # Errors
/// An error of the generator, or proposals of another shape, that are not finite, or whose
/// deviations are negative.
pub(super) fn starts<F: Frames, G: SubgoalModel<F>>(
    generator: &G,
    ends: &[Ends<F>],
    shape: (usize, usize),
) -> Result<Vec<Start>> {
    let dimensions = shape.0 * shape.1;
    let prior =
        || Start::from(Initial::Normal { mean: vec![0.0; dimensions], std: vec![1.0; dimensions] });
    let mut proposed = false;
    let mut starts = Vec::with_capacity(ends.len());
    for Ends { start, goal, .. } in ends {
        let Some(found) = generator.proposals(start, goal, shape.0)? else {
            starts.push(prior());
            continue;
        };
        for (name, values) in [("mean", &found.mean), ("std", &found.std)] {
            if values.dim() != shape {
                return Err(Error::Model(format!(
                    "proposals must give a {name} of shape [{}, {}], got {:?}",
                    shape.0,
                    shape.1,
                    values.shape()
                )));
            }
            let wrong = |&&value: &&f32| !value.is_finite() || (name == "std" && value < 0.0);
            if let Some(value) = values.iter().find(wrong) {
                let bound = if name == "std" { "finite and not negative" } else { "finite" };
                return Err(Error::Model(format!(
                    "proposals: {name} must be {bound}, got {value}"
                )));
            }
        }
        let [mean, std] = [found.mean, found.std].map(|values| values.iter().copied().collect());
        starts.push(Start::from(Initial::Normal { mean, std }));
        proposed = true;
    }
    // One start for all is what lets searches share their first samples.
    Ok(if proposed { starts } else { vec![prior()] })
}

#[cfg(test)]
#[path = "proposals_tests.rs"]
mod tests;
