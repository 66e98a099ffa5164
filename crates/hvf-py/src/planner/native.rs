//! The native world behind a Python object, and whose word counts where both have one.

use pyo3::exceptions::PyTypeError;
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyString, PyType};

/// What is not called on an object whose native world is planned with.
const UNASKED: [&str; 3] = ["rollout_costs", "shared_rollout_costs", "prepare"];

/// `model.native` where there is one, else the model itself.
///
/// The planner asks the native world for costs, never the object around it. So a class that has
/// both says which native world its methods speak for: it defines `native` in its body, as a
/// property or a class attribute. Costs of an object itself, or of a class that comes before that
/// one, would be ignored in silence.
///
/// # Errors
/// A TypeError for methods that would be ignored.
pub fn native_of<'py>(model: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let name = intern!(model.py(), "native");
    match model.getattr_opt(name)?.filter(|native| !native.is_none()) {
        Some(native) => {
            check_unasked(model, name)?;
            Ok(native)
        }
        None => Ok(model.clone()),
    }
}

fn check_unasked(model: &Bound<'_, PyAny>, native: &Bound<'_, PyString>) -> PyResult<()> {
    // A class may be planned with as well: then its own body is what an object's is.
    let own = model.getattr_opt(intern!(model.py(), "__dict__"))?;
    for method in UNASKED {
        if let Some(own) = &own {
            if own.contains(method)? {
                return Err(ignored(&model.get_type(), method));
            }
        }
    }
    for class in model.get_type().mro() {
        let body = class.getattr(intern!(class.py(), "__dict__"))?;
        if body.contains(native)? {
            return Ok(());
        }
        for method in UNASKED {
            if body.contains(method)? {
                return Err(ignored(class.cast::<PyType>()?, method));
            }
        }
    }
    Ok(())
}

fn ignored(class: &Bound<'_, PyType>, method: &str) -> PyErr {
    let class = match class.name() {
        Ok(name) => name.to_string_lossy().into_owned(),
        Err(exception) => return exception,
    };
    PyTypeError::new_err(format!(
        "model: {method} of {class} would not be called, since native is planned with; define \
         native in the body of {class} if it speaks for it, or set native = None to plan with \
         {method}"
    ))
}
