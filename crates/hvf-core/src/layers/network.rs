//! A few linear layers with rectified units between them, for blocks of inputs.

use crate::lanes::{Lanes, Layer};
pub use crate::nn::Linear;
use crate::{Error, Result};

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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::toys::{layers, views, Draws};
    use super::*;
    use crate::lanes::LANES;

    #[test]
    fn a_network_is_its_layers_one_after_the_other() {
        let mut draws = Draws::new(1);
        let made = layers(&mut draws, &[5, 7, 6, 3]);
        let network = Network::new("hand", &views(&made), 5, 3).unwrap();
        let inputs: Vec<Lanes> =
            (0..5).map(|_| std::array::from_fn(|_| draws.between(-2.0, 2.0))).collect();
        let mut room = network.room();
        let found = network.apply(&inputs, &mut room);
        assert_eq!(found.len(), 3);
        for lane in 0..LANES {
            let mut x: ndarray::Array1<f32> = inputs.iter().map(|input| input[lane]).collect();
            for (number, (weights, bias)) in made.iter().enumerate() {
                x = weights.dot(&x) + bias;
                if number < 2 {
                    x.mapv_inplace(|x| x.max(0.0));
                }
            }
            for (found, expected) in found.iter().zip(&x) {
                assert!((found[lane] - expected).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn layers_that_do_not_fit_are_refused() {
        let mut draws = Draws::new(1);
        let mut made = layers(&mut draws, &[5, 7, 3]);
        let refused = |layers: &[Linear<'_>], inputs, outputs| {
            let said = Network::new("hand", layers, inputs, outputs).unwrap_err().to_string();
            assert!(said.starts_with("hand: "), "{said}");
        };
        refused(&views(&made), 4, 3);
        refused(&views(&made), 5, 2);
        refused(&views(&made)[1..], 5, 3);
        refused(&[], 5, 3);
        made[0].1 = ndarray::Array1::zeros(6);
        refused(&views(&made), 5, 3);
        made[0].1 = ndarray::Array1::from_elem(7, f32::NAN);
        refused(&views(&made), 5, 3);
    }
}
