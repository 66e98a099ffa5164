//! What is between the brackets of `frames[..]`.

use ndarray::{Dimension, Ix1};
use numpy::{PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyIndexError, PyOverflowError, PyTypeError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::PyString;

use super::arrays::{array, axes_of, numbers, numpy_array};
use super::Whole;

const EXPECTED: &str = "an integer, or integers [N]";

/// Places among `count` frames: of one integer, or of a list or an array of them; negative ones
/// count from the end.
///
/// # Errors
/// IndexError for a place that is not there, TypeError for what is no integer.
pub fn indices(index: &Bound<'_, PyAny>, count: usize) -> PyResult<Vec<usize>> {
    // What the planner asks with.
    if axes_of::<i64>(index) == Some(1) {
        let many = array::<i64, Ix1>("index", index, EXPECTED);
        if let Ok(many) = many {
            return many.as_array().iter().map(|&one| place(one.into(), count)).collect();
        }
    }
    let several = match index.cast::<PyUntypedArray>() {
        Ok(array) => array.ndim() > 0,
        Err(_) => has_items(index)?,
    };
    if !several {
        let one = index.extract::<Whole>()?.get("index").map_err(|exception| match exception
            .is_instance_of::<PyTypeError>(
            index.py(),
        ) {
            true => PyTypeError::new_err(super::unfit("index", EXPECTED, index)),
            false => exception,
        })?;
        return Ok(vec![place(one, count)?]);
    }
    let many = numpy_array("index", index, EXPECTED)?;
    let many = many.cast::<PyUntypedArray>()?;
    if many.ndim() != 1 {
        return Err(PyTypeError::new_err(super::unfit("index", EXPECTED, many)));
    }
    let kind: char = many.dtype().getattr("kind")?.extract()?;
    match kind {
        _ if many.len() == 0 => Ok(Vec::new()),
        'i' => all_places(numbers::<i64, Ix1>("index", many, EXPECTED)?, count),
        'u' => all_places(numbers::<u64, Ix1>("index", many, EXPECTED)?, count),
        _ => Err(PyTypeError::new_err(super::unfit("index", EXPECTED, many))),
    }
}

/// Whether an object is a sequence of indices rather than one.
fn has_items(index: &Bound<'_, PyAny>) -> PyResult<bool> {
    let py = index.py();
    if index.is_instance_of::<PyString>() || !index.hasattr(intern!(py, "__len__"))? {
        return Ok(false);
    }
    // A tensor without axes has a length, but only an error for it.
    match index.len() {
        Ok(_) => Ok(true),
        Err(exception) if exception.is_instance_of::<PyOverflowError>(py) => Ok(true),
        Err(exception) if super::is_no_such_thing(py, &exception) => Ok(false),
        Err(exception) => Err(exception),
    }
}

fn all_places<T: Into<i128>, D: Dimension>(
    index: ndarray::Array<T, D>,
    count: usize,
) -> PyResult<Vec<usize>> {
    index.into_iter().map(|one| place(one.into(), count)).collect()
}

fn place(index: i128, count: usize) -> PyResult<usize> {
    let from_start = if index < 0 { index.saturating_add(count as i128) } else { index };
    match usize::try_from(from_start) {
        Ok(place) if place < count => Ok(place),
        _ => Err(PyIndexError::new_err(format!("index: {index} is beyond {count} frames"))),
    }
}

/// One integer between brackets.
pub fn one_index(index: &Bound<'_, PyAny>, count: usize) -> PyResult<usize> {
    let given = index.extract::<Whole>()?;
    place(given.get("index")?, count)
}

/// The items of a list or another sequence, no more than one above `most`. It is asked for them one
/// by one: what it says of its length is not relied on.
pub fn items<'py>(
    argument: &str,
    object: &Bound<'py, PyAny>,
    expected: &str,
    most: usize,
) -> PyResult<Vec<Bound<'py, PyAny>>> {
    let wrong = || PyTypeError::new_err(super::unfit(argument, expected, object));
    if object.is_instance_of::<PyString>() {
        return Err(wrong());
    }
    let iterator = object.try_iter().map_err(|exception| {
        match super::is_no_such_thing(object.py(), &exception) {
            true => wrong(),
            false => exception,
        }
    })?;
    // Not collected: that asks for the length, and prints what the asking raises.
    let mut items = Vec::new();
    for item in iterator.take(most.saturating_add(1)) {
        items.push(item?);
    }
    Ok(items)
}

/// `N` whole numbers.
pub fn places<const N: usize>(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<[usize; N]> {
    let expected = format!("{N} integers");
    let given = items(argument, object, &expected, N)?;
    let counts: Vec<usize> = given
        .iter()
        .map(|item| item.extract::<Whole>()?.count(argument))
        .collect::<PyResult<_>>()?;
    counts.try_into().map_err(|_| PyValueError::new_err(super::unfit(argument, &expected, object)))
}
