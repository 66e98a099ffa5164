//! How a latent moves on by an action.

use multiversion::multiversion;
use ndarray::{Array1, ArrayView1, Axis};

use crate::lanes::{Lanes, LANES};
use crate::nn::{GruCell, GruRoom, GruWeights, ResidualMlp, ResidualRoom, ResidualWeights};
use crate::{Error, Result};

/// A network that moves latents, for blocks of candidates.
#[derive(Clone, Debug)]
pub struct Dynamics(Kind);

#[derive(Clone, Debug)]
enum Kind {
    /// Gives the change of the latent.
    Mlp(ResidualMlp),
    /// The latent is the state of the cell.
    Gru(GruCell),
}

/// Room for one block of candidates.
#[derive(Clone, Debug)]
pub(super) struct Room(Inner);

#[derive(Clone, Debug)]
enum Inner {
    /// The network's inputs, and what its layers give.
    Mlp(Vec<Lanes>, ResidualRoom),
    Gru(GruRoom),
}

impl Dynamics {
    /// `z + scale * network(z, u)`: a network that takes a latent and an action, `Z + A` numbers,
    /// and gives the change of the latent in units of `scale[Z]`. `u` is the action with its box
    /// from -1 to 1.
    ///
    /// # Errors
    /// Weights whose shapes do not fit each other, a scale of another length than the latent's or
    /// than one, no action, or numbers that are not finite.
    pub fn mlp(weights: &ResidualWeights<'_>, scale: ArrayView1<'_, f32>) -> Result<Self> {
        let (latent, inputs) = (weights.output.0.nrows(), weights.input.0.ncols());
        if latent == 0 || inputs <= latent {
            return Err(Error::invalid(
                "input",
                format!(
                    "expected a column for each of Z = {latent} numbers that the last layer gives \
                     and of A action dimensions, got weights {:?}",
                    weights.input.0.shape()
                ),
            ));
        }
        if scale.len() != latent && scale.len() != 1 {
            return Err(Error::invalid(
                "scale",
                format!("expected 1 or {latent} numbers, got {}", scale.len()),
            ));
        }
        if !scale.iter().all(|x| x.is_finite()) {
            return Err(Error::invalid("scale", "must be finite"));
        }
        // Checks the shapes that the scale is multiplied into.
        ResidualMlp::check(weights, inputs, latent)?;
        let scale: Array1<f32> = scale.iter().copied().cycle().take(latent).collect();
        let weight = &weights.output.0 * &scale.view().insert_axis(Axis(1));
        let bias = &weights.output.1 * &scale;
        if !weight.iter().chain(&bias).all(|x| x.is_finite()) {
            return Err(Error::invalid("scale", "makes weights of the output that are not finite"));
        }
        let scaled = ResidualWeights { output: (weight.view(), bias.view()), ..weights.clone() };
        Ok(Self(Kind::Mlp(ResidualMlp::new(&scaled, inputs, latent)?)))
    }

    /// `GRU(u, z)`: a cell whose state is the latent and whose input is the action, with its box
    /// from -1 to 1.
    ///
    /// # Errors
    /// Weights whose shapes do not fit each other, no action, or numbers that are not finite.
    pub fn gru(weights: &GruWeights<'_>) -> Result<Self> {
        let inputs = weights.weight_ih.ncols();
        if inputs == 0 {
            return Err(Error::invalid(
                "weight_ih",
                format!(
                    "must have a column for each action dimension, got {:?}",
                    weights.weight_ih.shape()
                ),
            ));
        }
        Ok(Self(Kind::Gru(GruCell::new(weights, inputs)?)))
    }

    /// Length of a latent, `Z`.
    pub fn latent_dim(&self) -> usize {
        match &self.0 {
            Kind::Mlp(network) => network.outputs(),
            Kind::Gru(cell) => cell.size(),
        }
    }

    /// Action dimensions, `A`.
    pub fn action_dim(&self) -> usize {
        match &self.0 {
            Kind::Mlp(network) => network.inputs() - network.outputs(),
            Kind::Gru(cell) => cell.inputs(),
        }
    }

    /// Multiply-adds that one step of one candidate takes.
    pub fn multiply_adds(&self) -> usize {
        match &self.0 {
            Kind::Mlp(network) => network.multiply_adds(),
            Kind::Gru(cell) => cell.multiply_adds(),
        }
    }

    /// Room for one block.
    pub(super) fn room(&self) -> Room {
        Room(match &self.0 {
            Kind::Mlp(network) => Inner::Mlp(vec![[0.0; LANES]; network.inputs()], network.room()),
            Kind::Gru(cell) => Inner::Gru(cell.room()),
        })
    }

