//! Costs, of candidates `[B, D]` or of segments `[M, K + 1]`, and proposals, out of what a model written in Python returned.
//!
//! A float32 array is copied once (4 bytes per candidate), since the model may go on writing to
//! it. Tensors are detached from their graph and moved to the host by the methods that they have
//! for it, so that this module need not know torch or any other library of arrays.

use ndarray::{Array2, Ix2};
use numpy::{PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyException, PyMemoryError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arguments::{array, as_lists, describe, numbers};

/// Costs of the shape `expected`, whose axes are called `axes`: float32 as it is, other real numbers converted.
///
/// # Errors
/// A ValueError that names `model` and `method`; what kept the costs from being read is its
/// cause.
pub fn read_costs(
    model: &Bound<'_, PyAny>,
    method: &str,
    returned: &Bound<'_, PyAny>,
    axes: &str,
    expected: (usize, usize),
) -> PyResult<Array2<f32>> {
    read_numbers(model, method, "costs", returned, axes, expected)
}

/// The same for other numbers, which are called `what`.
///
/// # Errors
/// As [`read_costs`].
pub fn read_numbers(
    model: &Bound<'_, PyAny>,
    method: &str,
    what: &str,
    returned: &Bound<'_, PyAny>,
    axes: &str,
    expected: (usize, usize),
) -> PyResult<Array2<f32>> {
    let wrong = |found: String| match model.get_type().name() {
        Ok(model) => PyValueError::new_err(format!(
            "model {model}: {method} must return float32 {what} {axes} = [{}, {}], got {found}",
            expected.0, expected.1
        )),
        Err(exception) => exception,
    };
    if let Ok(costs) = array::<f32, Ix2>(method, returned, what) {
        return match costs.as_array() {
            view if view.dim() == expected => Ok(view.to_owned()),
            _ => Err(wrong(describe(returned))),
        };
    }
    let costs = match on_the_host(returned) {
        Ok(costs) => costs,
        Err(exception) => return Err(explained(exception, returned, wrong)),
    };
    let py = returned.py();
    let kind: String =
        costs.getattr(intern!(py, "dtype"))?.getattr(intern!(py, "kind"))?.extract()?;
    let shape = costs.cast::<PyUntypedArray>()?.shape();
    if !["f", "i", "u"].contains(&kind.as_str()) || shape != [expected.0, expected.1] {
        return Err(wrong(describe(&costs)));
    }
    numbers(method, &costs, what)
}

/// What a model returned as a NumPy array.
fn on_the_host<'py>(returned: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let py = returned.py();
    let mut costs = returned.clone();
    for method in [intern!(py, "detach"), intern!(py, "cpu")] {
        if let Some(convert) = costs.getattr_opt(method)? {
            costs = convert.call0()?;
        }
    }
    let costs = as_lists("costs", &costs)?;
    let numpy = py.import(intern!(py, "numpy"))?;
    let refused = match numpy.call_method1(intern!(py, "asarray"), (&costs,)) {
        Ok(array) => return Ok(array),
        Err(exception) => exception,
    };
    // A number that NumPy has no name for, such as torch's bfloat16.
    if let Some(float) = costs.getattr_opt(intern!(py, "float"))? {
        return numpy.call_method1(intern!(py, "asarray"), (float.call0()?,));
    }
    // An array on a device that says so by the standard only. NumPy before 2.1 cannot ask for a
    // copy on the host.
    if costs.hasattr(intern!(py, "__dlpack__"))? {
        let on_host = PyDict::new(py);
        on_host.set_item(intern!(py, "device"), intern!(py, "cpu"))?;
        let copied = numpy.call_method(intern!(py, "from_dlpack"), (&costs,), Some(&on_host));
        return copied.map_err(|_| refused);
    }
    Err(refused)
}

/// An exception on the way to the host, with the model and the method that it is about; what is
/// no mistake in the costs (Ctrl-C, no memory left) as it is.
fn explained(
    exception: PyErr,
    returned: &Bound<'_, PyAny>,
    wrong: impl FnOnce(String) -> PyErr,
) -> PyErr {
    let py = returned.py();
    let ours = exception.is_instance_of::<PyException>(py)
        && !exception.is_instance_of::<PyMemoryError>(py);
    if !ours {
        return exception;
    }
    let found = format!("{}, which gave {exception}", describe(returned));
    let explained = wrong(found);
    explained.set_cause(py, Some(exception));
    explained
}
