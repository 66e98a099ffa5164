//! `image_cost`: the pixel cost between batches of frames, on NumPy's own memory.

use hvf_core_rs::image::{all_pairs_costs, paired_costs, GaussianBlur, Pixel};
use hvf_core_rs::{Error, Result};
use ndarray::{ArrayD, ArrayView4};
use numpy::{IntoPyArray, PyArrayDyn, PyReadonlyArray4};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arguments::{array, axes_of, text, Given, Real, Text};
use crate::error::to_py;
use crate::threads::detached;

/// A batch of frames, borrowed from NumPy.
enum Batch<'py> {
    Bytes(PyReadonlyArray4<'py, u8>),
    Floats(PyReadonlyArray4<'py, f32>),
}

fn batch<'py>(argument: &str, object: &Bound<'py, PyAny>) -> PyResult<Batch<'py>> {
    const EXPECTED: &str = "uint8 or float32 [N, H, W, C]";
    if axes_of::<u8>(object).is_some() {
        return array(argument, object, EXPECTED).map(Batch::Bytes);
    }
    array(argument, object, EXPECTED).map(Batch::Floats)
}

#[derive(Clone, Copy)]
enum Mode {
    Pairs,
    AllPairs,
}

fn costs<T: Pixel>(
    a: ArrayView4<'_, T>,
    b: ArrayView4<'_, T>,
    mode: Mode,
    blur: f64,
) -> Result<ArrayD<f64>> {
    let blur = GaussianBlur::new(blur, "blur")?;
    match mode {
        Mode::Pairs => Ok(paired_costs(a, b, blur.as_ref())?.into_dyn()),
        Mode::AllPairs => Ok(all_pairs_costs(a, b, blur.as_ref())?.into_dyn()),
    }
}

/// Squared L2 between frames, per pixel: `sum((a - b)**2) / (H * W)` of colours in `[0, 1]`.
///
/// Without blur, costs of uint8 frames are exact up to one rounding. Nothing is copied.
///
/// Args:
///     a: Frames `[N, H, W, C]`, uint8 or float32 within `[0, 1]`, C-contiguous.
///     b: Frames of the same dtype.
///     mode: 'pairs' for float64 `[N]`, or 'all_pairs' for `[len(a), len(b)]` (one to many: one
///         frame in `a`).
///     blur: Standard deviation, in pixels, of a Gaussian blur of both frames first, as
///         `scipy.ndimage.gaussian_filter` does on each channel; 0 for none.
///
/// Raises:
///     ValueError: Shapes that do not match, empty batches, memory that is not contiguous, float32
///         values outside `[0, 1]` or a negative blur.
///     TypeError: Other dtypes.
#[pyfunction]
#[pyo3(signature = (a, b, mode = text("pairs"), blur = Given::of(0.0)), text_signature = "(a, b, mode='pairs', blur=0.0)")]
fn image_cost<'py>(
    py: Python<'py>,
    a: &Bound<'py, PyAny>,
    b: &Bound<'py, PyAny>,
    mode: Text,
    blur: Real,
) -> PyResult<Bound<'py, PyArrayDyn<f64>>> {
    let blur = blur.get("blur")?;
    let mode = match &*mode.get("mode")? {
        "pairs" => Mode::Pairs,
        "all_pairs" => Mode::AllPairs,
        other => {
            return Err(PyValueError::new_err(format!(
                "mode: expected 'pairs' or 'all_pairs', got '{other}'"
            )))
        }
    };
    let found = match (batch("a", a)?, batch("b", b)?) {
        (Batch::Bytes(a), Batch::Bytes(b)) => {
            let (a, b) = (a.as_array(), b.as_array());
            detached(py, || costs(a, b, mode, blur))?
        }
        (Batch::Floats(a), Batch::Floats(b)) => {
            let (a, b) = (a.as_array(), b.as_array());
            detached(py, || costs(a, b, mode, blur))?
        }
        _ => Err(Error::invalid("b", "must have the dtype of a")),
    };
    Ok(found.map_err(to_py)?.into_pyarray(py))
}

/// Adds `image_cost` to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(image_cost, module)?)
}
