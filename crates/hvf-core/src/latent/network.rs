//! How a latent moves on by an action.

use multiversion::multiversion;
use ndarray::ArrayView1;

use crate::lanes::{Lanes, LANES};
use crate::nn::{GruCell, GruRoom, GruWeights, ResidualMlp, ResidualRoom, ResidualWeights};
use crate::{Error, Result};

/// A network that moves latents, for blocks of candidates.
#[derive(Clone, Debug)]
pub struct Dynamics(Kind);

#[derive(Clone, Debug)]
enum Kind {
    /// The change of the latent, and what each of its numbers is multiplied by.
    Mlp(ResidualMlp, Vec<f32>),
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
        let network = ResidualMlp::new(weights, inputs, latent)?;
        let scale = scale.iter().copied().cycle().take(latent).collect();
        Ok(Self(Kind::Mlp(network, scale)))
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
            Kind::Mlp(network, _) => network.outputs(),
            Kind::Gru(cell) => cell.size(),
        }
    }

    /// Action dimensions, `A`.
    pub fn action_dim(&self) -> usize {
        match &self.0 {
            Kind::Mlp(network, _) => network.inputs() - network.outputs(),
            Kind::Gru(cell) => cell.inputs(),
        }
    }

    /// Multiply-adds that one step of one candidate takes.
    pub fn multiply_adds(&self) -> usize {
        match &self.0 {
            Kind::Mlp(network, _) => network.multiply_adds(),
            Kind::Gru(cell) => cell.multiply_adds(),
        }
    }

    /// Room for one block.
    pub(super) fn room(&self) -> Room {
        Room(match &self.0 {
            Kind::Mlp(network, _) => {
                Inner::Mlp(vec![[0.0; LANES]; network.inputs()], network.room())
            }
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
        (Kind::Mlp(network, scale), Inner::Mlp(inputs, room)) => {
            let (before, by) = inputs.split_at_mut(latent.len());
            before.copy_from_slice(latent);
            by.copy_from_slice(action);
            let change = network.apply(inputs, room);
            for ((latent, change), scale) in latent.iter_mut().zip(change).zip(scale) {
                for lane in 0..LANES {
                    latent[lane] = scale.mul_add(change[lane], latent[lane]);
                }
            }
        }
        (Kind::Gru(cell), Inner::Gru(room)) => cell.advance(action, latent, room),
        _ => unreachable!("room is made by `Dynamics::room`"),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use ndarray::{Array1, Array2};

    use super::super::toys::{gru, mlp};
    use super::*;
    use crate::nn::toys::{block, Draws, GruToy, ResidualToy};

    #[test]
    fn a_processor_without_vectors_computes_the_same_bits() {
        let mut draws = Draws::new(5);
        for dynamics in [mlp(1, 12, 2, 40, 2), mlp(2, 7, 3, 13, 0), gru(3, 19, 2)] {
            let before = block(&mut draws, dynamics.latent_dim(), 2.0);
            let action = block(&mut draws, dynamics.action_dim(), 1.0);
            let (mut one, mut other) = (before.clone(), before.clone());
            let (mut fast, mut slow) = (dynamics.room(), dynamics.room());
            for _ in 0..4 {
                advance(&dynamics, &mut one, &action, &mut fast);
                moved(&dynamics, &mut other, &action, &mut slow);
                assert_eq!(one, other);
            }
            assert_ne!(one, before);
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
