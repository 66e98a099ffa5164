//! How far a latent is from a goal's.

use multiversion::multiversion;
use ndarray::{Array1, ArrayView1, ArrayView2};

use super::frames::LatentFrames;
use super::gram;
use crate::lanes::{Lanes, Layer, LANES};
use crate::nn::{ResidualMlp, ResidualRoom, ResidualWeights};
use crate::planner::Frames;
use crate::{Error, Result};

/// Goals whose distances are summed at once.
const GOALS: usize = 4;

/// What is compared of latents.
#[derive(Clone, Debug)]
pub enum Readout<'a> {
    /// The latents themselves, `P = Z`.
    Latent,
    /// What a matrix `[P, Z]` makes of them.
    Matrix(ArrayView2<'a, f32>),
    /// What a network makes of them: `Z` numbers to `P`.
    Network(ResidualWeights<'a>),
}

/// A squared distance of read-outs, `sum w (read(z) - t)^2`, as a plain one of points `[Q]`.
///
/// A network's points are its read-outs, each times the root of its weight. A matrix `R` is put in
/// the place of a smaller one, `U[Q, Z]` with `|U z| = |R z|` for every `z`: a factor of its Gram
/// matrix by Cholesky's method with pivots. `Q`, the rank of `R`, is at most `Z` however many rows
/// `R` has, and no distance is negative.
///
/// A goal becomes a point once for all candidates, and a candidate once for all goals.
#[derive(Clone, Debug)]
pub struct LatentCost {
    latent_dim: usize,
    point_dim: usize,
    reader: Reader,
    /// What each number of a point is multiplied by.
    factors: Option<Vec<f32>>,
}

#[derive(Clone, Debug)]
enum Reader {
    Latent,
    Matrix(Layer),
    Network(ResidualMlp),
}

/// Room for the points of one block.
#[derive(Clone, Debug)]
pub(super) struct Room {
    reader: ReaderRoom,
    scaled: Vec<Lanes>,
}

#[derive(Clone, Debug)]
enum ReaderRoom {
    Latent,
    Matrix(Vec<Lanes>),
    Network(ResidualRoom),
}

/// Points of goals, [`GOALS`] together: `[goals / GOALS][Q][GOALS]`, zeros beyond the last; and
/// their constants.
#[derive(Debug)]
pub(super) struct Points {
    values: Vec<[f32; GOALS]>,
    constants: Vec<f32>,
    length: usize,
}

fn shaped(argument: &'static str, fits: bool, expected: String, found: &[usize]) -> Result<()> {
    match fits {
        true => Ok(()),
        false => Err(Error::invalid(argument, format!("expected shape {expected}, got {found:?}"))),
    }
}

/// Roots of `weights[P]`.
fn roots(weights: ArrayView1<'_, f32>, length: usize) -> Result<Vec<f32>> {
    shaped("weights", weights.len() == length, format!("[{length}]"), weights.shape())?;
    if weights.iter().any(|w| !w.is_finite() || *w < 0.0) {
        return Err(Error::invalid("weights", "must be finite and not negative"));
    }
    if weights.iter().all(|w| *w == 0.0) {
        return Err(Error::invalid("weights", "must not all be zero"));
    }
    Ok(weights.iter().map(|w| w.sqrt()).collect())
}

impl LatentCost {
    /// The distance of what `readout` makes of latents of `latent_dim` numbers, with a weight for
    /// each of its numbers (one if not given).
    ///
    /// # Errors
    /// A read-out for latents of another length, weights of another length, numbers that are not
    /// finite, negative weights, or nothing but zeros.
    pub fn new(
        latent_dim: usize,
        readout: &Readout<'_>,
        weights: Option<ArrayView1<'_, f32>>,
    ) -> Result<Self> {
        let factors = |length| weights.map(|weights| roots(weights, length)).transpose();
        let (point_dim, reader, factors) = match readout {
            Readout::Latent => (latent_dim, Reader::Latent, factors(latent_dim)?),
            Readout::Network(weights) => {
                let outputs = weights.output.0.nrows();
                let network = ResidualMlp::new(weights, latent_dim, outputs)
                    .map_err(|error| Error::invalid("readout", error.to_string()))?;
                (outputs, Reader::Network(network), factors(outputs)?)
            }
            Readout::Matrix(matrix) => {
                let (rows, columns) = matrix.dim();
                let fits = columns == latent_dim && rows > 0;
                shaped("readout", fits, format!("[P, {latent_dim}]"), matrix.shape())?;
                if matrix.iter().any(|x| !x.is_finite()) {
                    return Err(Error::invalid("readout", "must be finite"));
                }
                let mut weighted = matrix.mapv(f64::from);
                if let Some(factors) = factors(rows)? {
                    for (mut row, factor) in weighted.rows_mut().into_iter().zip(factors) {
                        row *= f64::from(factor);
                    }
                }
                let factor = gram::factor(weighted.view());
                let rank = factor.nrows();
                if rank == 0 {
                    return Err(Error::invalid("readout", "must not all be zero"));
                }
                (rank, Reader::Matrix(Layer::new(factor.view(), Array1::zeros(rank).view())), None)
            }
        };
        Ok(Self { latent_dim, point_dim, reader, factors })
    }

    /// Length of a latent, `Z`.
    pub fn latent_dim(&self) -> usize {
        self.latent_dim
    }

    /// Length of a point, `Q`.
    pub(super) fn point_dim(&self) -> usize {
        self.point_dim
    }

    /// Multiply-adds that reading out one latent takes.
    pub fn multiply_adds(&self) -> usize {
        match &self.reader {
            Reader::Latent => 0,
            Reader::Matrix(_) => self.latent_dim * self.point_dim,
            Reader::Network(network) => network.multiply_adds(),
        }
    }

    /// Room for the points of one block.
    pub(super) fn room(&self) -> Room {
        let scaled = if self.factors.is_some() { self.point_dim } else { 0 };
        Room {
            reader: match &self.reader {
                Reader::Latent => ReaderRoom::Latent,
                Reader::Matrix(layer) => ReaderRoom::Matrix(layer.room()),
                Reader::Network(network) => ReaderRoom::Network(network.room()),
            },
            scaled: vec![[0.0; LANES]; scaled],
        }
    }

    /// Points of a block of latents.
    pub(super) fn points<'r>(&self, latent: &'r [Lanes], room: &'r mut Room) -> &'r [Lanes] {
        points(self, latent, room)
    }

    /// Checks that frames can be goals.
    pub(super) fn check_goals(&self, goals: &LatentFrames) -> Result<()> {
        let Some(length) = goals.target_dim() else {
            return Ok(());
        };
        if matches!(self.reader, Reader::Matrix(_)) {
            return Err(Error::invalid(
                "goals",
                "have targets, which a read-out by a matrix is not compared with",
            ));
        }
        if length != self.point_dim {
            let expected = self.point_dim;
            return Err(Error::invalid(
                "goals",
                format!("expected targets of {expected} numbers, got {length}"),
            ));
        }
        Ok(())
    }

    /// All frames as goals.
    pub(super) fn goals(&self, frames: &LatentFrames) -> Points {
        let (count, length, mut room) = (frames.len(), self.point_dim, self.room());
        let mut values = vec![[0.0; GOALS]; count.div_ceil(GOALS) * length];
        let mut block = vec![[0.0; LANES]; frames.target_dim().unwrap_or(self.latent_dim)];
        for first in (0..count).step_by(LANES) {
            for lane in 0..LANES {
                let goal = (first + lane).min(count - 1);
                let row = frames.target(goal).unwrap_or_else(|| frames.latent(goal));
                for (to, from) in block.iter_mut().zip(row) {
                    to[lane] = *from;
                }
            }
            let points = match frames.target_dim() {
                None => self.points(&block, &mut room),
                Some(_) => {
                    scale(self, &mut block);
                    &block
                }
            };
            for goal in first..count.min(first + LANES) {
                let group = &mut values[goal / GOALS * length..][..length];
                for (to, from) in group.iter_mut().zip(points) {
                    to[goal % GOALS] = from[goal - first];
                }
            }
        }
        let constants = (0..count).map(|i| frames.constant(i)).collect();
        Points { values, constants, length }
    }
}

impl Points {
    /// A block of goals, that of lane `l` being `which(l)`.
    pub(super) fn block(&self, which: impl Fn(usize) -> usize, block: &mut [Lanes]) {
        for lane in 0..LANES {
            let goal = which(lane);
            let group = &self.values[goal / GOALS * self.length..];
            for (to, from) in block.iter_mut().zip(group) {
                to[lane] = from[goal % GOALS];
            }
        }
    }

    /// Hands the costs of a block of points to `visit(goal, costs)`, goal by goal.
    pub(super) fn costs(&self, points: &[Lanes], mut visit: impl FnMut(usize, &Lanes)) {
        for (group, values) in self.values.chunks_exact(self.length).enumerate() {
            let sums = group_distances(points, values);
            let constants = self.constants.iter().enumerate().skip(group * GOALS);
            for (sum, (goal, constant)) in sums.iter().zip(constants) {
                visit(goal, &sum.map(|sum| sum + constant));
            }
        }
    }
}

/// Squared distances of a block of points from a block of goals, lane by lane.
#[multiversion(targets("x86_64+avx512f+fma", "x86_64+avx2+fma"))]
pub(super) fn distances(points: &[Lanes], goals: &[Lanes]) -> Lanes {
    let mut sums = [0.0; LANES];
    for (point, goal) in points.iter().zip(goals) {
        for lane in 0..LANES {
            let apart = point[lane] - goal[lane];
            sums[lane] = apart.mul_add(apart, sums[lane]);
        }
    }
    sums
}

/// The same, in the same order, from [`GOALS`] goals that are those of every lane.
#[multiversion(targets("x86_64+avx512f+fma", "x86_64+avx2+fma"))]
fn group_distances(points: &[Lanes], goals: &[[f32; GOALS]]) -> [Lanes; GOALS] {
    let mut sums = [[0.0; LANES]; GOALS];
    for (point, goal) in points.iter().zip(goals) {
        for g in 0..GOALS {
            for lane in 0..LANES {
                let apart = point[lane] - goal[g];
                sums[g][lane] = apart.mul_add(apart, sums[g][lane]);
            }
        }
    }
    sums
}

#[multiversion(targets("x86_64+avx512f+fma", "x86_64+avx2+fma"))]
fn points<'r>(cost: &LatentCost, latent: &'r [Lanes], room: &'r mut Room) -> &'r [Lanes] {
    read_out(cost, latent, room)
}

#[inline(always)]
fn read_out<'r>(cost: &LatentCost, latent: &'r [Lanes], room: &'r mut Room) -> &'r [Lanes] {
    let read = match (&cost.reader, &mut room.reader) {
        (Reader::Latent, _) => latent,
        (Reader::Matrix(layer), ReaderRoom::Matrix(room)) => layer.apply(latent, false, room),
        (Reader::Network(network), ReaderRoom::Network(room)) => network.apply(latent, room),
        _ => unreachable!("room is made by `LatentCost::room`"),
    };
    if cost.factors.is_none() {
        return read;
    }
    room.scaled.copy_from_slice(read);
    scale(cost, &mut room.scaled);
    &room.scaled
}

/// Multiplies the numbers of points by their factors.
#[inline(always)]
fn scale(cost: &LatentCost, points: &mut [Lanes]) {
    for (point, factor) in points.iter_mut().zip(cost.factors.iter().flatten()) {
        *point = point.map(|x| x * factor);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::nn::toys::{block, Draws, ResidualToy};
    use crate::nn::Activation;

    #[test]
    fn a_processor_without_vectors_reads_the_same_bits() {
        let mut draws = Draws::new(1);
        let mut toy = ResidualToy::new(&mut draws, 9, 30, &[11], 7);
        toy.activation = Activation::Sin;
        let matrix = draws.matrix(20, 9, 1.0);
        let weights = Array1::from_shape_simple_fn(7, || draws.between(0.1, 1.0));
        for (readout, weights) in [
            (Readout::Network(toy.weights()), Some(weights.view())),
            (Readout::Matrix(matrix.view()), None),
        ] {
            let cost = LatentCost::new(9, &readout, weights).unwrap();
            let latent = block(&mut draws, 9, 2.0);
            let (mut one, mut other) = (cost.room(), cost.room());
            let found = points(&cost, &latent, &mut one);
            assert_eq!(found, read_out(&cost, &latent, &mut other));
            assert_eq!(found.len(), cost.point_dim());
        }
    }
}
