//! Any Python object with the methods of `hvf.protocols.WorldModel` as a world model.
//!
//! Candidate actions are handed over: the array that the model gets owns the memory they were
//! drawn into. Costs, 4 bytes per candidate, are copied once out of an array that the model may
//! go on writing to.

use hvf_core_rs::planner::{ActionSpace, Frames, WorldModel};
use hvf_core_rs::{Error, Result};
use ndarray::{Array2, Array3, Array4, Ix2};
use numpy::{
    AllowTypeChange, IntoPyArray, PyArray2, PyArray3, PyArray4, PyArrayLike1, PyArrayMethods,
    PyUntypedArray, PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::PyString;

use super::arguments::{describe, Whole};
use super::border::{as_images, images_of, is_native_frames, Border};
use super::raised;
use crate::error::to_py;

/// Frames of a Python world: any object with `len()` that an int64 array indexes.
pub struct PythonFrames {
    object: Py<PyAny>,
    len: usize,
}

impl PythonFrames {
    fn new(argument: &str, object: Bound<'_, PyAny>) -> PyResult<Self> {
        let Ok(len) = object.len() else {
            return Err(PyTypeError::new_err(format!(
                "{argument}: expected frames with len() and frames[index], got {}",
                describe(&object)
            )));
        };
        Ok(Self { object: object.unbind(), len })
    }
}

impl Clone for PythonFrames {
    fn clone(&self) -> Self {
        Python::attach(|py| Self { object: self.object.clone_ref(py), len: self.len })
    }
}

impl Frames for PythonFrames {
    fn len(&self) -> usize {
        self.len
    }

    fn select(&self, index: &[usize]) -> Result<Self> {
        let selected = Python::attach(|py| {
            let numbers: Vec<i64> = index.iter().map(|&frame| frame as i64).collect();
            let selected = self.object.bind(py).get_item(numbers.into_pyarray(py))?;
            Self::new("frames[index]", selected)
        })
        .map_err(raised)?;
        if selected.len != index.len() {
            return Err(Error::Model(format!(
                "frames[index] must hold the {} frames of the index, got {}",
                index.len(),
                selected.len
            )));
        }
        Ok(selected)
    }
}

/// A world model written in Python.
pub struct PythonWorld {
    object: Py<PyAny>,
    actions: ActionSpace,
    max_candidates: usize,
    shares_rollouts: bool,
    observes: bool,
}

impl PythonWorld {
    /// Reads the attributes of a model.
    pub fn new(object: &Bound<'_, PyAny>) -> PyResult<Self> {
        let py = object.py();
        let has = |name: &Bound<'_, PyString>| -> PyResult<bool> {
            Ok(object.getattr_opt(name)?.is_some_and(|value| !value.is_none()))
        };
        for name in ["action_low", "action_high", "rollout_costs"] {
            if !has(&PyString::new(py, name))? {
                return Err(PyTypeError::new_err(format!(
                    "model: must have action_low, action_high and rollout_costs(starts, goals, \
                     actions); {} has no {name}",
                    describe(object)
                )));
            }
        }
        let corner = |name: &str| -> PyResult<Vec<f32>> {
            let value = object.getattr(name)?;
            let array: PyArrayLike1<'_, f32, AllowTypeChange> = value.extract().map_err(|_| {
                PyTypeError::new_err(format!(
                    "model.{name}: expected a float array [A], got {}",
                    describe(&value)
                ))
            })?;
            Ok(array.as_array().to_vec())
        };
        let actions = ActionSpace::new(corner("action_low")?, corner("action_high")?)
            .map_err(|error| PyValueError::new_err(format!("model.{}", to_py(error).value(py))))?;
        let max_candidates = match object.getattr_opt(intern!(py, "max_candidates"))? {
            Some(most) if !most.is_none() => {
                most.extract::<Whole>()?.count("model.max_candidates")?
            }
            _ => DEFAULT_MAX_CANDIDATES,
        };
        Ok(Self {
            actions,
            max_candidates,
            shares_rollouts: has(intern!(py, "shared_rollout_costs"))?,
            observes: has(intern!(py, "observe"))?,
            object: object.clone().unbind(),
        })
    }
}

