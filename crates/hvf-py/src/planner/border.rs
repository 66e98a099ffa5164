//! Where frames cross between Python and a world model, native or written in Python.

use hvf_core_rs::keypoint::KeypointWorld;
use hvf_core_rs::latent::{LatentFrames, LatentWorld};
use hvf_core_rs::layers::LayerWorld;
use hvf_core_rs::maze::{MazeFrames, MazeWorld};
use hvf_core_rs::planner::{Proposals, SubgoalModel, WorldModel};
use hvf_core_rs::{Error, Result};
use ndarray::{Array2, Array3};
use numpy::{dtype, PyArray3, PyArrayDescrMethods, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::PyTuple;
use pyo3::{PyClass, PyTypeInfo};

use super::pace::Paced;
use super::raised;
use super::returned_costs::{read_costs, read_numbers};
use crate::arguments::{describe, Whole};
use crate::error::to_py;
use crate::keypoint::{PyKeypointFrames, PyKeypointWorld};
use crate::latent::{PyLatentFrames, PyLatentWorld};
use crate::layers::{PyLayerFrames, PyLayerWorld};
use crate::maze::frames::PyMazeFrames;
use crate::maze::world::PyMazeWorld;

/// A world model with the way its frames come from Python and go back.
pub trait Border: Sync {
    /// The world behind it.
    type World: WorldModel<Frames: Send> + Sync;

    /// The world.
    fn world(&self) -> &Self::World;

    /// The Python object that is the world, for its name and its `observe`.
    fn model(&self) -> &Py<PyAny>;

    /// Frames from what the user or a generator gave; `axes` says whether that may be one image.
    fn read(
        &self,
        argument: &str,
        object: &Bound<'_, PyAny>,
        axes: Axes,
    ) -> PyResult<FramesOf<Self>>;

    /// Frames as the model's own Python object.
    fn write<'py>(&self, py: Python<'py>, frames: FramesOf<Self>) -> PyResult<Bound<'py, PyAny>>;

    /// The planner's error as a Python exception; a model's mistake names its class.
    fn error(&self, py: Python<'_>, error: Error) -> PyErr {
        match error {
            Error::Model(problem) => match self.model().bind(py).get_type().name() {
                Ok(name) => PyValueError::new_err(format!("model {name}: {problem}")),
                Err(exception) => exception,
            },
            other => to_py(other),
        }
    }
}

/// Frames of the world behind a border.
pub type FramesOf<B> = <<B as Border>::World as WorldModel>::Frames;

/// A class of this module that holds a world written in Rust.
pub trait NativeClass: PyClass<Frozen = pyo3::pyclass::boolean_struct::True> + Sync {
    /// The world.
    type World: WorldModel<Frames: Send> + Sync;
    /// The class of its frames.
    type Frames: PyClass<Frozen = pyo3::pyclass::boolean_struct::True>
        + Into<PyClassInitializer<Self::Frames>>
        + Sync;

    /// The world in an object of this class.
    fn world(&self) -> &Self::World;
    /// The frames in an object of its frames' class.
    fn unwrap(frames: &Self::Frames) -> &<Self::World as WorldModel>::Frames;
    /// An object of its frames' class.
    fn wrap(frames: <Self::World as WorldModel>::Frames) -> Self::Frames;
}

impl NativeClass for PyKeypointWorld {
    type World = KeypointWorld;
    type Frames = PyKeypointFrames;

    fn world(&self) -> &KeypointWorld {
        &self.inner
    }
    fn unwrap(frames: &PyKeypointFrames) -> &<KeypointWorld as WorldModel>::Frames {
        &frames.inner
    }
    fn wrap(inner: <KeypointWorld as WorldModel>::Frames) -> PyKeypointFrames {
        PyKeypointFrames { inner }
    }
}

impl NativeClass for PyLatentWorld {
    type World = LatentWorld;
    type Frames = PyLatentFrames;

    fn world(&self) -> &LatentWorld {
        &self.inner
    }
    fn unwrap(frames: &PyLatentFrames) -> &LatentFrames {
        &frames.inner
    }
    fn wrap(inner: LatentFrames) -> PyLatentFrames {
        PyLatentFrames { inner }
    }
}

impl NativeClass for PyLayerWorld {
    type World = LayerWorld;
    type Frames = PyLayerFrames;

    fn world(&self) -> &LayerWorld {
        &self.inner
    }
    fn unwrap(frames: &PyLayerFrames) -> &<LayerWorld as WorldModel>::Frames {
        &frames.inner
    }
    fn wrap(inner: <LayerWorld as WorldModel>::Frames) -> PyLayerFrames {
        PyLayerFrames { inner }
    }
}

impl NativeClass for PyMazeWorld {
    type World = MazeWorld;
    type Frames = PyMazeFrames;

