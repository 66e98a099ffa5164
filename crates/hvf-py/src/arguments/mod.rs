//! Arguments from Python: whole numbers, numbers, names, arrays, indices.
//!
//! Whatever comes in is either what is asked for or one ValueError or TypeError that begins with
//! the argument's name. PyO3 gives a name to what it refuses by a note on the exception, which
//! Python 3.10 does not have; so nothing is refused while arguments are taken apart ([`Given`]),
//! but where the name is at hand. What an argument's own methods raise (Ctrl-C in an `__index__`)
//! comes back as it is.

mod arrays;
mod given;
mod indices;

pub use arrays::{array, as_lists, axes_of, booleans, new_array, numbers, point};
pub use given::{text, Flag, Given, Real, Text, Whole};
pub use indices::{indices, items, one_index, places};

use numpy::{PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyAttributeError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::PyTypeInfo;

/// Most planning problems of one call.
const MOST_PROBLEMS: usize = 1 << 20;

/// What an object is, in an error: its type, and for an array its dtype and shape.
pub fn describe(object: &Bound<'_, PyAny>) -> String {
    match object.cast::<PyUntypedArray>() {
        Ok(array) => format!("a {} array {:?}", array.dtype(), array.shape()),
        Err(_) => match object.get_type().fully_qualified_name() {
            Ok(name) => format!("{name}"),
            Err(_) => "an object without a type name".into(),
        },
    }
}

/// `argument: expected .., got ..`
pub fn unfit(argument: &str, expected: &str, object: &Bound<'_, PyAny>) -> String {
    format!("{argument}: expected {expected}, got {}", describe(object))
}

/// A TypeError of [`unfit`].
pub fn wrong_type(argument: &str, expected: &str, object: &Bound<'_, PyAny>) -> PyErr {
    PyTypeError::new_err(unfit(argument, expected, object))
}

/// Whether an exception only says that an object has no such method, or that it gives nonsense.
fn is_no_such_thing(py: Python<'_>, exception: &PyErr) -> bool {
    exception.is_instance_of::<PyTypeError>(py) || exception.is_instance_of::<PyAttributeError>(py)
}

/// An object of one of this module's classes.
pub fn instance<'a, 'py, T: PyTypeInfo>(
    argument: &str,
    object: &'a Bound<'py, PyAny>,
) -> PyResult<&'a Bound<'py, T>> {
    match object.cast::<T>() {
        Ok(object) => Ok(object),
        Err(_) => {
            let class = T::type_object(object.py()).name()?;
            Err(wrong_type(argument, &class.to_string_lossy(), object))
        }
    }
}

/// Refuses more planning problems than could be meant, before anything is made for them.
pub fn check_problems(argument: &str, count: usize) -> PyResult<usize> {
    if count <= MOST_PROBLEMS {
        return Ok(count);
    }
    Err(PyValueError::new_err(format!(
        "{argument}: must hold at most {MOST_PROBLEMS} frames, got {count}"
    )))
}
