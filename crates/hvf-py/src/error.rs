//! How errors of `hvf-core` reach Python.

use hvf_core_rs::Error;
use pyo3::exceptions::{PyKeyboardInterrupt, PyValueError};
use pyo3::PyErr;

/// `ValueError` for bad input and bad models; a Python exception raised inside a model comes
/// back as itself.
pub fn to_py(error: Error) -> PyErr {
    match error {
        Error::Interrupted => PyKeyboardInterrupt::new_err("interrupted"),
        Error::External(inner) => match inner.downcast::<PyErr>() {
            Ok(raised) => *raised,
            Err(other) => PyValueError::new_err(other.to_string()),
        },
        other => PyValueError::new_err(other.to_string()),
    }
}