/// Candidates in one call where the model does not say: enough to fill the cores of a host.
const DEFAULT_MAX_CANDIDATES: usize = 1 << 16;

impl WorldModel for PythonWorld {
    type Frames = PythonFrames;

    fn action_space(&self) -> &ActionSpace {
        &self.actions
    }

    fn max_candidates(&self) -> usize {
        self.max_candidates
    }

    fn rollout_costs(
        &self,
        starts: &PythonFrames,
        goals: &PythonFrames,
        actions: Array4<f32>,
    ) -> Result<Array2<f32>> {
        let (problems, samples, _, _) = actions.dim();
        Python::attach(|py| {
            let arguments =
                (&starts.object, &goals.object, PyArray4::from_owned_array(py, actions));
            let costs =
                self.object.bind(py).call_method1(intern!(py, "rollout_costs"), arguments)?;
            read_costs("rollout_costs", &costs, (problems, samples))
        })
        .map_err(raised)?
    }

    fn shared_rollout_costs(
        &self,
        start: &PythonFrames,
        goals: &PythonFrames,
        actions: Array3<f32>,
    ) -> Option<Result<Array2<f32>>> {
        if !self.shares_rollouts {
            return None;
        }
        let (samples, _, _) = actions.dim();
        let costs = Python::attach(|py| {
            let arguments = (&start.object, &goals.object, PyArray3::from_owned_array(py, actions));
            let method = intern!(py, "shared_rollout_costs");
            let costs = self.object.bind(py).call_method1(method, arguments)?;
            read_costs("shared_rollout_costs", &costs, (goals.len, samples))
        });
        Some(costs.map_err(raised).and_then(|costs| costs))
    }
}

/// Costs `[B, D]` from what a model returned: float32 as it is, other numbers converted.
fn read_costs(
    method: &str,
    returned: &Bound<'_, PyAny>,
    expected: (usize, usize),
) -> PyResult<Result<Array2<f32>>> {
    let wrong = |found: String| {
        let (problems, samples) = expected;
        Error::Model(format!(
            "{method} must return float32 costs [B, D] = [{problems}, {samples}], got {found}"
        ))
    };
    if let Ok(costs) = returned.cast::<PyArray2<f32>>() {
        let costs = costs.readonly();
        return Ok(match costs.as_array() {
            view if view.dim() == expected => Ok(view.to_owned()),
            _ => Err(wrong(describe(returned))),
        });
    }
    let py = returned.py();
    let array =
        py.import(intern!(py, "numpy"))?.call_method1(intern!(py, "asarray"), (returned,))?;
    let kind: String =
        array.getattr(intern!(py, "dtype"))?.getattr(intern!(py, "kind"))?.extract()?;
    let shape = array.cast::<PyUntypedArray>()?.shape().to_vec();
    if !["f", "i", "u"].contains(&kind.as_str()) || shape != [expected.0, expected.1] {
        return Ok(Err(wrong(describe(&array))));
    }
    let floats: numpy::PyArrayLikeDyn<'_, f32, AllowTypeChange> = array.extract()?;
    Ok(floats
        .as_array()
        .to_owned()
        .into_dimensionality::<Ix2>()
        .map_err(|_| wrong(describe(&array))))
}

impl Border for PythonWorld {
    type World = Self;

    fn world(&self) -> &Self {
        self
    }

    fn model(&self) -> &Py<PyAny> {
        &self.object
    }

    /// Images go through the model's `observe`, if it has one; so do a native world's frames.
    fn read(&self, argument: &str, object: &Bound<'_, PyAny>) -> PyResult<PythonFrames> {
        let py = object.py();
        let images = if self.observes && is_native_frames(object) {
            images_of(object)?
        } else {
            as_images(object)?
        };
        let frames = match images {
            Some(images) if self.observes => {
                self.object.bind(py).call_method1(intern!(py, "observe"), (images,))?
            }
            Some(images) => images,
            None => object.clone(),
        };
        PythonFrames::new(argument, frames)
    }

    fn write<'py>(&self, py: Python<'py>, frames: PythonFrames) -> PyResult<Bound<'py, PyAny>> {
        Ok(frames.object.into_bound(py))
    }
}
