//! The small network that moves a keypoint by an action, for blocks of candidates.
//!
//! One action is a few substeps. In each, the network looks at the scene around the keypoint, at
//! the action and at a short memory, and moves keypoint and memory on: what a wall does to the
//! motion depends on what is near, wherever in the scene that is.
//!
//! One block is up to [`LANES`] candidates of one problem: every layer is worked out for all of them
//! before the next, hidden units side by side in the vector registers (`rows.rs`).

use ndarray::{ArrayView1, ArrayView2};

use super::field::{Place, SceneField};
use crate::lanes::{Lanes, LANES};
use crate::rows::{padded, panels, vectors, Last, Middle, Units, Vector, NARROW};
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

/// What the number of hidden units is a multiple of.
const HIDDEN_MULTIPLE: usize = 4;

/// The cell, with its weights packed for blocks of candidates.
#[derive(Clone, Debug)]
pub struct Cell {
    hidden: usize,
    action_dim: usize,
    memory: usize,
    spacing: usize,
    substeps: usize,
    /// `[taps * taps][hidden]`, hidden units filled up to whole vectors.
    patch: Vec<Vector>,
    /// `[hidden]`, filled up as well.
    patch_bias: Vec<Vector>,
    /// `[panels][A + C][hidden units of the panel]`, as well: actions (weights already divided by
    /// the scale), then memory.
    context: Vec<Vec<Vector>>,
    middle: Middle,
    /// Motion, then memory.
    output: Last,
    /// `[A][2 + C]`, already divided by the scale, filled up to whole groups; nothing for memory.
    free: Vec<Vec<[f32; NARROW]>>,
}

