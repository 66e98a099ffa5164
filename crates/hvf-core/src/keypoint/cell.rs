//! The small network that moves a keypoint by an action, for blocks of candidates.
//!
//! One action is a few substeps. In each, the network looks at the scene around the keypoint, at
//! the action and at a short memory, and moves keypoint and memory on: what a wall does to the
//! motion depends on what is near, wherever in the scene that is.
//!
//! One block is [`LANES`] candidates of one problem (see [`lanes`](crate::lanes)).

use ndarray::{ArrayView1, ArrayView2};

use super::field::SceneField;
use crate::lanes::{rectify, Lanes, Layer, Packed, LANES, OUTPUTS};
use crate::{Error, Result};

/// Weights of the cell as `torch.nn.Linear` stores them: `[outputs, inputs]`.
///
/// `A` is the number of action dimensions, `C` the length of the memory. Motion is in pixels,
/// (row, column).
#[derive(Clone, Copy, Debug)]
pub struct CellWeights<'a> {
    /// First layer, its part that looks at the scene: `[hidden, taps * taps]`, `taps` odd.
    pub patch: ArrayView2<'a, f32>,
    /// Bias of the first layer, `[hidden]`.
    pub patch_bias: ArrayView1<'a, f32>,
    /// First layer, its part for action (divided by `action_scale`) and memory:
    /// `[hidden, A + C]`.
    pub context: ArrayView2<'a, f32>,
    /// Second layer, `[hidden, hidden]`.
    pub middle: ArrayView2<'a, f32>,
    /// Bias of the second layer, `[hidden]`.
    pub middle_bias: ArrayView1<'a, f32>,
    /// Last layer, `[2 + C, hidden]`: motion, then change of the memory.
    pub output: ArrayView2<'a, f32>,
    /// Bias of the last layer, `[2 + C]`.
    pub output_bias: ArrayView1<'a, f32>,
    /// Motion per substep that is linear in the action (divided by `action_scale`), `[2, A]`.
    pub free: ArrayView2<'a, f32>,
    /// Number by which actions are divided.
    pub action_scale: f32,
    /// Pixels between neighbouring taps of a patch.
    pub spacing: usize,
    /// Substeps per action.
    pub substeps: usize,
}

/// The cell, with its weights packed for blocks of candidates.
#[derive(Clone, Debug)]
pub struct Cell {
    hidden: usize,
    action_dim: usize,
    memory: usize,
    spacing: usize,
    substeps: usize,
    /// `[taps * taps][hidden]`.
    patch: Vec<f32>,
    patch_bias: Vec<f32>,
    /// A actions (weights already divided by the scale), then C numbers of memory.
    context: Packed,
    middle: Layer,
    /// Motion, then memory.
    output: Layer,
    /// `[2][A]`, already divided by the scale.
    free: Vec<f32>,
}

/// Room for one block.
#[derive(Clone, Debug)]
pub struct Scratch {
    row: Vec<f32>,
    /// Actions, then memory.
    context: Vec<Lanes>,
    first: Vec<Lanes>,
    second: Vec<Lanes>,
    moved: Vec<Lanes>,
}

/// Most substeps of an action, each of which takes its time, and pixels between taps.
const MOST: usize = 256;

fn expect(argument: &'static str, expected: &[usize], found: &[usize]) -> Result<()> {
    if expected == found {
        Ok(())
    } else {
        Err(Error::invalid(argument, format!("expected shape {expected:?}, got {found:?}")))
    }
}

impl CellWeights<'_> {
    /// Checks that all shapes fit each other, and all numbers are finite; returns `(A, C)`.
    fn validate(&self) -> Result<(usize, usize)> {
        let (hidden, taps) = self.patch.dim();
        if hidden == 0 || hidden % OUTPUTS != 0 {
            return Err(Error::invalid(
                "patch",
                format!("expected a positive multiple of {OUTPUTS} rows, got {hidden}"),
            ));
        }
        if taps.isqrt().pow(2) != taps || taps % 2 == 0 {
            return Err(Error::invalid(
                "patch",
                format!("expected the square of an odd number of columns, got {taps}"),
            ));
        }
        let (action_dim, outputs) = (self.free.ncols(), self.output.nrows());
        if action_dim == 0 {
            return Err(Error::invalid("free", "must have a column for each action dimension"));
        }
        if outputs < 2 {
            return Err(Error::invalid(
                "output",
                format!("expected at least 2 rows, got {outputs}"),
            ));
        }
        let memory = outputs - 2;
        expect("patch_bias", &[hidden], self.patch_bias.shape())?;
        expect("context", &[hidden, action_dim + memory], self.context.shape())?;
        expect("middle", &[hidden, hidden], self.middle.shape())?;
        expect("middle_bias", &[hidden], self.middle_bias.shape())?;
        expect("output", &[outputs, hidden], self.output.shape())?;
        expect("output_bias", &[outputs], self.output_bias.shape())?;
        expect("free", &[2, action_dim], self.free.shape())?;
        for (argument, fine) in [
            ("patch", self.patch.iter().all(|x| x.is_finite())),
            ("patch_bias", self.patch_bias.iter().all(|x| x.is_finite())),
            ("context", self.context.iter().all(|x| x.is_finite())),
            ("middle", self.middle.iter().all(|x| x.is_finite())),
            ("middle_bias", self.middle_bias.iter().all(|x| x.is_finite())),
            ("output", self.output.iter().all(|x| x.is_finite())),
            ("output_bias", self.output_bias.iter().all(|x| x.is_finite())),
            ("free", self.free.iter().all(|x| x.is_finite())),
        ] {
            if !fine {
                return Err(Error::invalid(argument, "weights must be finite"));
            }
        }
        if !(self.action_scale.is_finite() && self.action_scale > 0.0) {
            return Err(Error::invalid("action_scale", "must be positive and finite"));
        }
        for (argument, value) in [("spacing", self.spacing), ("substeps", self.substeps)] {
            if !(1..=MOST).contains(&value) {
                return Err(Error::invalid(
                    argument,
                    format!("must be at least 1 and at most {MOST}, got {value}"),
                ));
            }
        }
        Ok((action_dim, memory))
    }
}

