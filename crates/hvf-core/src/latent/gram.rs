//! A matrix as the triangular one that measures the same distances.

use ndarray::{Array2, ArrayView2};
use rayon::prelude::*;

/// Part of the largest diagonal element of a Gram matrix below which what is left of it is rounding.
const RANK_TOLERANCE: f64 = 1e-12;

/// `U[Q, Z]` with `|U x| = |R x|` for every `x[Z]`, where `R[P, Z]` is `matrix` and `Q` its rank:
/// a factor of the Gram matrix `R^T R`. The same bits on every machine.
pub(super) fn factor(matrix: ArrayView2<'_, f64>) -> Array2<f32> {
    cholesky(gram(matrix))
}

/// `R^T R`; sums run over the rows in their order.
fn gram(matrix: ArrayView2<'_, f64>) -> Array2<f64> {
    let size = matrix.ncols();
    let rows = matrix.as_standard_layout();
    let rows = rows.as_slice().expect("standard layout");
    let mut gram = Array2::zeros((size, size));
    let sums = gram.as_slice_mut().expect("standard layout");
    sums.par_chunks_exact_mut(size).enumerate().for_each(|(i, sums)| {
        for row in rows.chunks_exact(size) {
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += row[i] * value;
            }
        }
    });
    gram
}

/// Cholesky's method: the largest diagonal element that is left first (the first of equals), until
/// none is more than rounding.
fn cholesky(mut gram: Array2<f64>) -> Array2<f32> {
    let size = gram.nrows();
    let most = gram.diag().iter().copied().fold(0.0, f64::max);
    let mut factor: Vec<f32> = Vec::new();
    for _ in 0..size {
        let mut pivot = 0;
        for i in 1..size {
            if gram[[i, i]] > gram[[pivot, pivot]] {
                pivot = i;
            }
        }
        let left = gram[[pivot, pivot]];
        if left <= RANK_TOLERANCE * most {
            break;
        }
        let row = gram.row(pivot).mapv(|x| x / left.sqrt());
        for i in 0..size {
            for j in 0..size {
                gram[[i, j]] -= row[i] * row[j];
            }
        }
        // Rounding would leave a little of what is done.
        gram.row_mut(pivot).fill(0.0);
        gram.column_mut(pivot).fill(0.0);
        factor.extend(row.iter().map(|&x| x as f32));
    }
    Array2::from_shape_vec((factor.len() / size, size), factor).expect("rows of Z numbers")
}

#[cfg(test)]
mod tests {
    use ndarray::{concatenate, Axis};

    use super::*;
    use crate::nn::toys::Draws;

    #[test]
    fn lengths_are_those_of_the_matrix_and_rows_as_many_as_its_rank() {
        let mut draws = Draws::new(1);
        for (rows, columns, rank) in [(40, 12, 12), (5, 12, 5), (30, 8, 3), (1, 1, 1), (3, 9, 0)] {
            let left = draws.matrix(rows, rank, 1.0).mapv(f64::from);
            let matrix = left.dot(&draws.matrix(rank, columns, 1.0).mapv(f64::from));
            let found = factor(matrix.view()).mapv(f64::from);
            assert_eq!(found.dim(), (rank, columns));
            let gram = matrix.t().dot(&matrix);
            let scale = gram.diag().iter().copied().fold(1e-300, f64::max);
            for (found, exact) in found.t().dot(&found).iter().zip(&gram) {
                assert!((found - exact).abs() < 1e-6 * scale);
            }
            let twice = concatenate![Axis(0), matrix, matrix];
            assert_eq!(factor(twice.view()).nrows(), rank);
        }
    }
}
