//! A few linear layers with rectified units between them, for blocks of inputs.

use ndarray::{ArrayView1, ArrayView2};

use crate::lanes::{Lanes, Layer};
use crate::{Error, Result};

/// Weights `[outputs, inputs]` and bias `[outputs]` of a layer, as `torch.nn.Linear` stores them.
pub type Linear<'a> = (ArrayView2<'a, f32>, ArrayView1<'a, f32>);

/// Linear layers, each but the last followed by rectified units.
#[derive(Clone, Debug)]
pub struct Network {
    layers: Vec<Layer>,
}

/// Room for what the layers of a network give, one block.
#[derive(Clone, Debug)]
pub struct Room(Vec<Vec<Lanes>>);

impl Network {
    /// Packs `layers`, which take `inputs` numbers and give `outputs`.
    ///
    /// # Errors
    /// No layer, shapes that do not fit each other, or weights that are not finite; the error calls
    /// the network `argument`.
    pub fn new(
        argument: &'static str,
        layers: &[Linear<'_>],
        inputs: usize,
        outputs: usize,
    ) -> Result<Self> {
        let mut expected = inputs;
        for (number, (weights, bias)) in layers.iter().enumerate() {
            let (rows, columns) = weights.dim();
            let last = number + 1 == layers.len();
            if columns != expected || rows == 0 || (last && rows != outputs) {
                let rows = if last { outputs.to_string() } else { "hidden".into() };
                return Err(Error::invalid(
                    argument,
                    format!(
                        "layer {number}: expected weights [{rows}, {expected}], got {:?}",
                        weights.shape()
                    ),
                ));
            }
            if bias.len() != rows {
                return Err(Error::invalid(
                    argument,
                    format!("layer {number}: expected a bias [{rows}], got {:?}", bias.shape()),
                ));
            }
            if !weights.iter().chain(bias).all(|x| x.is_finite()) {
                return Err(Error::invalid(
                    argument,
                    format!("layer {number}: weights must be finite"),
                ));
            }
            expected = rows;
        }
        if layers.is_empty() {
            return Err(Error::invalid(argument, "must have at least one layer"));
        }
        let pack = |(weights, bias): &Linear<'_>| Layer::new(*weights, *bias);
        Ok(Self { layers: layers.iter().map(pack).collect() })
    }

    /// Room for one block.
    pub fn room(&self) -> Room {
        Room(self.layers.iter().map(Layer::room).collect())
    }

    /// What the network makes of a block of `inputs`.
    #[inline(always)]
    pub fn apply<'r>(&self, inputs: &[Lanes], room: &'r mut Room) -> &'r [Lanes] {
        let mut before: &[Lanes] = &[];
        let last = self.layers.len() - 1;
        for (number, (layer, out)) in self.layers.iter().zip(&mut room.0).enumerate() {
            let inputs = if number == 0 { inputs } else { before };
            before = layer.apply(inputs, number < last, out);
        }
        before
    }
}
