//! A few linear layers with rectified units between them.

use super::{check, Linear};
use crate::lanes::{Lanes, Layer};
use crate::{Error, Result};

/// Linear layers, each but the last followed by rectified units.
#[derive(Clone, Debug)]
pub struct Mlp {
    layers: Vec<Layer>,
}

/// Room for what the layers of a network give, one block.
#[derive(Clone, Debug)]
pub struct MlpRoom(Vec<Vec<Lanes>>);

impl Mlp {
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
        for (number, layer) in layers.iter().enumerate() {
            let gives = (number + 1 == layers.len()).then_some(outputs);
            expected = check(argument, &format!("layer {number}: "), layer, expected, gives)?;
        }
        if layers.is_empty() {
            return Err(Error::invalid(argument, "must have at least one layer"));
        }
        let pack = |(weights, bias): &Linear<'_>| Layer::new(*weights, *bias);
        Ok(Self { layers: layers.iter().map(pack).collect() })
    }

    /// Room for one block.
    pub fn room(&self) -> MlpRoom {
        MlpRoom(self.layers.iter().map(Layer::room).collect())
    }

    /// What the network makes of a block of `inputs`.
    #[inline(always)]
    pub fn apply<'r>(&self, inputs: &[Lanes], room: &'r mut MlpRoom) -> &'r [Lanes] {
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
    use super::*;
    use crate::lanes::LANES;
    use crate::nn::toys::{self, Draws};

    fn layers(draws: &mut Draws, sizes: &[usize]) -> Vec<toys::Layer> {
        sizes.windows(2).map(|pair| draws.layer(pair[1], pair[0])).collect()
    }

    fn views(layers: &[toys::Layer]) -> Vec<Linear<'_>> {
        layers.iter().map(|(weights, bias)| (weights.view(), bias.view())).collect()
    }

    #[test]
    fn a_network_is_its_layers_one_after_the_other() {
        let mut draws = Draws::new(1);
        let made = layers(&mut draws, &[5, 7, 6, 3]);
        let network = Mlp::new("hand", &views(&made), 5, 3).unwrap();
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
            let said = Mlp::new("hand", layers, inputs, outputs).unwrap_err().to_string();
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
