//! Any Python object with the methods of `hvf.protocols.WorldModel` as a world model.
//!
//! Candidate actions are handed over: the array that the model gets owns the memory they were
//! drawn into. What comes back is read by [`returned_costs`](super::returned_costs).

use hvf_core_rs::planner::{ActionSpace, Candidates, Frames, SharedCandidates, WorldModel};
use hvf_core_rs::{Error, Result};
use ndarray::{Array2, Ix1};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyArray4, PyUntypedArray};
use pyo3::exceptions::{PyAttributeError, PyOverflowError, PyTypeError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PySlice, PyString, PyTuple};
use pyo3::PyTypeInfo;

use super::border::{as_images, images_of, is_native_frames, Axes, Border};
use super::raised;
use super::returned_costs::read_costs;
use crate::arguments::{describe, numbers, wrong_type, Whole};
use crate::error::to_py;

/// Frames of a Python world: any object with `len()` that an int64 array indexes.
pub struct PythonFrames {
    object: Py<PyAny>,
    len: usize,
}

impl PythonFrames {
    fn new(argument: &str, object: Bound<'_, PyAny>) -> PyResult<Self> {
        let py = object.py();
        let len = object.len().map_err(|exception| {
            if exception.is_instance_of::<PyTypeError>(py)
                || exception.is_instance_of::<PyAttributeError>(py)
            {
                return PyTypeError::new_err(format!(
                    "{argument}: expected frames with len() and frames[index], got {}",
                    describe(&object)
                ));
            }
            // Python's own word for a length beyond 63 bits.
            if exception.is_instance_of::<PyOverflowError>(py) {
                let found = describe(&object);
                return PyValueError::new_err(format!("{argument}: the length of {found} is huge"));
            }
            exception
        })?;
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

    fn join(parts: &[&Self]) -> Option<Result<Self>> {
        let joined = Python::attach(|py| {
            let objects: Vec<&Bound<'_, PyAny>> =
                parts.iter().map(|part| part.object.bind(py)).collect();
            joined(py, &objects)?.map(|joined| Self::new("frames.join", joined)).transpose()
        });
        let expected: usize = parts.iter().map(|part| part.len).sum();
        match joined.map_err(raised) {
            Ok(Some(joined)) if joined.len != expected => Some(Err(Error::Model(format!(
                "join must give the {expected} frames of its parts, got {}",
                joined.len
            )))),
            other => other.transpose(),
        }
    }
}

/// Frames one after another: by the `join` of their class, or of NumPy or torch where they are all
/// arrays or tensors of one kind; `None` for others.
fn joined<'py>(
    py: Python<'py>,
    parts: &[&Bound<'py, PyAny>],
) -> PyResult<Option<Bound<'py, PyAny>>> {
    let class = parts[0].get_type();
    if parts.iter().any(|part| !part.get_type().is(&class)) {
        return Ok(None);
    }
    let kind = |part: &Bound<'py, PyAny>, with_device: bool| -> PyResult<Bound<'py, PyTuple>> {
        let rest =
            part.getattr(intern!(py, "shape"))?.get_item(PySlice::new(py, 1, isize::MAX, 1))?;
        let dtype = part.getattr(intern!(py, "dtype"))?;
        let device = match with_device {
            true => part.getattr(intern!(py, "device"))?,
            false => py.None().into_bound(py),
        };
        (rest, dtype, device).into_pyobject(py)
    };
    let of_one_kind = |with_device: bool| -> PyResult<bool> {
        let first = kind(parts[0], with_device)?;
        for part in &parts[1..] {
            if !first.eq(kind(part, with_device)?)? {
                return Ok(false);
            }
        }
        Ok(true)
    };
    if class.is(PyUntypedArray::type_object(py)) {
        return match of_one_kind(false)? {
            true => py.import("numpy")?.call_method1("concatenate", (parts,)).map(Some),
            false => Ok(None),
        };
    }
    if let Some(join) = class.getattr_opt(intern!(py, "join"))? {
        return join.call1((PyList::new(py, parts)?,)).map(Some);
    }
    // A tensor can only come from a torch that is there already.
    let modules = py.import("sys")?.getattr("modules")?;
    if let Ok(torch) = modules.get_item("torch") {
        if class.is(torch.getattr("Tensor")?) && of_one_kind(true)? {
            return torch.call_method1("cat", (PyList::new(py, parts)?,)).map(Some);
        }
    }
    Ok(None)
}

/// A world model written in Python.
pub struct PythonWorld {
    object: Py<PyAny>,
    actions: ActionSpace,
    max_candidates: usize,
    uses_seeds: bool,
    pads: bool,
    prepares: bool,
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
            let corner =
                numbers::<f32, Ix1>(&format!("model.{name}"), &value, "a float array [A]")?;
            Ok(corner.to_vec())
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
            uses_seeds: flag(object, "uses_seeds")?,
            pads: flag(object, "pads")?,
            prepares: has(intern!(py, "prepare"))?,
            shares_rollouts: has(intern!(py, "shared_rollout_costs"))?,
            observes: has(intern!(py, "observe"))?,
            object: object.clone().unbind(),
        })
    }
}

