//! A multilayer perceptron with residual blocks.

use super::activation::rectified;
use super::{check, Activation, Linear};
use crate::lanes::{Lanes, Layer};
use crate::Result;

/// Weights of a [`ResidualMlp`].
#[derive(Clone, Debug)]
pub struct ResidualWeights<'a> {
    /// First layer, `[W, inputs]`.
    pub input: Linear<'a>,
    /// What follows it; all other hidden units are rectified.
    pub activation: Activation,
    /// Two layers for each block, `[V, W]` and `[W, V]`; `V` may differ from block to block.
    pub blocks: Vec<[Linear<'a>; 2]>,
    /// Last layer, `[outputs, W]`.
    pub output: Linear<'a>,
}

/// `h = activation(input(x))`, then `h = relu(h + second(relu(first(h))))` for every block, then
/// `output(h)`.
#[derive(Clone, Debug)]
pub struct ResidualMlp {
    inputs: usize,
    outputs: usize,
    multiply_adds: usize,
    input: Layer,
    activation: Activation,
    blocks: Vec<[Layer; 2]>,
    output: Layer,
}

/// Room for what the layers of a [`ResidualMlp`] give, one block of lanes.
#[derive(Clone, Debug)]
pub struct ResidualRoom {
    /// `h`.
    hidden: Vec<Lanes>,
    /// What the layers of each block give.
    blocks: Vec<[Vec<Lanes>; 2]>,
    output: Vec<Lanes>,
}

impl ResidualMlp {
    /// Checks `weights` of a network that takes `inputs` numbers and gives `outputs`.
    ///
    /// # Errors
    /// Shapes that do not fit each other, or weights that are not finite; the error names the field
    /// of [`ResidualWeights`].
    pub fn check(weights: &ResidualWeights<'_>, inputs: usize, outputs: usize) -> Result<()> {
        let width = check("input", "", &weights.input, inputs, None)?;
        for (number, [first, second]) in weights.blocks.iter().enumerate() {
            let place = |layer| format!("block {number}, layer {layer}: ");
            let inside = check("blocks", &place(0), first, width, None)?;
            check("blocks", &place(1), second, inside, Some(width))?;
        }
        check("output", "", &weights.output, width, Some(outputs))?;
        Ok(())
    }

    /// Packs `weights` of a network that takes `inputs` numbers and gives `outputs`.
    ///
    /// # Errors
    /// As [`check`](Self::check).
    pub fn new(weights: &ResidualWeights<'_>, inputs: usize, outputs: usize) -> Result<Self> {
        Self::check(weights, inputs, outputs)?;
        let pack = |(weights, bias): &Linear<'_>| Layer::new(*weights, *bias);
        let layers = weights.blocks.iter().flatten().chain([&weights.input, &weights.output]);
        Ok(Self {
            inputs,
            outputs,
            multiply_adds: layers.map(|(weights, _)| weights.len()).sum(),
            input: pack(&weights.input),
            activation: weights.activation,
            blocks: weights.blocks.iter().map(|block| block.each_ref().map(pack)).collect(),
            output: pack(&weights.output),
        })
    }

    /// Numbers that it takes.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Numbers that it gives.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Multiply-adds that one input takes.
    pub fn multiply_adds(&self) -> usize {
        self.multiply_adds
    }

    /// Room for one block of lanes.
    pub fn room(&self) -> ResidualRoom {
        ResidualRoom {
            hidden: self.input.room(),
            blocks: self.blocks.iter().map(|block| block.each_ref().map(Layer::room)).collect(),
            output: self.output.room(),
        }
    }

