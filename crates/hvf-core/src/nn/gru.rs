//! A gated recurrent unit (Cho et al. 2014), as `torch.nn.GRUCell` defines it.

use ndarray::{ArrayView1, ArrayView2};

use super::activation::{sigmoid, tanh};
use super::check;
use crate::lanes::{Lanes, Layer};
use crate::{Error, Result};

/// Weights of a [`GruCell`], named and laid out as `torch.nn.GRUCell` does: the rows of the reset
/// gate, the update gate and the new state, `Z` each.
#[derive(Clone, Copy, Debug)]
pub struct GruWeights<'a> {
    /// For the input, `[3 Z, inputs]`.
    pub weight_ih: ArrayView2<'a, f32>,
    /// For the state, `[3 Z, Z]`.
    pub weight_hh: ArrayView2<'a, f32>,
    /// `[3 Z]`.
    pub bias_ih: ArrayView1<'a, f32>,
    /// `[3 Z]`.
    pub bias_hh: ArrayView1<'a, f32>,
}

/// `r = sigmoid(W_r x + U_r h)`, `z = sigmoid(W_z x + U_z h)`, `n = tanh(W_n x + r (U_n h))` (each
/// product with its bias), then `h = (1 - z) n + z h`.
#[derive(Clone, Debug)]
pub struct GruCell {
    inputs: usize,
    size: usize,
    multiply_adds: usize,
    input: Layer,
    state: Layer,
}

/// Room for the gates of a [`GruCell`], one block of lanes.
#[derive(Clone, Debug)]
pub struct GruRoom {
    input: Vec<Lanes>,
    state: Vec<Lanes>,
}

impl GruCell {
    /// Packs `weights` of a cell that takes `inputs` numbers.
    ///
    /// # Errors
    /// Shapes that do not fit each other, or weights that are not finite; the error names the field
    /// of [`GruWeights`].
    pub fn new(weights: &GruWeights<'_>, inputs: usize) -> Result<Self> {
        let GruWeights { weight_ih, weight_hh, bias_ih, bias_hh } = *weights;
        let size = weight_hh.ncols();
        if size == 0 {
            return Err(Error::invalid(
                "weight_hh",
                format!("expected shape [3 Z, Z], got {:?}", weight_hh.shape()),
            ));
        }
        for (argument, bias) in [("bias_ih", bias_ih), ("bias_hh", bias_hh)] {
            if bias.len() != 3 * size || !bias.iter().all(|x| x.is_finite()) {
                return Err(Error::invalid(
                    argument,
                    format!("expected {} finite numbers, got shape {:?}", 3 * size, bias.shape()),
                ));
            }
        }
        check("weight_hh", "", &(weight_hh, bias_hh), size, Some(3 * size))?;
        check("weight_ih", "", &(weight_ih, bias_ih), inputs, Some(3 * size))?;
        Ok(Self {
            inputs,
            size,
            multiply_adds: weight_ih.len() + weight_hh.len(),
            input: Layer::new(weight_ih, bias_ih),
            state: Layer::new(weight_hh, bias_hh),
        })
    }

    /// Numbers that it takes.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Length of its state, `Z`.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Multiply-adds that one input takes.
    pub fn multiply_adds(&self) -> usize {
        self.multiply_adds
    }

    /// Room for one block of lanes.
    pub fn room(&self) -> GruRoom {
        GruRoom { input: self.input.room(), state: self.state.room() }
    }

    /// Moves a block of states by a block of `inputs`.
    ///
    /// # Panics
    /// If `inputs` or `state` have another length than the cell's, or `room` is another cell's.
    #[inline(always)]
    pub fn advance(&self, inputs: &[Lanes], state: &mut [Lanes], room: &mut GruRoom) {
        assert_eq!(inputs.len(), self.inputs, "as many inputs as the cell takes");
        assert_eq!(state.len(), self.size, "a state of the cell's size");
        let input = self.input.apply(inputs, false, &mut room.input);
        let before = self.state.apply(state, false, &mut room.state);
        let gate = |number: usize| {
            let units = number * self.size..(number + 1) * self.size;
            (input[units.clone()].as_flattened(), before[units].as_flattened())
        };
        let [reset, update, new] = [gate(0), gate(1), gate(2)];
        // Flat, or the compiler would gather numbers of several units into a register.
        for (i, h) in state.as_flattened_mut().iter_mut().enumerate() {
            let reset = sigmoid(reset.0[i] + reset.1[i]);
            let update = sigmoid(update.0[i] + update.1[i]);
            let candidate = tanh(reset.mul_add(new.1[i], new.0[i]));
            *h = update.mul_add(*h - candidate, candidate);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::toys::{block, lane, Draws, GruToy};
    use super::*;
    use crate::lanes::LANES;

    #[test]
    fn the_cell_is_its_formula() {
        let mut draws = Draws::new(1);
        for (inputs, size) in [(1, 1), (3, 7), (2, 24)] {
            let toy = GruToy::new(&mut draws, inputs, size);
            let cell = GruCell::new(&toy.weights(), inputs).unwrap();
            let x = block(&mut draws, inputs, 2.0);
            let before = block(&mut draws, size, 1.0);
            let mut state = before.clone();
            cell.advance(&x, &mut state, &mut cell.room());
            for l in 0..LANES {
                let expected = toy.slow(&lane(&x, l), &lane(&before, l));
                for (found, expected) in state.iter().zip(&expected) {
                    assert!((f64::from(found[l]) - expected).abs() < 3e-6);
                }
            }
        }
    }

    #[test]
    fn weights_that_do_not_fit_are_refused_by_name() {
        let mut draws = Draws::new(2);
        let toy = GruToy::new(&mut draws, 2, 4);
        let other = GruToy::new(&mut draws, 3, 5);
        let (good, bad) = (toy.weights(), other.weights());
        let refused = |weights: &GruWeights<'_>, argument: &str| {
            let said = GruCell::new(weights, 2).unwrap_err().to_string();
            assert!(said.starts_with(&format!("{argument}: ")), "{said}");
        };
        assert!(GruCell::new(&good, 2).is_ok());
        refused(&GruWeights { weight_ih: bad.weight_ih, ..good }, "weight_ih");
        refused(&GruWeights { bias_ih: bad.bias_ih, ..good }, "bias_ih");
        refused(&GruWeights { bias_hh: bad.bias_hh, ..good }, "bias_hh");
        refused(&GruWeights { weight_hh: good.weight_ih, ..good }, "bias_ih");
        let empty = ndarray::Array2::zeros((0, 0));
        refused(&GruWeights { weight_hh: empty.view(), ..good }, "weight_hh");
        let nan = ndarray::Array2::from_elem((12, 4), f32::NAN);
        refused(&GruWeights { weight_hh: nan.view(), ..good }, "weight_hh");
    }
}
