//! Arrays: either NumPy's own memory of one dtype ([`array()`]) or a copy of whatever
//! `numpy.asarray` makes numbers of ([`numbers`]).

use ndarray::{Array, ArrayView, Dimension, Ix1};
use numpy::{
    Element, PyArray, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyReadonlyArray,
    PyUntypedArray, PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyException, PyMemoryError, PyOverflowError, PyTypeError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple};

use super::{describe, is_no_such_thing, unfit, wrong_type};

/// Most items of sequences that are no arrays.
const MOST_ITEMS: usize = 1 << 26;
/// Most axes of sequences in sequences.
const MOST_AXES: usize = 16;

/// NumPy's memory as it is. `expected` names dtype and axes, as in `uint8 [N, H, W, 3]`.
///
/// Refused with the one message `argument: expected .., got ..` are another dtype (TypeError),
/// another number of axes, and memory that Rust must not read as `T`: misaligned, or with steps
/// that are no multiple of an item, as in a field of a packed structure (ValueError).
pub fn array<'py, T: Element, D: Dimension>(
    argument: &str,
    object: &Bound<'py, PyAny>,
    expected: &str,
) -> PyResult<PyReadonlyArray<'py, T, D>> {
    let Ok(found) = object.cast::<PyUntypedArray>() else {
        return Err(wrong_type(argument, expected, object));
    };
    if !found.dtype().is_equiv_to(&T::get_dtype(object.py())) {
        return Err(wrong_type(argument, expected, object));
    }
    if D::NDIM != Some(found.ndim()) {
        return Err(PyValueError::new_err(unfit(argument, expected, object)));
    }
    let item = size_of::<T>() as isize;
    if !found.is_aligned() || found.strides().iter().any(|stride| stride % item != 0) {
        let problem = unfit(argument, expected, object);
        return Err(PyValueError::new_err(format!(
            "{problem} whose memory is misaligned or packed (numpy.array copies it)"
        )));
    }
    fits::<T>(argument, found.len(), object)?;
    let array =
        object.cast::<PyArray<T, D>>().map_err(|_| wrong_type(argument, expected, object))?;
    let borrowed = array.try_readonly();
    borrowed.map_err(|error| PyValueError::new_err(format!("{argument}: {error}")))
}

/// The number of axes of an object that is an array of `T`.
pub fn axes_of<T: Element>(object: &Bound<'_, PyAny>) -> Option<usize> {
    let array = object.cast::<PyUntypedArray>().ok()?;
    array.dtype().is_equiv_to(&T::get_dtype(object.py())).then(|| array.ndim())
}

/// A copy of a bool array. Its memory is read as bytes, since NumPy lets a bool be any byte.
pub fn booleans<D: Dimension>(
    argument: &str,
    object: &Bound<'_, PyAny>,
    expected: &str,
) -> PyResult<Array<bool, D>> {
    match axes_of::<bool>(object) {
        None => return Err(wrong_type(argument, expected, object)),
        Some(axes) if D::NDIM != Some(axes) => {
            return Err(PyValueError::new_err(unfit(argument, expected, object)))
        }
        Some(_) => {}
    }
    let found = object.cast::<PyUntypedArray>()?;
    fits::<bool>(argument, found.len(), object)?;
    let py = object.py();
    let ndarray = py.import(intern!(py, "numpy"))?.getattr(intern!(py, "ndarray"))?;
    let view = ndarray.call_method1(intern!(py, "view"), (object, intern!(py, "uint8")))?;
    let bytes = array::<u8, D>(argument, &view, expected)?;
    Ok(bytes.as_array().mapv(|byte| byte != 0))
}

