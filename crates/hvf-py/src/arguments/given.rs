//! Arguments that are no arrays, kept until their names are known.

use std::borrow::Cow;

use numpy::{PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyOverflowError, PyTypeError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyComplex, PyInt, PyString};

use super::{describe, is_no_such_thing};

/// An argument, or what is wrong with it. Taking one never fails: [`get`](Self::get) does.
pub struct Given<T>(Result<T, Unfit>);

/// What is wrong with an argument.
enum Unfit {
    /// It is of the wrong kind; what was expected and what was found.
    Kind(String),
    /// It is out of range.
    Range(String),
    /// One of its own methods raised this.
    Raised(PyErr),
}

/// An integer of any size.
pub type Whole = Given<i128>;
/// A number.
pub type Real = Given<f64>;
/// A name.
pub type Text = Given<Cow<'static, str>>;
/// True or false.
pub type Flag = Given<bool>;

/// The name `name`, as a default.
pub fn text(name: &'static str) -> Text {
    Given::of(Cow::Borrowed(name))
}

impl<T> Given<T> {
    /// A value that the user did not give: a default.
    pub fn of(value: T) -> Self {
        Self(Ok(value))
    }

    /// The value.
    pub fn get(self, argument: &str) -> PyResult<T> {
        self.0.map_err(|unfit| match unfit {
            Unfit::Kind(problem) => PyTypeError::new_err(format!("{argument}: {problem}")),
            Unfit::Range(problem) => PyValueError::new_err(format!("{argument}: {problem}")),
            Unfit::Raised(exception) => exception,
        })
    }
}

impl Whole {
    /// As a count.
    pub fn count(self, argument: &str) -> PyResult<usize> {
        let value = self.get(argument)?;
        usize::try_from(value).map_err(|_| {
            let shown = shown(value);
            PyValueError::new_err(format!("{argument}: must not be negative or huge, got {shown}"))
        })
    }

    /// As a count that may have at most 13 digits: more are no memory's.
    pub fn amount(self, argument: &str) -> PyResult<usize> {
        let count = self.count(argument)?;
        if count > 1 << 40 {
            return Err(PyValueError::new_err(format!("{argument}: {count} is too many")));
        }
        Ok(count)
    }

    /// As a seed or another number of 64 bits.
    pub fn seed(self, argument: &str) -> PyResult<u64> {
        let value = self.get(argument)?;
        u64::try_from(value).map_err(|_| {
            let shown = shown(value);
            PyValueError::new_err(format!("{argument}: must be from 0 to 2**64 - 1, got {shown}"))
        })
    }
}

impl Real {
    /// In single precision; what is beyond its range becomes infinite.
    pub fn single(self, argument: &str) -> PyResult<f32> {
        Ok(self.get(argument)? as f32)
    }
}

/// An integer in a message: those beyond 128 bits were cut.
fn shown(value: i128) -> String {
    match value {
        i128::MIN => "a number below -2**127".into(),
        i128::MAX => "a number above 2**127".into(),
        value => value.to_string(),
    }
}

impl<'py> FromPyObject<'_, 'py> for Whole {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        Ok(Self(whole(&object)))
    }
}

fn whole(object: &Bound<'_, PyAny>) -> Result<i128, Unfit> {
    let py = object.py();
    let integer = match object.cast::<PyInt>() {
        Ok(integer) => integer.clone().into_any(),
        Err(_) => py
            .import(intern!(py, "operator"))
            .and_then(|operator| operator.call_method1(intern!(py, "index"), (object,)))
            .map_err(|exception| refusal(exception, "an integer", object))?,
    };
    match integer.extract::<i128>() {
        Ok(value) => Ok(value),
        Err(_) => match integer.lt(0) {
            Ok(negative) => Ok(if negative { i128::MIN } else { i128::MAX }),
            Err(exception) => Err(Unfit::Raised(exception)),
        },
    }
}

impl<'py> FromPyObject<'_, 'py> for Real {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        Ok(Self(real(&object)))
    }
}

fn real(object: &Bound<'_, PyAny>) -> Result<f64, Unfit> {
    let py = object.py();
    if is_complex(object).map_err(Unfit::Raised)? {
        return Err(Unfit::Kind(format!("expected a number, got {}", describe(object))));
    }
    object.extract::<f64>().map_err(|exception| {
        if exception.is_instance_of::<PyOverflowError>(py) {
            return Unfit::Range("must be within the range of a float".into());
        }
        refusal(exception, "a number", object)
    })
}

/// Whether a number has an imaginary part, which NumPy's scalars would lose with a warning, or is
/// an array, of which a single number is not meant.
fn is_complex(object: &Bound<'_, PyAny>) -> PyResult<bool> {
    if object.is_instance_of::<PyComplex>() {
        return Ok(true);
    }
    if let Ok(array) = object.cast::<PyUntypedArray>() {
        if array.ndim() > 0 {
            return Ok(true);
        }
    }
    let py = object.py();
    let Some(dtype) = object.getattr_opt(intern!(py, "dtype"))? else {
        return Ok(false);
    };
    match dtype.getattr_opt(intern!(py, "kind"))? {
        Some(kind) => kind.eq("c"),
        None => Ok(false),
    }
}

impl<'py> FromPyObject<'_, 'py> for Text {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        Ok(Self(match object.cast::<PyString>() {
            // A lone surrogate is in no name that is known here.
            Ok(name) => Ok(Cow::Owned(name.to_string_lossy().into_owned())),
            Err(_) => Err(Unfit::Kind(format!("expected a string, got {}", describe(&object)))),
        }))
    }
}

impl<'py> FromPyObject<'_, 'py> for Flag {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let value = object.extract::<bool>();
        Ok(Self(value.map_err(|exception| refusal(exception, "True or False", &object))))
    }
}

/// An exception while an argument was read: a complaint about its kind, or its own.
fn refusal(exception: PyErr, expected: &str, object: &Bound<'_, PyAny>) -> Unfit {
    if is_no_such_thing(object.py(), &exception) {
        return Unfit::Kind(format!("expected {expected}, got {}", describe(object)));
    }
    Unfit::Raised(exception)
}
