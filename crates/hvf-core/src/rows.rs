//! Linear layers whose outputs lie side by side in the vector registers, for a few rows of inputs.
//!
//! Rectified units are zero half of the time, and what is zero adds nothing: the units that are not
//! are marked in a word, bit by bit, and the others skipped. Two rows go together, so that one's
//! sums wait less for the other's.
//!
//! Sums run in the order of the inputs and every multiply-add is a fused one, rounded once, as in
//! [`lanes`](crate::lanes): the result has the same bits on every machine and for every number of
//! rows, and the same as there.

use multiversion::multiversion;
use ndarray::{ArrayView1, ArrayView2};

use crate::lanes::LANES;

/// Numbers of a [`Vector`].
pub(crate) const WIDTH: usize = 16;
/// Units whose zeros are marked in one word.
const UNITS: usize = 64;
/// Most vectors of sums that are kept in registers for a row: those of a word of units.
const PANEL: usize = UNITS / WIDTH;
/// Outputs of a [`Last`] layer that are summed at once, and rows.
pub(crate) const NARROW: usize = 8;

/// Outputs side by side, where no load crosses a cache line.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(crate) struct Vector(pub [f32; WIDTH]);

impl Vector {
    /// Nothing.
    pub(crate) const ZERO: Self = Self([0.0; WIDTH]);

    /// Adds `weights` times `value`.
    #[inline(always)]
    pub(crate) fn add(&mut self, weights: &Self, value: f32) {
        for (sum, weight) in self.0.iter_mut().zip(&weights.0) {
            *sum = weight.mul_add(value, *sum);
        }
    }

    /// Negative values to zero.
    #[inline(always)]
    fn rectified(mut self) -> Self {
        for value in &mut self.0 {
            *value = value.max(0.0);
        }
        self
    }
}

/// Vectors that hold `count` numbers.
pub(crate) fn vectors(count: usize) -> usize {
    count.div_ceil(WIDTH)
}

/// `numbers`, filled up with zeros to whole vectors.
pub(crate) fn padded(numbers: impl Iterator<Item = f32>) -> Vec<Vector> {
    let mut vectors = Vec::new();
    for (place, number) in numbers.enumerate() {
        if place % WIDTH == 0 {
            vectors.push(Vector::ZERO);
        }
        vectors[place / WIDTH].0[place % WIDTH] = number;
    }
    vectors
}

/// The first vector and the number of vectors of every panel of `vectors`.
pub(crate) fn panels(vectors: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..vectors).step_by(PANEL).map(move |first| (first, PANEL.min(vectors - first)))
}

/// Some of the units of a row, then zeros: those behind the units are read where none is left.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
struct Segment([f32; UNITS + WIDTH]);

impl Segment {
    /// Adds the weights of `unit`.
    #[inline(always)]
    fn add<const V: usize>(
        &self,
        unit: usize,
        weights: &[[Vector; V]; UNITS + 1],
        sums: &mut [Vector; V],
    ) {
        for (sum, weights) in sums.iter_mut().zip(&weights[unit]) {
            sum.add(weights, self.0[unit]);
        }
    }
}

/// A bit for every number that is not zero.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn nonzero(sixteen: &[f32; WIDTH]) -> u64 {
    use std::arch::x86_64::{
        __m128i, _mm_castps_si128, _mm_cmpneq_ps, _mm_movemask_epi8, _mm_packs_epi16,
        _mm_packs_epi32, _mm_setr_ps, _mm_setzero_ps,
    };
    #[inline(always)]
    fn words(four: &[f32]) -> __m128i {
        // SAFETY: SSE2 is part of every x86-64 processor; no memory is touched.
        #[allow(unused_unsafe)]
        unsafe {
            let four = _mm_setr_ps(four[0], four[1], four[2], four[3]);
            _mm_castps_si128(_mm_cmpneq_ps(four, _mm_setzero_ps()))
        }
    }
    let (low, high) = (&sixteen[..8], &sixteen[8..]);
    // SAFETY: as above.
    #[allow(unused_unsafe)]
    unsafe {
        let low = _mm_packs_epi32(words(&low[..4]), words(&low[4..]));
        let high = _mm_packs_epi32(words(&high[..4]), words(&high[4..]));
        _mm_movemask_epi8(_mm_packs_epi16(low, high)) as u64
    }
}

