//! Arguments of the planners: whole numbers, seeds, earlier plans.

use hvf_core_rs::planner::BestOf;
use ndarray::{Array2, Array3, ArrayD, Axis, Ix2, Ix3};
use numpy::{AllowTypeChange, PyArrayLikeDyn, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;

use super::results::{PyPlan, PyPlans};

/// A Python integer of any size, to be checked against a range once its name is known.
#[derive(Clone, Copy)]
pub struct Whole(pub i128);

impl<'py> FromPyObject<'_, 'py> for Whole {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let found = object.get_type().name()?;
        let integer = object
            .call_method0("__index__")
            .map_err(|_| PyTypeError::new_err(format!("expected an integer, got {found}")))?;
        match integer.extract::<i128>() {
            Ok(value) => Ok(Self(value)),
            Err(_) => Ok(Self(if integer.lt(0)? { i128::MIN } else { i128::MAX })),
        }
    }
}

impl Whole {
    /// As a count.
    pub fn count(self, argument: &str) -> PyResult<usize> {
        usize::try_from(self.0).map_err(|_| {
            PyValueError::new_err(format!(
                "{argument}: must not be negative or huge, got {}",
                self.0
            ))
        })
    }

    /// As a seed.
    pub fn seed(self, argument: &str) -> PyResult<u64> {
        u64::try_from(self.0).map_err(|_| {
            PyValueError::new_err(format!(
                "{argument}: must be from 0 to 2**64 - 1, got {}",
                self.0
            ))
        })
    }
}

/// One seed for all problems or one for each; none is seed 0.
pub fn seeds(seeds: Option<&Bound<'_, PyAny>>, problems: usize) -> PyResult<Vec<u64>> {
    let Some(seeds) = seeds else {
        return Ok(vec![0; problems]);
    };
    if let Ok(seed) = seeds.extract::<Whole>() {
        return Ok(vec![seed.seed("seeds")?; problems]);
    }
    let list: Vec<Whole> = seeds.extract().map_err(|_| {
        PyTypeError::new_err("seeds: expected an integer, a sequence of integers, or None")
    })?;
    if list.len() != problems {
        let found = list.len();
        return Err(PyValueError::new_err(format!(
            "seeds: must be as many as goals ({problems}), got {found}"
        )));
    }
    list.into_iter().map(|seed| seed.seed("seeds")).collect()
}

/// A plan to start from: a `Plan` or actions `[H, A]`, as `[1, H, A]`.
pub fn one_warm_start(plan: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Array3<f32>>> {
    let Some(plan) = plan else {
        return Ok(None);
    };
    if let Ok(plan) = plan.cast::<PyPlan>() {
        return Ok(Some(plan.get().inner.actions.clone().insert_axis(Axis(0))));
    }
    let actions: Array2<f32> = floats(plan, "a Plan or a float array [H, A]")?
        .into_dimensionality::<Ix2>()
        .map_err(|_| PyValueError::new_err("warm_start: expected shape [H, A]"))?;
    Ok(Some(actions.insert_axis(Axis(0))))
}

/// Plans to start from: `Plans` or actions `[B, H, A]`.
pub fn warm_starts(plans: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Array3<f32>>> {
    let Some(plans) = plans else {
        return Ok(None);
    };
    if let Ok(plans) = plans.cast::<PyPlans>() {
        return Ok(Some(plans.get().stacked_actions()));
    }
    floats(plans, "Plans or a float array [B, H, A]")?
        .into_dimensionality::<Ix3>()
        .map(Some)
        .map_err(|_| PyValueError::new_err("warm_start: expected shape [B, H, A]"))
}

fn floats(object: &Bound<'_, PyAny>, expected: &str) -> PyResult<ArrayD<f32>> {
    let array: PyArrayLikeDyn<'_, f32, AllowTypeChange> = object.extract().map_err(|_| {
        let found = describe(object);
        PyTypeError::new_err(format!("warm_start: expected {expected}, got {found}"))
    })?;
    Ok(array.as_array().to_owned())
}

/// Which iterations an answer may come from, by name.
pub fn best_of(name: &str) -> PyResult<BestOf> {
    match name {
        "all" => Ok(BestOf::All),
        "last" => Ok(BestOf::Last),
        other => {
            Err(PyValueError::new_err(format!("best: must be 'all' or 'last', got '{other}'")))
        }
    }
}

/// The name of [`best_of`].
pub fn best_name(best: BestOf) -> &'static str {
    match best {
        BestOf::All => "all",
        BestOf::Last => "last",
    }
}

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