    fn world(&self) -> &MazeWorld {
        &self.inner
    }
    fn unwrap(frames: &PyMazeFrames) -> &MazeFrames {
        &frames.inner
    }
    fn wrap(inner: MazeFrames) -> PyMazeFrames {
        PyMazeFrames { inner }
    }
}

/// A native world: planned with without the GIL.
pub struct Native<N: NativeClass> {
    world: Paced<N>,
    model: Py<PyAny>,
}

impl<N: NativeClass> Native<N> {
    /// `model` is the object that the user gave: the native world or a wrapper around it.
    pub fn new(native: &Bound<'_, N>, model: &Bound<'_, PyAny>) -> Self {
        Self { world: Paced::new(native.clone().unbind()), model: model.clone().unbind() }
    }
}

impl<N: NativeClass> Border for Native<N> {
    type World = Paced<N>;

    fn world(&self) -> &Paced<N> {
        &self.world
    }

    fn model(&self) -> &Py<PyAny> {
        &self.model
    }

    fn read(
        &self,
        argument: &str,
        object: &Bound<'_, PyAny>,
        axes: Axes,
    ) -> PyResult<FramesOf<Self>> {
        if let Ok(frames) = object.cast::<N::Frames>() {
            return Ok(N::unwrap(frames.get()).clone());
        }
        let py = object.py();
        let model = self.model.bind(py);
        let observe = model.getattr_opt(intern!(py, "observe"))?;
        let (Some(images), Some(observe)) = (images_of(object, axes)?, &observe) else {
            let frames = N::Frames::type_object(py).name()?;
            let images = if observe.is_some() { " or uint8 images [N, H, W, 3]" } else { "" };
            let found = describe(object);
            return Err(PyTypeError::new_err(format!(
                "{argument}: expected {frames}{images}, got {found}"
            )));
        };
        let observed = observe.call1((images,))?;
        match observed.cast::<N::Frames>() {
            Ok(frames) => Ok(N::unwrap(frames.get()).clone()),
            Err(_) => Err(PyTypeError::new_err(format!(
                "{argument}: observe must return {}, got {}",
                N::Frames::type_object(py).name()?,
                describe(&observed)
            ))),
        }
    }

    fn write<'py>(&self, py: Python<'py>, frames: FramesOf<Self>) -> PyResult<Bound<'py, PyAny>> {
        Ok(Bound::new(py, N::wrap(frames))?.into_any())
    }
}

/// Whether an object is the frames of a native world.
pub fn is_native_frames(object: &Bound<'_, PyAny>) -> bool {
    object.is_instance_of::<PyMazeFrames>()
        || object.is_instance_of::<PyKeypointFrames>()
        || object.is_instance_of::<PyLatentFrames>()
        || object.is_instance_of::<PyLayerFrames>()
}

/// How many axes images have where they are asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axes {
    /// One image is asked for: `[H, W, 3]` will do.
    OneOrBatch,
    /// A batch is asked for: three axes are `N` grey images or other frames of a model's own.
    Batch,
}

/// The uint8 images `[N, H, W, 3]` in an object: an array of them, one image `[H, W, 3]` where
/// that will do, or the `images` of another world's frames.
pub fn images_of<'py>(
    object: &Bound<'py, PyAny>,
    axes: Axes,
) -> PyResult<Option<Bound<'py, PyAny>>> {
    if let Some(images) = as_images(object, axes)? {
        return Ok(Some(images));
    }
    match object.getattr_opt(intern!(object.py(), "images"))? {
        Some(images) => as_images(&images, Axes::Batch),
        None => Ok(None),
    }
}

/// A uint8 array `[N, H, W, 3]`, or `[H, W, 3]` with an axis added where one image will do.
pub fn as_images<'py>(
    object: &Bound<'py, PyAny>,
    axes: Axes,
) -> PyResult<Option<Bound<'py, PyAny>>> {
    let py = object.py();
    let Ok(array) = object.cast::<PyUntypedArray>() else {
        return Ok(None);
    };
    if !array.dtype().is_equiv_to(&dtype::<u8>(py)) {
        return Ok(None);
    }
    match array.shape() {
        [_, _, 3] if axes == Axes::OneOrBatch => Ok(Some(object.get_item(py.None())?)),
        [_, _, _, _] => Ok(Some(object.clone())),
        _ => Ok(None),
    }
}

/// A Python object as a generator of subgoals in the frames of a world.
pub struct Generator<'b, B: Border> {
    object: Py<PyAny>,
    latent_dim: usize,
    border: &'b B,
}