/// Room for one block.
#[derive(Clone, Debug)]
pub struct Scratch {
    /// Keypoint and memory of each, `[LANES][2 + C]`, filled up to whole groups.
    state: Vec<[f32; NARROW]>,
    first: Units,
    second: Units,
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
        if hidden == 0 || hidden % HIDDEN_MULTIPLE != 0 {
            return Err(Error::invalid(
                "patch",
                format!("expected a positive multiple of {HIDDEN_MULTIPLE} rows, got {hidden}"),
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
        let rows = |matrix: ArrayView2<'_, f32>, scale: &dyn Fn(usize) -> f32| -> Vec<Vector> {
            let columns = matrix.columns().into_iter().enumerate();
            columns
                .flat_map(|(j, column)| padded(column.iter().map(|weight| weight * scale(j))))
                .collect()
        };
        Ok(Self {
            hidden,
            action_dim,
            memory,
            spacing: weights.spacing,
            substeps: weights.substeps,
            patch: rows(weights.patch, &|_| 1.0),
            patch_bias: padded(weights.patch_bias.iter().copied()),
            context: panels(vectors(hidden))
                .map(|(first, width)| {
                    let context =
                        rows(weights.context, &|j| if j < action_dim { scale } else { 1.0 });
                    let of_panel = |all: &[Vector]| all[first..first + width].to_vec();
                    context.chunks(vectors(hidden)).flat_map(of_panel).collect()
                })
                .collect(),
            middle: Middle::new(weights.middle, weights.middle_bias),
            output: Last::new(weights.output, weights.output_bias),
            free: weights
                .free
                .columns()
                .into_iter()
                .map(|motion| {
                    let mut outputs = vec![[0.0; NARROW]; (2 + memory).div_ceil(NARROW)];
                    for (output, weight) in outputs.as_flattened_mut().iter_mut().zip(motion) {
                        *output = weight * scale;
                    }
                    outputs
                })
                .collect(),
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
            state: vec![[0.0; NARROW]; LANES * self.output.groups()],
            first: Units::new(self.hidden),
            second: Units::new(self.hidden),
        }
    }

    /// Moves a block of `count` keypoints (row, column in pixels) by one action each,
    /// `actions[LANES, A]`. What it makes of the lanes after them is of no use.
    ///
    /// `field` comes from [`field`](Self::field), `scratch` from [`scratch`](Self::scratch).
    /// `substeps * hidden * (hidden + A + 2 C + 6)` multiply-adds per candidate, about half of
    /// `hidden^2` of which are skipped.
    ///
    /// # Panics
    /// If there are more keypoints than [`LANES`], or fewer actions than `LANES * A` numbers.
    pub fn advance(
        &self,
        field: &SceneField,
        keypoint: &mut [Lanes; 2],
        count: usize,
        actions: &[f32],
        scratch: &mut Scratch,
    ) {
        assert!(count <= LANES && actions.len() >= LANES * self.action_dim);
        advance(self, field, keypoint, count, actions, scratch);
    }
}

#[multiversion::multiversion(targets("x86_64+avx2+fma+bmi1+bmi2+lzcnt+popcnt"))]
fn advance(
    cell: &Cell,
    field: &SceneField,
    keypoint: &mut [Lanes; 2],
    count: usize,
    actions: &[f32],
    scratch: &mut Scratch,
) {
    let Scratch { state, first, second } = scratch;
    let groups = cell.output.groups();
    state.fill([0.0; NARROW]);
    for lane in 0..LANES {
        state[lane * groups][..2].copy_from_slice(&[keypoint[0][lane], keypoint[1][lane]]);
    }
    for substep in 0..cell.substeps {
        // A memory of zeros adds nothing.
        let remembered = if substep == 0 { 0 } else { cell.memory };
        let places = field.places(keypoint);
        for lane in 0..count {
            let action = &actions[lane * cell.action_dim..][..cell.action_dim];
            let memory = &state[lane * groups..][..groups].as_flattened()[2..][..remembered];
            for (panel, (from, width)) in panels(vectors(cell.hidden)).enumerate() {
                let see = See { cell, field, place: places.of(lane), panel, from };
                match width {
                    1 => see.look::<1>(action, memory, lane, first),
                    2 => see.look::<2>(action, memory, lane, first),
                    3 => see.look::<3>(action, memory, lane, first),
                    _ => see.look::<4>(action, memory, lane, first),
                }
            }
        }
        first.mark(count.next_multiple_of(2));
        for pair in (0..count).step_by(2) {
            cell.middle.apply_to_two(first, pair, second);
        }
        for eight in (0..count).step_by(NARROW) {
            for group in 0..groups {
                let mut moved = cell.output.group(group, second, eight);
                for (lane, moved) in (eight..).zip(&mut moved) {
                    let action = &actions[lane * cell.action_dim..][..cell.action_dim];
                    for (input, free) in action.iter().zip(&cell.free) {
                        for (moved, weight) in moved.iter_mut().zip(&free[group]) {
                            *moved = weight.mul_add(*input, *moved);
                        }
                    }
                    for (kept, moved) in state[lane * groups + group].iter_mut().zip(moved) {
                        *kept += *moved;
                    }
                }
            }
        }
        for lane in 0..count {
            [keypoint[0][lane], keypoint[1][lane]] =
                [state[lane * groups][0], state[lane * groups][1]];
        }
    }
}

/// What one candidate looks at, with one panel of hidden units.
struct See<'a> {
    cell: &'a Cell,
    field: &'a SceneField,
    place: Place,
    panel: usize,
    /// First vector of the panel.
    from: usize,
}

impl See<'_> {
    /// The first layer: `V` vectors of hidden units of the candidate in `lane`.
    #[inline(always)]
    fn look<const V: usize>(&self, action: &[f32], memory: &[f32], lane: usize, out: &mut Units) {
        let mut sums: [Vector; V] = self.field.sample(&self.place, self.from);
        let context = self.cell.context[self.panel].as_chunks::<V>().0;
        let (of_action, of_memory) = context.split_at(action.len());
        for (inputs, context) in [(action, of_action), (memory, of_memory)] {
            for (&input, weights) in inputs.iter().zip(context) {
                for (sum, weights) in sums.iter_mut().zip(weights) {
                    sum.add(weights, input);
                }
            }
        }
        out.rectify(lane, self.from, &sums);
    }
}
