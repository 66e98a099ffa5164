//! The residual network that moves a keypoint by an action, for blocks of candidates.
//!
//! One block is [`LANES`] candidates of one problem, stored lane by lane, so that every weight is
//! loaded once for the block and the arithmetic is plain vertical SIMD. Sums run in a fixed order
//! and without fused multiply-add: the result has the same bits on every machine and for every
//! batch size.

use ndarray::{ArrayView1, ArrayView2};

use crate::{Error, Result};

/// Candidates that are moved together.
pub const LANES: usize = 16;

/// One number for each candidate of a block.
pub type Lanes = [f32; LANES];

/// Outputs of the middle layer that are summed at once; 4 x 16 lanes fill the vector registers.
const OUTPUTS: usize = 4;

/// Weights of the cell as `torch.nn.Linear` stores them: `[outputs, inputs]`.
///
/// Inputs of the first layer are the keypoint (2, in [-1, 1]), the action (`A`, divided by
/// `action_scale`) and the scene code (`E`), in this order.
#[derive(Clone, Copy, Debug)]
pub struct CellWeights<'a> {
    /// First layer, `[hidden, 2 + A + E]`.
    pub input: ArrayView2<'a, f32>,
    /// Bias of the first layer, `[hidden]`.
    pub input_bias: ArrayView1<'a, f32>,
    /// Second layer, `[hidden, hidden]`.
    pub middle: ArrayView2<'a, f32>,
    /// Bias of the second layer, `[hidden]`.
    pub middle_bias: ArrayView1<'a, f32>,
    /// Last layer, `[2, hidden]`.
    pub output: ArrayView2<'a, f32>,
    /// Bias of the last layer, `[2]`.
    pub output_bias: ArrayView1<'a, f32>,
    /// Number by which actions are divided.
    pub action_scale: f32,
}

/// The cell, with its weights packed for blocks of candidates.
#[derive(Clone, Debug)]
pub struct Cell {
    hidden: usize,
    action_dim: usize,
    scene_dim: usize,
    /// Per hidden unit: 2 keypoint weights, then A action weights already divided by the scale.
    input: Vec<f32>,
    /// Per hidden unit: E weights.
    input_scene: Vec<f32>,
    input_bias: Vec<f32>,
    /// `[hidden / OUTPUTS][hidden][OUTPUTS]`.
    middle: Vec<[f32; OUTPUTS]>,
    middle_bias: Vec<f32>,
    output: [Vec<f32>; 2],
    output_bias: [f32; 2],
}

fn expect_len(argument: &'static str, expected: usize, found: usize) -> Result<()> {
    if expected == found {
        Ok(())
    } else {
        Err(Error::invalid(argument, format!("expected {expected} rows or columns, got {found}")))
    }
}

impl Cell {
    /// Packs `weights` for `action_dim` action dimensions.
    ///
    /// # Errors
    /// Shapes that do not fit each other, a hidden width that is not a multiple of 4, weights
    /// that are not finite, or an `action_scale` that is not positive.
    pub fn new(weights: CellWeights<'_>, action_dim: usize) -> Result<Self> {
        let (hidden, inputs) = weights.input.dim();
        if action_dim == 0 || inputs <= 2 + action_dim {
            return Err(Error::invalid(
                "input",
                format!("expected more than {} columns, got {inputs}", 2 + action_dim),
            ));
        }
        if hidden == 0 || hidden % OUTPUTS != 0 {
            return Err(Error::invalid(
                "input",
                format!("expected a positive multiple of {OUTPUTS} rows, got {hidden}"),
            ));
        }
        expect_len("input_bias", hidden, weights.input_bias.len())?;
        expect_len("middle", hidden, weights.middle.nrows())?;
        expect_len("middle", hidden, weights.middle.ncols())?;
        expect_len("middle_bias", hidden, weights.middle_bias.len())?;
        expect_len("output", 2, weights.output.nrows())?;
        expect_len("output", hidden, weights.output.ncols())?;
        expect_len("output_bias", 2, weights.output_bias.len())?;
        if !(weights.action_scale.is_finite() && weights.action_scale > 0.0) {
            return Err(Error::invalid("action_scale", "must be positive and finite"));
        }
        let finite = |array: ArrayView2<'_, f32>| array.iter().all(|x| x.is_finite());
        let finite_bias = |array: ArrayView1<'_, f32>| array.iter().all(|x| x.is_finite());
        for (argument, fine) in [
            ("input", finite(weights.input) && finite_bias(weights.input_bias)),
            ("middle", finite(weights.middle) && finite_bias(weights.middle_bias)),
            ("output", finite(weights.output) && finite_bias(weights.output_bias)),
        ] {
            if !fine {
                return Err(Error::invalid(argument, "weights must be finite"));
            }
        }

        let moving = 2 + action_dim;
        let mut input = Vec::with_capacity(hidden * moving);
        let mut input_scene = Vec::with_capacity(hidden * (inputs - moving));
        for row in weights.input.rows() {
            for (column, &weight) in row.iter().enumerate() {
                match column {
                    0 | 1 => input.push(weight),
                    c if c < moving => input.push(weight / weights.action_scale),
                    _ => input_scene.push(weight),
                }
            }
        }
        let mut middle = Vec::with_capacity(hidden * hidden / OUTPUTS);
        for block in 0..hidden / OUTPUTS {
            for i in 0..hidden {
                middle.push(std::array::from_fn(|q| weights.middle[[block * OUTPUTS + q, i]]));
            }
        }
        Ok(Self {
            hidden,
            action_dim,
            scene_dim: inputs - moving,
            input,
            input_scene,
            input_bias: weights.input_bias.to_vec(),
            middle,
            middle_bias: weights.middle_bias.to_vec(),
            output: [weights.output.row(0).to_vec(), weights.output.row(1).to_vec()],
            output_bias: [weights.output_bias[0], weights.output_bias[1]],
        })
    }

