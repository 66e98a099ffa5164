//! Linear layers for blocks of [`LANES`] inputs at once.
//!
//! Inputs are stored lane by lane, so that every weight is loaded once for the block and the
//! arithmetic is plain vertical SIMD. Sums run in a fixed order and every multiply-add is a fused
//! one, rounded once, so the result has the same bits on every machine and for every batch size.
//! (A processor without the instruction computes the same, at a tenth of the speed.)

use ndarray::{ArrayView1, ArrayView2};

/// Inputs that are worked on together.
pub const LANES: usize = 16;

/// One number for each input of a block.
pub type Lanes = [f32; LANES];

/// Outputs that are summed at once; 4 x 16 lanes fill the vector registers.
const OUTPUTS: usize = 4;

/// Weights of a layer, [`OUTPUTS`] outputs together: `[outputs / OUTPUTS][inputs][OUTPUTS]`.
#[derive(Clone, Debug)]
struct Packed(Vec<[f32; OUTPUTS]>);

impl Packed {
    /// Packs `weights[outputs, inputs]`, with rows of zeros up to a multiple of [`OUTPUTS`].
    fn new(weights: ArrayView2<'_, f32>) -> Self {
        let (outputs, inputs) = weights.dim();
        let at = |row: usize, column: usize| weights.get((row, column)).copied().unwrap_or(0.0);
        Self(
            (0..outputs.div_ceil(OUTPUTS))
                .flat_map(|block| (0..inputs).map(move |column| (block * OUTPUTS, column)))
                .map(|(first, column)| std::array::from_fn(|q| at(first + q, column)))
                .collect(),
        )
    }
}

/// `sums` plus weights times `inputs`, for [`OUTPUTS`] outputs.
#[inline(always)]
fn weighted_sums(
    mut sums: [Lanes; OUTPUTS],
    weights: &[[f32; OUTPUTS]],
    inputs: &[Lanes],
) -> [Lanes; OUTPUTS] {
    for (input, weight) in inputs.iter().zip(weights) {
        for q in 0..OUTPUTS {
            for lane in 0..LANES {
                sums[q][lane] = weight[q].mul_add(input[lane], sums[q][lane]);
            }
        }
    }
    sums
}

/// A linear layer, its bias padded with zeros to a multiple of [`OUTPUTS`].
#[derive(Clone, Debug)]
pub(crate) struct Layer {
    weights: Packed,
    bias: Vec<[f32; OUTPUTS]>,
    outputs: usize,
}

impl Layer {
    /// Packs `weights[outputs, inputs]` and `bias[outputs]`.
    pub(crate) fn new(weights: ArrayView2<'_, f32>, bias: ArrayView1<'_, f32>) -> Self {
        let mut padded = bias.to_vec();
        padded.resize(bias.len().next_multiple_of(OUTPUTS), 0.0);
        Self {
            weights: Packed::new(weights),
            bias: padded.as_chunks().0.to_vec(),
            outputs: bias.len(),
        }
    }

    /// Room for what the layer gives.
    pub(crate) fn room(&self) -> Vec<Lanes> {
        vec![[0.0; LANES]; self.bias.len() * OUTPUTS]
    }

    /// What the layer makes of `inputs`, negative values as zero if it is to be `rectified`.
    #[inline(always)]
    pub(crate) fn apply<'r>(
        &self,
        inputs: &[Lanes],
        rectified: bool,
        out: &'r mut [Lanes],
    ) -> &'r [Lanes] {
        let outs = out.as_chunks_mut::<OUTPUTS>().0;
        let weights = self.weights.0.chunks_exact(inputs.len());
        for ((out, weights), bias) in outs.iter_mut().zip(weights).zip(&self.bias) {
            *out = weighted_sums(std::array::from_fn(|q| [bias[q]; LANES]), weights, inputs);
            if rectified {
                rectify(out);
            }
        }
        &out[..self.outputs]
    }
}

/// Negative values to zero.
#[inline(always)]
fn rectify(units: &mut [Lanes]) {
    for value in units.as_flattened_mut() {
        *value = value.max(0.0);
    }
}