/// A copy of anything that `numpy.asarray` makes an array of booleans, integers or floats of,
/// converted to `T`; `expected` names the axes, as in `a float array [N, 4]`.
pub fn numbers<T: Element + Copy, D: Dimension>(
    argument: &str,
    object: &Bound<'_, PyAny>,
    expected: &str,
) -> PyResult<Array<T, D>> {
    let py = object.py();
    let found = numpy_array(argument, object, expected)?;
    let found = found.cast::<PyUntypedArray>()?;
    if !['b', 'i', 'u', 'f'].contains(&kind(found)?) {
        return Err(wrong_type(argument, expected, found));
    }
    if D::NDIM != Some(found.ndim()) {
        return Err(PyValueError::new_err(unfit(argument, expected, found)));
    }
    // Only a broadcast array is larger than memory: refuse it before it is written out.
    fits::<T>(argument, found.len(), found)?;
    let plain = converted(found, T::get_dtype(py).as_any())?;
    let plain = array::<T, D>(argument, &plain, expected)?;
    copied(argument, plain.as_array(), object)
}

/// An array in NumPy's plain order and of a dtype. What is beyond the range of the dtype becomes
/// infinite, without the warning that programs may have made an exception.
fn converted<'py>(
    array: &Bound<'py, PyUntypedArray>,
    dtype: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    let py = array.py();
    let numpy = py.import(intern!(py, "numpy"))?;
    let options = PyDict::new(py);
    options.set_item(intern!(py, "dtype"), dtype)?;
    options.set_item(intern!(py, "requirements"), ("C", "A"))?;
    let quiet = PyDict::new(py);
    quiet.set_item(intern!(py, "all"), intern!(py, "ignore"))?;
    let quiet = numpy.call_method(intern!(py, "errstate"), (), Some(&quiet))?;
    quiet.call_method0(intern!(py, "__enter__"))?;
    let plain = numpy.call_method(intern!(py, "require"), (array,), Some(&options));
    quiet.call_method1(intern!(py, "__exit__"), (py.None(), py.None(), py.None()))?;
    plain
}

/// `N` numbers.
pub fn point<const N: usize>(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<[f32; N]> {
    let expected = format!("{N} numbers");
    let found = numbers::<f32, Ix1>(argument, object, &expected)?;
    let point = found.to_vec().try_into();
    point.map_err(|_| PyValueError::new_err(unfit(argument, &expected, object)))
}

/// What `numpy.asarray` makes of an object, of whatever dtype.
pub fn numpy_array<'py>(
    argument: &str,
    object: &Bound<'py, PyAny>,
    expected: &str,
) -> PyResult<Bound<'py, PyAny>> {
    if object.is_instance_of::<PyUntypedArray>() {
        return Ok(object.clone());
    }
    let py = object.py();
    let items =
        as_lists(argument, object).map_err(|exception| match is_no_such_thing(py, &exception) {
            true => wrong_type(argument, expected, object),
            false => exception,
        })?;
    let numpy = py.import(intern!(py, "numpy"))?;
    let made = numpy.call_method1(intern!(py, "asarray"), (items,));
    made.map_err(|exception| {
        let complaint = if is_no_such_thing(py, &exception) {
            wrong_type(argument, expected, object)
        } else if exception.is_instance_of::<PyOverflowError>(py)
            || exception.get_type(py).is(py.get_type::<PyValueError>())
        {
            PyValueError::new_err(unfit(argument, expected, object))
        } else {
            return exception;
        };
        complaint.set_cause(py, Some(exception));
        complaint
    })
}

/// `object`, with every sequence in it that is no array as a list, of as many items as it says it
/// has: `numpy.asarray` would ask some for ever.
pub fn as_lists<'py>(argument: &str, object: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    Lists { argument, left: MOST_ITEMS }.of(object, 0)
}

struct Lists<'a> {
    argument: &'a str,
    /// Items that all of them together may still have.
    left: usize,
}