    /// What the network makes of a block of `inputs`, one for each lane.
    ///
    /// # Panics
    /// If `inputs` are not as many as it takes, or `room` is that of another network.
    #[inline(always)]
    pub fn apply<'r>(&self, inputs: &[Lanes], room: &'r mut ResidualRoom) -> &'r [Lanes] {
        assert_eq!(inputs.len(), self.inputs, "as many inputs as the network takes");
        let width = self.input.apply(inputs, false, &mut room.hidden).len();
        let hidden = &mut room.hidden[..width];
        self.activation.apply(hidden);
        for ([first, second], [inside, change]) in self.blocks.iter().zip(&mut room.blocks) {
            let inner = first.apply(hidden, false, inside).len();
            Activation::Relu.apply(&mut inside[..inner]);
            let change = second.apply(&inside[..inner], false, change);
            // Flat, or the compiler would gather numbers of several units into a register.
            let change = change.as_flattened();
            for (hidden, change) in hidden.as_flattened_mut().iter_mut().zip(change) {
                *hidden = rectified(*hidden + change);
            }
        }
        self.output.apply(hidden, false, &mut room.output)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::toys::{block, lane, Draws, ResidualToy};
    use super::*;
    use crate::lanes::LANES;

    #[test]
    fn the_network_is_its_formula() {
        let mut draws = Draws::new(1);
        for (blocks, activation) in [
            (vec![], Activation::Relu),
            (vec![], Activation::Sin),
            (vec![9], Activation::Relu),
            (vec![5, 16, 7], Activation::Sin),
        ] {
            let mut toy = ResidualToy::new(&mut draws, 6, 10, &blocks, 3);
            toy.activation = activation;
            let network = ResidualMlp::new(&toy.weights(), 6, 3).unwrap();
            let inputs = block(&mut draws, 6, 2.0);
            let mut room = network.room();
            let found = network.apply(&inputs, &mut room);
            for l in 0..LANES {
                let expected = toy.slow(&lane(&inputs, l));
                for (found, expected) in found.iter().zip(&expected) {
                    assert!((f64::from(found[l]) - expected).abs() < 1e-5 * (1.0 + expected.abs()));
                }
            }
        }
    }

    #[test]
    fn what_is_not_a_number_stays_in_its_lane() {
        let mut draws = Draws::new(2);
        let toy = ResidualToy::new(&mut draws, 4, 8, &[8], 5);
        let network = ResidualMlp::new(&toy.weights(), 4, 5).unwrap();
        let mut inputs = block(&mut draws, 4, 1.0);
        let clean = network.apply(&inputs, &mut network.room()).to_vec();
        inputs[2][7] = f32::NAN;
        let mut room = network.room();
        for (found, clean) in network.apply(&inputs, &mut room).iter().zip(&clean) {
            for lane in 0..LANES {
                assert!(if lane == 7 { found[lane].is_nan() } else { found[lane] == clean[lane] });
            }
        }
    }

    #[test]
    fn weights_that_do_not_fit_are_refused_by_name() {
        let mut draws = Draws::new(3);
        let toy = ResidualToy::new(&mut draws, 4, 8, &[6], 5);
        let refused = |weights: &ResidualWeights<'_>, start: &str| {
            let said = ResidualMlp::new(weights, 4, 5).unwrap_err().to_string();
            assert!(said.starts_with(start), "{said}");
        };
        let good = toy.weights();
        assert!(ResidualMlp::new(&good, 4, 5).is_ok());
        refused(&ResidualWeights { input: good.output, ..good.clone() }, "input: expected weights");
        refused(&ResidualWeights { output: good.input, ..good.clone() }, "output: expected");
        let swapped = vec![[good.blocks[0][1], good.blocks[0][0]]];
        refused(&ResidualWeights { blocks: swapped, ..good.clone() }, "blocks: block 0, layer 0: ");
        let twice = vec![[good.blocks[0][0]; 2]];
        refused(&ResidualWeights { blocks: twice, ..good.clone() }, "blocks: block 0, layer 1: ");
        let short = (good.input.0, good.output.1);
        refused(&ResidualWeights { input: short, ..good.clone() }, "input: expected a bias [8]");
        let mut bad = toy.clone();
        bad.output.0[[1, 1]] = f32::NAN;
        refused(&bad.weights(), "output: weights must be finite");
        let none = ndarray::Array2::zeros((0, 4));
        let bias = ndarray::Array1::zeros(0);
        refused(&ResidualWeights { input: (none.view(), bias.view()), ..good }, "input: expected");
    }
}