impl Cell {
    /// Packs `weights`.
    ///
    /// # Errors
    /// Shapes that do not fit each other, a hidden width that is not a multiple of 4, weights
    /// that are not finite, or an action scale, spacing or number of substeps that is not positive.
    pub fn new(weights: CellWeights<'_>) -> Result<Self> {
        let (action_dim, memory) = weights.validate()?;
        let hidden = weights.patch.nrows();
        let scale = 1.0 / weights.action_scale;
        Ok(Self {
            hidden,
            action_dim,
            memory,
            spacing: weights.spacing,
            substeps: weights.substeps,
            patch: weights.patch.t().iter().copied().collect(),
            patch_bias: weights.patch_bias.to_vec(),
            context: Packed::new(
                weights.context,
                |column| {
                    if column < action_dim {
                        scale
                    } else {
                        1.0
                    }
                },
            ),
            middle: Layer::new(weights.middle, weights.middle_bias),
            output: Layer::new(weights.output, weights.output_bias),
            free: weights.free.iter().map(|weight| weight * scale).collect(),
        })
    }

    /// Action dimensions, `A`.
    pub fn action_dim(&self) -> usize {
        self.action_dim
    }

    /// What the cell sees in a scene; `map` is `[S, S]`, row by row.
    pub fn field(&self, map: &[f32], size: usize) -> SceneField {
        SceneField::new(map, size, &self.patch, &self.patch_bias, self.spacing)
    }

    /// Room for one block.
    pub fn scratch(&self) -> Scratch {
        Scratch {
            row: vec![0.0; self.hidden],
            context: vec![[0.0; LANES]; self.action_dim + self.memory],
            first: vec![[0.0; LANES]; self.hidden],
            second: self.middle.room(),
            moved: self.output.room(),
        }
    }

    /// Moves a block of keypoints (row, column in pixels) by one action (`A` numbers).
    ///
    /// `field` comes from [`field`](Self::field), `scratch` from [`scratch`](Self::scratch).
    /// `substeps * hidden * (hidden + A + 2 C + 6)` multiply-adds per candidate.
    pub fn advance(
        &self,
        field: &SceneField,
        keypoint: &mut [Lanes; 2],
        action: &[Lanes],
        scratch: &mut Scratch,
    ) {
        let (actions, memory) = scratch.context.split_at_mut(self.action_dim);
        actions.copy_from_slice(action);
        memory.fill([0.0; LANES]);
        for _ in 0..self.substeps {
            substep(self, field, keypoint, scratch);
        }
    }
}

#[multiversion::multiversion(targets("x86_64+avx2+fma"))]
fn substep(cell: &Cell, field: &SceneField, keypoint: &mut [Lanes; 2], scratch: &mut Scratch) {
    let Scratch { row, context, first, second, moved } = scratch;
    for lane in 0..LANES {
        field.sample([keypoint[0][lane], keypoint[1][lane]], row);
        for (unit, &feature) in first.iter_mut().zip(row.iter()) {
            unit[lane] = feature;
        }
    }
    cell.context.accumulate(context, first);
    rectify(first);
    let second = cell.middle.apply(first, true, second);
    let moved = cell.output.apply(second, false, moved);

    let (actions, memory) = context.split_at_mut(cell.action_dim);
    for (axis, position) in keypoint.iter_mut().enumerate() {
        let mut motion = moved[axis];
        let free = &cell.free[axis * cell.action_dim..][..cell.action_dim];
        for (input, &weight) in actions.iter().zip(free) {
            for lane in 0..LANES {
                motion[lane] = weight.mul_add(input[lane], motion[lane]);
            }
        }
        for lane in 0..LANES {
            position[lane] += motion[lane];
        }
    }
    for (kept, change) in memory.iter_mut().zip(&moved[2..]) {
        for lane in 0..LANES {
            kept[lane] += change[lane];
        }
    }
}
