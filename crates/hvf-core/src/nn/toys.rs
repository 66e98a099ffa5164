//! Random networks and their slow twins in float64, for tests.

use ndarray::{s, Array1, Array2};

use super::{Activation, GruWeights, Linear, ResidualWeights};
use crate::lanes::{Lanes, LANES};

/// A small generator of numbers.
pub(crate) struct Draws(u64);

impl Draws {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(1))
    }

    pub(crate) fn between(&mut self, low: f32, high: f32) -> f32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        low + (high - low) * ((self.0 >> 40) as f32 / (1_u64 << 24) as f32)
    }

    pub(crate) fn matrix(&mut self, rows: usize, columns: usize, scale: f32) -> Array2<f32> {
        Array2::from_shape_simple_fn((rows, columns), || self.between(-scale, scale))
    }

    /// Weights of the size that keeps what goes through them, and a bias.
    pub(crate) fn layer(&mut self, rows: usize, columns: usize) -> Layer {
        let weights = self.matrix(rows, columns, (3.0 / columns as f32).sqrt());
        (weights, Array1::from_shape_simple_fn(rows, || self.between(-0.3, 0.3)))
    }
}

pub(crate) type Layer = (Array2<f32>, Array1<f32>);

fn view(layer: &Layer) -> Linear<'_> {
    (layer.0.view(), layer.1.view())
}

fn linear((weights, bias): &Layer, x: &Array1<f64>) -> Array1<f64> {
    weights.mapv(f64::from).dot(x) + bias.mapv(f64::from)
}

/// `rows` lanes of numbers up to `scale`.
pub(crate) fn block(draws: &mut Draws, rows: usize, scale: f32) -> Vec<Lanes> {
    (0..rows).map(|_| std::array::from_fn(|_| draws.between(-scale, scale))).collect()
}

/// One lane of a block.
pub(crate) fn lane(block: &[Lanes], lane: usize) -> Array1<f64> {
    block.iter().map(|lanes| f64::from(lanes[lane])).collect()
}

const _: () = assert!(LANES > 7, "tests look at lane 7");

/// Weights of a `ResidualMlp`.
#[derive(Clone)]
pub(crate) struct ResidualToy {
    pub(crate) input: Layer,
    pub(crate) activation: Activation,
    pub(crate) blocks: Vec<[Layer; 2]>,
    pub(crate) output: Layer,
}

impl ResidualToy {
    pub(crate) fn new(
        draws: &mut Draws,
        inputs: usize,
        width: usize,
        blocks: &[usize],
        outputs: usize,
    ) -> Self {
        Self {
            input: draws.layer(width, inputs),
            activation: Activation::Relu,
            blocks: blocks
                .iter()
                .map(|&inside| [draws.layer(inside, width), draws.layer(width, inside)])
                .collect(),
            output: draws.layer(outputs, width),
        }
    }

    pub(crate) fn weights(&self) -> ResidualWeights<'_> {
        ResidualWeights {
            input: view(&self.input),
            activation: self.activation,
            blocks: self.blocks.iter().map(|block| block.each_ref().map(view)).collect(),
            output: view(&self.output),
        }
    }

    pub(crate) fn slow(&self, x: &Array1<f64>) -> Array1<f64> {
        let relu: fn(f64) -> f64 = |x| x.max(0.0);
        let mut hidden = linear(&self.input, x).mapv(match self.activation {
            Activation::Relu => relu,
            Activation::Sin => f64::sin,
        });
        for [first, second] in &self.blocks {
            let inside = linear(first, &hidden).mapv(relu);
            hidden = (&hidden + linear(second, &inside)).mapv(relu);
        }
        linear(&self.output, &hidden)
    }
}

/// Weights of a `GruCell`.
pub(crate) struct GruToy {
    input: Layer,
    state: Layer,
}

impl GruToy {
    pub(crate) fn new(draws: &mut Draws, inputs: usize, size: usize) -> Self {
        Self { input: draws.layer(3 * size, inputs), state: draws.layer(3 * size, size) }
    }

    pub(crate) fn weights(&self) -> GruWeights<'_> {
        GruWeights {
            weight_ih: self.input.0.view(),
            weight_hh: self.state.0.view(),
            bias_ih: self.input.1.view(),
            bias_hh: self.state.1.view(),
        }
    }

    pub(crate) fn slow(&self, x: &Array1<f64>, h: &Array1<f64>) -> Array1<f64> {
        let size = h.len();
        let (input, state) = (linear(&self.input, x), linear(&self.state, h));
        let gate =
            |gates: &Array1<f64>, g: usize| gates.slice(s![g * size..(g + 1) * size]).to_owned();
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        let reset = (gate(&input, 0) + gate(&state, 0)).mapv(sigmoid);
        let update = (gate(&input, 1) + gate(&state, 1)).mapv(sigmoid);
        let new = (gate(&input, 2) + reset * gate(&state, 2)).mapv(f64::tanh);
        update.mapv(|z| 1.0 - z) * new + update * h
    }
}