impl<'b, B: Border> Generator<'b, B> {
    /// Reads `latent_dim`; `None` is allowed where no subgoal is asked for.
    pub fn new(object: &Bound<'_, PyAny>, border: &'b B, subgoals: usize) -> PyResult<Self> {
        let py = object.py();
        let latent_dim = if subgoals == 0 {
            0
        } else {
            let missing = || {
                PyTypeError::new_err(format!(
                    "generator: must have latent_dim and decode(scene, latents), got {}",
                    describe(object)
                ))
            };
            if !object.hasattr(intern!(py, "decode"))? {
                return Err(missing());
            }
            let dim = object.getattr_opt(intern!(py, "latent_dim"))?.ok_or_else(missing)?;
            dim.extract::<Whole>()?.count("generator.latent_dim")?
        };
        Ok(Self { object: object.clone().unbind(), latent_dim, border })
    }
}

impl<B: Border> SubgoalModel<FramesOf<B>> for Generator<'_, B> {
    fn latent_dim(&self) -> usize {
        self.latent_dim
    }

    fn decode(&self, scene: &FramesOf<B>, latents: Array3<f32>) -> Result<FramesOf<B>> {
        Python::attach(|py| {
            let scene = self.border.write(py, scene.clone())?;
            let latents = PyArray3::from_owned_array(py, latents);
            let decoded =
                self.object.bind(py).call_method1(intern!(py, "decode"), (scene, latents))?;
            self.border.read("generator.decode", &decoded, Axes::Batch)
        })
        .map_err(raised)
    }

    fn segment_costs(
        &self,
        start: &FramesOf<B>,
        goal: &FramesOf<B>,
        latents: Array3<f32>,
    ) -> Result<Array2<f32>> {
        let (samples, subgoals, _) = latents.dim();
        Python::attach(|py| {
            let object = self.object.bind(py);
            let Some(ask) = object.getattr_opt(intern!(py, "segment_costs"))? else {
                return Err(PyTypeError::new_err(format!(
                    "generator: segment_cost='likelihood' needs one with \
                     segment_costs(start, goal, latents), got {}; 'planned' needs none",
                    describe(object)
                )));
            };
            let start = self.border.write(py, start.clone())?;
            let goal = self.border.write(py, goal.clone())?;
            let costs = ask.call1((start, goal, PyArray3::from_owned_array(py, latents)))?;
            let expected = (samples, subgoals + 1);
            read_costs(object, "segment_costs", &costs, "[M, K + 1]", expected)
        })
        .map_err(raised)
    }

    fn proposals(
        &self,
        start: &FramesOf<B>,
        goal: &FramesOf<B>,
        subgoals: usize,
    ) -> Result<Option<Proposals>> {
        Python::attach(|py| {
            let object = self.object.bind(py);
            let ask = object.getattr_opt(intern!(py, "proposals"))?;
            let Some(ask) = ask.filter(|ask| !ask.is_none()) else {
                return Ok(None);
            };
            let start = self.border.write(py, start.clone())?;
            let goal = self.border.write(py, goal.clone())?;
            let found = ask.call1((start, goal, subgoals))?;
            if found.is_none() {
                return Ok(None);
            }
            let both = found.cast::<PyTuple>().ok().filter(|both| both.len() == 2);
            let Some(both) = both else {
                return Err(PyTypeError::new_err(format!(
                    "generator: proposals must return None or a tuple (mean, std), got {}",
                    describe(&found)
                )));
            };
            let read = |place| {
                let expected = (subgoals, self.latent_dim);
                let values = both.get_item(place)?;
                read_numbers(object, "proposals", "latents", &values, "[K, L]", expected)
            };
            Ok(Some(Proposals { mean: read(0)?, std: read(1)? }))
        })
        .map_err(raised)
    }
}

/// Runs `$body` with `$border` being the border of the world behind `$model`: one of this
/// module's worlds, an object whose `native` is one, or any object with the protocol's methods.
macro_rules! with_border {
    ($model:expr, |$border:ident| $body:expr) => {{
        let model: &pyo3::Bound<'_, pyo3::PyAny> = $model;
        let native = $crate::planner::native::native_of(model)?;
        if let Ok(world) = native.cast::<$crate::keypoint::PyKeypointWorld>() {
            let $border = $crate::planner::border::Native::new(world, model);
            $body
        } else if let Ok(world) = native.cast::<$crate::latent::PyLatentWorld>() {
            let $border = $crate::planner::border::Native::new(world, model);
            $body
        } else if let Ok(world) = native.cast::<$crate::layers::PyLayerWorld>() {
            let $border = $crate::planner::border::Native::new(world, model);
            $body
        } else if let Ok(world) = native.cast::<$crate::maze::world::PyMazeWorld>() {
            let $border = $crate::planner::border::Native::new(world, model);
            $body
        } else {
            let $border = $crate::planner::model::PythonWorld::new(model)?;
            $body
        }
    }};
}
pub(super) use with_border;