    /// Length of a scene code, `E`.
    pub fn scene_dim(&self) -> usize {
        self.scene_dim
    }

    /// Action dimensions, `A`.
    pub fn action_dim(&self) -> usize {
        self.action_dim
    }

    /// What the scene code contributes to the first layer, `[hidden]`; the same for all
    /// candidates and steps of a problem. `code` is `[E]`.
    pub fn scene_bias(&self, code: &[f32]) -> Vec<f32> {
        self.input_bias
            .iter()
            .zip(self.input_scene.chunks_exact(self.scene_dim))
            .map(|(&bias, row)| row.iter().zip(code).fold(bias, |sum, (&w, &x)| sum + w * x))
            .collect()
    }

    /// Room for the hidden units of one block.
    pub fn scratch(&self) -> Vec<Lanes> {
        vec![[0.0; LANES]; self.hidden]
    }

    /// Moves a block of keypoints (row, column in [-1, 1]) by one action (`A` numbers).
    ///
    /// `scene_bias` comes from [`scene_bias`](Self::scene_bias), `scratch` from
    /// [`scratch`](Self::scratch). `hidden * (hidden + A + 4)` multiply-adds per candidate.
    pub fn advance(
        &self,
        scene_bias: &[f32],
        keypoint: &mut [Lanes; 2],
        action: &[Lanes],
        scratch: &mut [Lanes],
    ) {
        advance(self, scene_bias, keypoint, action, scratch);
    }
}

#[multiversion::multiversion(targets("x86_64+avx2"))]
fn advance(
    cell: &Cell,
    scene_bias: &[f32],
    keypoint: &mut [Lanes; 2],
    action: &[Lanes],
    scratch: &mut [Lanes],
) {
    let moving = 2 + cell.action_dim;
    for ((unit, weights), &bias) in
        scratch.iter_mut().zip(cell.input.chunks_exact(moving)).zip(scene_bias)
    {
        let mut sum = [bias; LANES];
        for (input, &weight) in keypoint.iter().chain(action).zip(weights) {
            for lane in 0..LANES {
                sum[lane] += weight * input[lane];
            }
        }
        for lane in 0..LANES {
            unit[lane] = sum[lane].max(0.0);
        }
    }

    let mut moved = [[cell.output_bias[0]; LANES], [cell.output_bias[1]; LANES]];
    for (block, weights) in cell.middle.chunks_exact(cell.hidden).enumerate() {
        let first = block * OUTPUTS;
        let mut sums: [Lanes; OUTPUTS] =
            std::array::from_fn(|q| [cell.middle_bias[first + q]; LANES]);
        for (unit, weight) in scratch.iter().zip(weights) {
            for q in 0..OUTPUTS {
                for lane in 0..LANES {
                    sums[q][lane] += weight[q] * unit[lane];
                }
            }
        }
        for (q, sum) in sums.iter().enumerate() {
            for (axis, out) in moved.iter_mut().enumerate() {
                let weight = cell.output[axis][first + q];
                for lane in 0..LANES {
                    out[lane] += weight * sum[lane].max(0.0);
                }
            }
        }
    }
    for (position, out) in keypoint.iter_mut().zip(&moved) {
        for lane in 0..LANES {
            position[lane] += out[lane];
        }
    }
}