impl Lists<'_> {
    /// `object`, with what is a sequence in it, at whatever depth, as a list.
    fn of<'py>(&mut self, object: &Bound<'py, PyAny>, depth: usize) -> PyResult<Bound<'py, PyAny>> {
        let py = object.py();
        if object.is_exact_instance_of::<PyFloat>()
            || object.is_exact_instance_of::<PyInt>()
            || object.is_instance_of::<PyString>()
            || object.is_instance_of::<PyBytes>()
            || object.is_instance_of::<PyUntypedArray>()
        {
            return Ok(object.clone());
        }
        if !(object.is_instance_of::<PyList>() || object.is_instance_of::<PyTuple>()) {
            for array in ["__array__", "__array_interface__", "__array_struct__", "__dlpack__"] {
                if object.hasattr(array)? {
                    return Ok(object.clone());
                }
            }
            if !(object.hasattr(intern!(py, "__len__"))?
                && object.hasattr(intern!(py, "__getitem__"))?)
            {
                return Ok(object.clone());
            }
        }
        let count = match object.len() {
            Ok(count) => count,
            Err(exception) if exception.is_instance_of::<PyOverflowError>(py) => usize::MAX,
            Err(exception) => return Err(exception),
        };
        let argument = self.argument;
        if depth == MOST_AXES {
            let problem = format!("{argument}: must have at most {MOST_AXES} axes");
            return Err(PyValueError::new_err(problem));
        }
        let Some(left) = self.left.checked_sub(count) else {
            let found = describe(object);
            let problem = format!("{argument}: {found} of {count} items is too long");
            return Err(PyValueError::new_err(problem));
        };
        self.left = left;
        let items = PyList::empty(py);
        for item in object.try_iter()?.take(count) {
            items.append(self.of(&item?, depth + 1)?)?;
        }
        Ok(items.into_any())
    }
}

/// The letter of an array's dtype: `f` for floats of any size, and so on.
fn kind(array: &Bound<'_, PyUntypedArray>) -> PyResult<char> {
    let py = array.py();
    array.getattr(intern!(py, "dtype"))?.getattr(intern!(py, "kind"))?.extract()
}

/// A copy of a view, or a MemoryError.
fn copied<T: Copy, D: Dimension>(
    argument: &str,
    view: ArrayView<'_, T, D>,
    object: &Bound<'_, PyAny>,
) -> PyResult<Array<T, D>> {
    let mut values = Vec::new();
    values.try_reserve_exact(view.len()).map_err(|_| no_memory(argument, object))?;
    values.extend(view.iter().copied());
    Array::from_shape_vec(view.raw_dim(), values)
        .map_err(|error| PyValueError::new_err(format!("{argument}: {error}")))
}

/// A MemoryError where `count` values of `T` do not fit into memory: a broadcast array says that
/// it has more of them than it holds.
pub fn fits<T>(argument: &str, count: usize, object: &Bound<'_, PyAny>) -> PyResult<()> {
    Vec::<T>::new().try_reserve_exact(count).map_err(|_| no_memory(argument, object))
}

fn no_memory(argument: &str, object: &Bound<'_, PyAny>) -> PyErr {
    PyMemoryError::new_err(format!("{argument}: {} does not fit into memory", describe(object)))
}

/// A new array with undefined content. `argument` is what makes it as large as it is: NumPy
/// refuses shapes that no array can have (ValueError) or that memory has no room for
/// (MemoryError).
pub fn new_array<'py, T: Element>(
    py: Python<'py>,
    argument: &str,
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    let numpy = py.import(intern!(py, "numpy"))?;
    let made = numpy.call_method1(intern!(py, "empty"), (shape, T::get_dtype(py)));
    let array = made.map_err(|exception| {
        if !exception.is_instance_of::<PyException>(py) {
            return exception;
        }
        let problem = format!("{argument}: {}", exception.value(py));
        let complaint = match exception.is_instance_of::<PyMemoryError>(py) {
            true => PyMemoryError::new_err(problem),
            false => PyValueError::new_err(problem),
        };
        complaint.set_cause(py, Some(exception));
        complaint
    })?;
    array.cast_into::<PyArrayDyn<T>>().map_err(|_| {
        PyTypeError::new_err("numpy.empty: expected it to give an array of the dtype asked for")
    })
}