    /// Moves a block of latents `[Z]` by a block of actions `[A]`, scaled to their box.
    pub(super) fn advance(&self, latent: &mut [Lanes], action: &[Lanes], room: &mut Room) {
        advance(self, latent, action, room);
    }
}

#[multiversion(targets("x86_64+avx512f+fma", "x86_64+avx2+fma"))]
fn advance(dynamics: &Dynamics, latent: &mut [Lanes], action: &[Lanes], room: &mut Room) {
    moved(dynamics, latent, action, room);
}

#[inline(always)]
fn moved(dynamics: &Dynamics, latent: &mut [Lanes], action: &[Lanes], room: &mut Room) {
    match (&dynamics.0, &mut room.0) {
        (Kind::Mlp(network), Inner::Mlp(inputs, room)) => {
            let (before, by) = inputs.split_at_mut(latent.len());
            before.copy_from_slice(latent);
            by.copy_from_slice(action);
            let change = network.apply(inputs, room);
            // Flat, or the compiler would gather numbers of several units into a register.
            for (z, change) in latent.as_flattened_mut().iter_mut().zip(change.as_flattened()) {
                *z += change;
            }
        }
        (Kind::Gru(cell), Inner::Gru(room)) => cell.advance(action, latent, room),
        _ => unreachable!("room is made by `Dynamics::room`"),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use ndarray::Array2;

    use super::super::toys::{gru, mlp};
    use super::*;
    use crate::nn::toys::{block, Draws, GruToy, ResidualToy};

    /// As on a processor with AVX2 and nothing wider.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn narrow(dynamics: &Dynamics, latent: &mut [Lanes], action: &[Lanes], room: &mut Room) {
        moved(dynamics, latent, action, room);
    }

    #[test]
    fn every_processor_computes_the_same_bits() {
        let mut draws = Draws::new(5);
        for dynamics in [mlp(1, 12, 2, 40, 2), mlp(2, 7, 3, 13, 0), gru(3, 19, 2)] {
            let before = block(&mut draws, dynamics.latent_dim(), 2.0);
            let action = block(&mut draws, dynamics.action_dim(), 1.0);
            let after = |advance: &dyn Fn(&mut [Lanes], &mut Room)| {
                let (mut latent, mut room) = (before.clone(), dynamics.room());
                (0..4).for_each(|_| advance(&mut latent, &mut room));
                latent
            };
            let widest = after(&|latent, room| advance(&dynamics, latent, &action, room));
            assert_ne!(widest, before);
            assert_eq!(widest, after(&|latent, room| moved(&dynamics, latent, &action, room)));
            #[cfg(target_arch = "x86_64")]
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                let narrow = after(&|latent, room| {
                    // SAFETY: the processor has what the function needs.
                    unsafe { narrow(&dynamics, latent, &action, room) }
                });
                assert_eq!(widest, narrow);
            }
        }
    }

    #[test]
    fn dimensions_are_read_off_the_weights() {
        let dynamics = mlp(1, 12, 2, 40, 2);
        assert_eq!((dynamics.latent_dim(), dynamics.action_dim()), (12, 2));
        assert_eq!(dynamics.multiply_adds(), 14 * 40 + 4 * 40 * 40 + 40 * 12);
        let dynamics = gru(1, 5, 3);
        assert_eq!((dynamics.latent_dim(), dynamics.action_dim()), (5, 3));
        assert_eq!(dynamics.multiply_adds(), 15 * 8);
    }

    #[test]
    fn weights_that_make_no_dynamics_are_refused_by_name() {
        let mut draws = Draws::new(1);
        let said = |made: Result<Dynamics>| made.unwrap_err().to_string();
        let toy = ResidualToy::new(&mut draws, 6, 8, &[], 4);
        let scale = |numbers: &[f32]| {
            said(Dynamics::mlp(&toy.weights(), Array1::from(numbers.to_vec()).view()))
        };
        assert!(scale(&[1.0; 3]).starts_with("scale: expected 1 or 4 numbers, got 3"));
        assert!(scale(&[]).starts_with("scale: "));
        assert!(scale(&[f32::INFINITY]).starts_with("scale: must be finite"));
        let still = ResidualToy::new(&mut draws, 4, 8, &[], 4);
        let one = Array1::ones(1);
        assert!(said(Dynamics::mlp(&still.weights(), one.view())).starts_with("input: "));
        let gru = GruToy::new(&mut draws, 1, 4);
        let none = Array2::zeros((12, 0));
        let weights = GruWeights { weight_ih: none.view(), ..gru.weights() };
        assert!(said(Dynamics::gru(&weights)).starts_with("weight_ih: "));
    }
}