/// A bit for every number that is not zero.
#[cfg(not(target_arch = "x86_64"))]
fn nonzero(sixteen: &[f32; WIDTH]) -> u64 {
    let bit = |(unit, number): (usize, &f32)| u64::from(*number != 0.0) << unit;
    sixteen.iter().enumerate().map(bit).sum()
}

/// Rectified units of a block of rows.
#[derive(Clone, Debug)]
pub(crate) struct Units {
    segments: Vec<[Segment; LANES]>,
    /// Which units are not zero: unit 0 in the lowest bit of even rows and in the highest of odd
    /// ones. (Two rows are worked on at once; were they alike, the compiler would put both words
    /// into one vector register and spend its time on getting them out.)
    nonzero: Vec<[u64; LANES]>,
}

impl Units {
    /// Room for [`LANES`] rows of `units`.
    pub(crate) fn new(units: usize) -> Self {
        let segments = units.div_ceil(UNITS);
        Self {
            segments: vec![[Segment([0.0; UNITS + WIDTH]); LANES]; segments],
            nonzero: vec![[0; LANES]; segments],
        }
    }

    /// Rectifies the units of `row` from vector `first` on, the first of a panel.
    #[inline(always)]
    pub(crate) fn rectify(&mut self, row: usize, first: usize, sums: &[Vector]) {
        let units = &mut self.segments[first / PANEL][row].0[..UNITS];
        for (sum, units) in sums.iter().zip(units.as_chunks_mut::<WIDTH>().0) {
            *units = sum.rectified().0;
        }
    }

    /// Marks the units of the first `rows` rows that are not zero, when all are there.
    #[inline(always)]
    pub(crate) fn mark(&mut self, rows: usize) {
        for (units, marks) in self.segments.iter().zip(&mut self.nonzero) {
            for (row, (units, marks)) in units.iter().zip(marks).enumerate().take(rows) {
                let mut bits = 0;
                for sixteen in units.0[..UNITS].as_chunks::<WIDTH>().0.iter().rev() {
                    bits = bits << WIDTH | nonzero(sixteen);
                }
                *marks = if row % 2 == 0 { bits } else { bits.reverse_bits() };
            }
        }
    }
}

/// A layer between rectified units and rectified units.
#[derive(Clone, Debug)]
pub(crate) struct Middle {
    /// `[panels][segments][UNITS + 1][vectors of the panel]`; the last row of a segment is zero.
    weights: Vec<Vec<Vector>>,
    bias: Vec<Vector>,
}

impl Middle {
    /// Packs `weights[outputs, inputs]` and `bias[outputs]`.
    pub(crate) fn new(weights: ArrayView2<'_, f32>, bias: ArrayView1<'_, f32>) -> Self {
        let (outputs, inputs) = weights.dim();
        let panel = |(first, width): (usize, usize)| {
            let rows = (0..inputs.div_ceil(UNITS))
                .flat_map(|segment| (0..=UNITS).map(move |unit| (segment, unit)));
            let numbers = rows.flat_map(|(segment, unit)| {
                (first * WIDTH..(first + width) * WIDTH).map(move |output| {
                    let input = segment * UNITS + unit;
                    let exists = unit < UNITS && input < inputs;
                    weights.get((output, input)).filter(|_| exists).copied().unwrap_or(0.0)
                })
            });
            padded(numbers)
        };
        Self {
            weights: panels(vectors(outputs)).map(panel).collect(),
            bias: padded(bias.iter().copied()),
        }
    }

    /// What the layer makes of rows `row`, an even number, and `row + 1` of `inputs`.
    #[inline(always)]
    pub(crate) fn apply_to_two(&self, inputs: &Units, row: usize, out: &mut Units) {
        for ((first, width), weights) in panels(self.bias.len()).zip(&self.weights) {
            match width {
                1 => self.panel::<1>(first, weights, inputs, row, out),
                2 => self.panel::<2>(first, weights, inputs, row, out),
                3 => self.panel::<3>(first, weights, inputs, row, out),
                _ => self.panel::<PANEL>(first, weights, inputs, row, out),
            }
        }
    }

