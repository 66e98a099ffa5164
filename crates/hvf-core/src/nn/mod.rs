//! Small networks for blocks of [`LANES`] inputs at once.
//!
//! A network keeps its weights packed for blocks, is given a block of inputs lane by lane and room
//! for what its layers give, and allocates nothing. Every lane is worked on by itself, sums run in
//! a fixed order and every multiply-add is a fused one: an output has the same bits whatever is in
//! the other lanes, on any number of threads and on every machine.
//!
//! What is not a number goes through as such: [`ResidualMlp`] and [`GruCell`] give NaN for it, as
//! torch does; the rectified units of an [`Mlp`] make it zero.

mod activation;
mod gru;
mod mlp;
mod residual;

use ndarray::{ArrayView1, ArrayView2};

pub use activation::Activation;
pub use gru::{GruCell, GruRoom, GruWeights};
pub use mlp::{Mlp, MlpRoom};
pub use residual::{ResidualMlp, ResidualRoom, ResidualWeights};

pub use crate::lanes::{Lanes, LANES};
use crate::{Error, Result};

/// Weights `[outputs, inputs]` and bias `[outputs]` of a layer, as `torch.nn.Linear` stores them.
pub type Linear<'a> = (ArrayView2<'a, f32>, ArrayView1<'a, f32>);

/// Checks a layer that takes `inputs` numbers and gives `outputs` (`None`: any number, at least
/// one); returns how many it gives. Errors are about `argument`, and say `place` within it.
fn check(
    argument: &'static str,
    place: &str,
    (weights, bias): &Linear<'_>,
    inputs: usize,
    outputs: Option<usize>,
) -> Result<usize> {
    let (rows, columns) = weights.dim();
    if columns != inputs || rows == 0 || outputs.is_some_and(|outputs| outputs != rows) {
        let expected = outputs.map_or("hidden".into(), |outputs| outputs.to_string());
        return Err(Error::invalid(
            argument,
            format!("{place}expected weights [{expected}, {inputs}], got {:?}", weights.shape()),
        ));
    }
    if bias.len() != rows {
        return Err(Error::invalid(
            argument,
            format!("{place}expected a bias [{rows}], got {:?}", bias.shape()),
        ));
    }
    if !weights.iter().chain(bias).all(|x| x.is_finite()) {
        return Err(Error::invalid(argument, format!("{place}weights must be finite")));
    }
    Ok(rows)
}

#[cfg(test)]
pub(crate) mod toys;
