//! Small latent worlds with random weights, for tests.

use ndarray::{Array1, Array4};

use super::{Dynamics, Known, LatentFrames};
use crate::nn::toys::{Draws, GruToy, ResidualToy};

/// Residual dynamics of latents of `latent` numbers with `blocks` blocks.
pub(super) fn mlp(seed: u64, latent: usize, dim: usize, width: usize, blocks: usize) -> Dynamics {
    let mut draws = Draws::new(seed);
    let toy = ResidualToy::new(&mut draws, latent + dim, width, &vec![width; blocks], latent);
    let scale = Array1::from_shape_simple_fn(latent, || draws.between(0.1, 0.4));
    Dynamics::mlp(&toy.weights(), scale.view()).expect("weights that fit")
}

/// Recurrent dynamics.
pub(super) fn gru(seed: u64, latent: usize, dim: usize) -> Dynamics {
    let toy = GruToy::new(&mut Draws::new(seed), dim, latent);
    Dynamics::gru(&toy.weights()).expect("weights that fit")
}

/// `count` frames with latents up to 1 in size and constants.
pub(super) fn frames(
    draws: &mut Draws,
    count: usize,
    latent: usize,
    target: Option<usize>,
) -> LatentFrames {
    let latents = draws.matrix(count, latent, 1.0);
    let targets = target.map(|length| draws.matrix(count, length, 1.0));
    let constants = Array1::from_shape_simple_fn(count, || draws.between(0.0, 2.0));
    let known = Known {
        targets: targets.as_ref().map(|rows| rows.view()),
        constants: Some(constants.view()),
        images: None,
    };
    LatentFrames::new(latents.view(), known).expect("finite numbers")
}

/// Actions up to `limit` in size.
pub(super) fn actions(draws: &mut Draws, shape: [usize; 4], limit: f32) -> Array4<f32> {
    Array4::from_shape_simple_fn(shape, || draws.between(-limit, limit))
}