    #[inline(always)]
    fn panel<const V: usize>(
        &self,
        first: usize,
        weights: &[Vector],
        inputs: &Units,
        row: usize,
        out: &mut Units,
    ) {
        let bias: [Vector; V] = std::array::from_fn(|vector| self.bias[first + vector]);
        let mut sums = [bias; 2];
        let weights = weights.as_chunks::<V>().0.as_chunks::<{ UNITS + 1 }>().0;
        for ((weights, units), nonzero) in weights.iter().zip(&inputs.segments).zip(&inputs.nonzero)
        {
            let (mut ascending, mut descending) = (nonzero[row], nonzero[row + 1]);
            // Where none is left, the number of the unit is 64: zeros.
            for _ in 0..ascending.count_ones().max(descending.count_ones()) {
                let unit = ascending.trailing_zeros() as usize;
                ascending &= ascending.wrapping_sub(1);
                units[row].add(unit, weights, &mut sums[0]);
                let unit = descending.leading_zeros() as usize;
                descending &= (u64::MAX >> 1).checked_shr(unit as u32).unwrap_or(0);
                units[row + 1].add(unit, weights, &mut sums[1]);
            }
        }
        out.rectify(row, first, &sums[0]);
        out.rectify(row + 1, first, &sums[1]);
    }
}

/// A layer of few outputs that comes last.
#[derive(Clone, Debug)]
pub(crate) struct Last {
    /// `[outputs / NARROW][inputs][NARROW]`.
    weights: Vec<Vec<[f32; NARROW]>>,
    bias: Vec<[f32; NARROW]>,
}

impl Last {
    /// Packs `weights[outputs, inputs]` and `bias[outputs]`.
    pub(crate) fn new(weights: ArrayView2<'_, f32>, bias: ArrayView1<'_, f32>) -> Self {
        let (outputs, inputs) = weights.dim();
        let groups = outputs.div_ceil(NARROW);
        let eight = |of: &dyn Fn(usize) -> Option<f32>, group: usize| {
            std::array::from_fn(|place| of(group * NARROW + place).unwrap_or(0.0))
        };
        let weights_of = |group: usize| {
            let at = |input: usize| eight(&|output| weights.get((output, input)).copied(), group);
            (0..inputs).map(at).collect()
        };
        Self {
            weights: (0..groups).map(weights_of).collect(),
            bias: (0..groups).map(|g| eight(&|output| bias.get(output).copied(), g)).collect(),
        }
    }

    /// Groups of [`NARROW`] outputs.
    pub(crate) fn groups(&self) -> usize {
        self.bias.len()
    }

    /// What the layer makes of [`NARROW`] rows of `inputs` from `first` on: one group of outputs.
    #[inline(always)]
    pub(crate) fn group(
        &self,
        group: usize,
        inputs: &Units,
        first: usize,
    ) -> [[f32; NARROW]; NARROW] {
        let mut sums = [self.bias[group]; NARROW];
        for (units, weights) in inputs.segments.iter().zip(self.weights[group].chunks(UNITS)) {
            if let Some(rows) = units[first..].first_chunk() {
                add_eight(rows, weights, &mut sums);
            }
        }
        sums
    }
}

/// Adds the units of eight rows times `weights`. (Eight outputs just fill a vector of AVX2; with
/// wider ones the compiler puts two rows into one, which takes it longer than it saves.)
#[multiversion(targets("x86_64+avx2+fma"))]
fn add_eight(
    rows: &[Segment; NARROW],
    weights: &[[f32; NARROW]],
    sums: &mut [[f32; NARROW]; NARROW],
) {
    let mut local = *sums;
    for (unit, weights) in weights.iter().enumerate().take(UNITS) {
        for (sums, row) in local.iter_mut().zip(rows) {
            for (sum, weight) in sums.iter_mut().zip(weights) {
                *sum = weight.mul_add(row.0[unit], *sum);
            }
        }
    }
    *sums = local;
}