/// An attribute that is true or false, and false where there is none.
fn flag(object: &Bound<'_, PyAny>, name: &str) -> PyResult<bool> {
    let py = object.py();
    let Some(value) = object.getattr_opt(PyString::new(py, name))? else {
        return Ok(false);
    };
    value.is_truthy().map_err(|exception| {
        // Of an object whose truth is its length.
        match exception.is_instance_of::<PyOverflowError>(py) {
            true => wrong_type(&format!("model.{name}"), "True or False", &value),
            false => exception,
        }
    })
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

    fn uses_seeds(&self) -> bool {
        self.uses_seeds
    }

    fn pads(&self) -> bool {
        self.pads
    }

    fn prepare(
        &self,
        starts: &PythonFrames,
        goals: &PythonFrames,
    ) -> Result<Option<(PythonFrames, PythonFrames)>> {
        if !self.prepares {
            return Ok(None);
        }
        let prepared = Python::attach(|py| {
            let arguments = (&starts.object, &goals.object);
            let pair = self.object.bind(py).call_method1(intern!(py, "prepare"), arguments)?;
            // A pair by type: a batch of two frames can be unpacked as well.
            Ok(match pair.cast::<PyTuple>() {
                Ok(both) if both.len() == 2 => {
                    let frames = |place, name| {
                        let frames = both.get_item(place)?;
                        PythonFrames::new(&format!("prepare: {name}"), frames)
                    };
                    Ok((frames(0, "starts")?, frames(1, "goals")?))
                }
                _ => Err(Error::Model(format!(
                    "prepare must return a tuple (starts, goals) of frames, got {}",
                    described_pair(&pair)
                ))),
            })
        });
        prepared.map_err(raised)?.map(Some)
    }

    fn rollout_costs(
        &self,
        starts: &PythonFrames,
        goals: &PythonFrames,
        Candidates { actions, seeds }: Candidates,
    ) -> Result<Array2<f32>> {
        let (problems, samples, _, _) = actions.dim();
        Python::attach(|py| {
            let arguments =
                (&starts.object, &goals.object, PyArray4::from_owned_array(py, actions));
            let seeds = seeds.map(|seeds| PyArray2::from_owned_array(py, seeds).into_any());
            let model = self.object.bind(py);
            let method = intern!(py, "rollout_costs");
            let costs = model.call_method(method, arguments, keyword(py, seeds)?.as_ref())?;
            read_costs(model, "rollout_costs", &costs, "[B, D]", (problems, samples))
        })
        .map_err(raised)
    }

    fn shared_rollout_costs(
        &self,
        start: &PythonFrames,
        goals: &PythonFrames,
        SharedCandidates { actions, seeds }: SharedCandidates,
    ) -> Option<Result<Array2<f32>>> {
        if !self.shares_rollouts {
            return None;
        }
        let (samples, _, _) = actions.dim();
        let costs = Python::attach(|py| {
            let arguments = (&start.object, &goals.object, PyArray3::from_owned_array(py, actions));
            let seeds = seeds.map(|seeds| PyArray1::from_owned_array(py, seeds).into_any());
            let model = self.object.bind(py);
            let method = intern!(py, "shared_rollout_costs");
            let costs = model.call_method(method, arguments, keyword(py, seeds)?.as_ref())?;
            read_costs(model, "shared_rollout_costs", &costs, "[B, D]", (goals.len, samples))
        });
        Some(costs.map_err(raised))
    }
}

/// `seeds=..` for a model that uses them; nothing for others, which need not take the argument.
fn keyword<'py>(
    py: Python<'py>,
    seeds: Option<Bound<'py, PyAny>>,
) -> PyResult<Option<Bound<'py, PyDict>>> {
    let Some(seeds) = seeds else {
        return Ok(None);
    };
    let keywords = PyDict::new(py);
    keywords.set_item(intern!(py, "seeds"), seeds)?;
    Ok(Some(keywords))
}

/// What came instead of a pair.
fn described_pair(object: &Bound<'_, PyAny>) -> String {
    match object.cast::<PyTuple>() {
        Ok(tuple) => format!("a tuple of {}", tuple.len()),
        Err(_) => describe(object),
    }
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
    fn read(
        &self,
        argument: &str,
        object: &Bound<'_, PyAny>,
        axes: Axes,
    ) -> PyResult<PythonFrames> {
        let py = object.py();
        let images = if self.observes && is_native_frames(object) {
            images_of(object, axes)?
        } else {
            as_images(object, axes)?
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
