//! The maze's true simulator as a world model: `MazeWorld`, `MazeSubgoals`.

use std::sync::Arc;

use hvf_core_rs::image::OverHorizon;
use hvf_core_rs::maze::ground::Ground;
use hvf_core_rs::maze::{
    MazeFrames, MazeSubgoals, MazeWorld, MazeWorldConfig, Renderer, State, States,
};
use hvf_core_rs::planner::{Frames, SubgoalModel};
use ndarray::{Array3, Ix3, Ix4};
use numpy::{IntoPyArray, PyArray3, PyReadonlyArray4, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::intern;
use pyo3::prelude::*;

use super::frames::{rows_of, PyMazeFrames};
use super::layout::{layout_of, other_than_paper, Kept};
use crate::arguments::{array, axes_of, numbers, text, unfit, Given, Real, Text, Whole};
use crate::error::to_py;
use crate::threads::detached;
use crate::worlds::{self, action_box, Costs};

/// The maze's true simulator as a world model.
///
/// The planning cost is the pixel cost (`image_cost`) between the frame that simulator and
/// renderer would give and the goal image, computed without drawing it. Actions beyond the box
/// `[-3, 3]` count as the nearest within, as in the environment. The planners use it without the
/// GIL.
///
/// Args:
///     image_size: Height and width of the images, pixels, from 8 to 2048.
///     blur: Standard deviation, in pixels, of a Gaussian blur of both images.
///     over_horizon: Which predicted frames count: 'last', 'sum' or 'min'.
///     layout: What images are read as showing; None for the paper's maze. Frames of states have
///         their layout with them.
///
/// Raises:
///     ValueError: A number out of range, or another name.
///     TypeError: An argument of another kind.
#[pyclass(name = "MazeWorld", module = "hvf_core", frozen)]
pub struct PyMazeWorld {
    /// The world.
    pub inner: MazeWorld,
}

#[pymethods]
impl PyMazeWorld {
    #[new]
    #[pyo3(
        signature = (
            image_size = Given::of(64), blur = Given::of(0.0), over_horizon = text("last"),
            layout = None
        ),
        text_signature = "(image_size=64, blur=0.0, over_horizon='last', layout=None)"
    )]
    fn new(
        image_size: Whole,
        blur: Real,
        over_horizon: Text,
        layout: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let layout = layout_of(layout)?;
        let over_horizon = over_horizon.get("over_horizon")?;
        let over_horizon = OverHorizon::from_name(&over_horizon).map_err(to_py)?;
        let image_size = image_size.count("image_size")?;
        Renderer::shared(image_size)
            .map_err(|error| PyValueError::new_err(format!("image_size: {error}")))?;
        let config = MazeWorldConfig { image_size, blur: blur.get("blur")?, over_horizon };
        let world = MazeWorld::new(config).map_err(to_py)?;
        let inner = match layout {
            Some(kept) => world.with_layout(Arc::clone(&kept.layout)),
            None => world,
        };
        Ok(Self { inner })
    }

    /// Height and width of the images, pixels.
    #[getter]
    fn image_size(&self) -> usize {
        self.inner.config().image_size
    }

    /// Standard deviation of the blur, pixels.
    #[getter]
    fn blur(&self) -> f64 {
        self.inner.config().blur
    }

    /// Which predicted frames count.
    #[getter]
    fn over_horizon(&self) -> &'static str {
        self.inner.config().over_horizon.name()
    }

    /// Frames of images; where a rollout starts is read off them.
    ///
    /// Args:
    ///     images: uint8 `[N, S, S, 3]`, or one, `[S, S, 3]`.
    ///
    /// Raises:
    ///     ValueError: Images of another size.
    ///     TypeError: What is not uint8.
    fn observe(&self, py: Python<'_>, images: &Bound<'_, PyAny>) -> PyResult<PyMazeFrames> {
        let images = self.images("images", images)?;
        let images = images.as_array();
        let inner = detached(py, || {
            let standard = images.as_standard_layout();
            self.inner.observe(standard.as_slice().unwrap_or_default())
        })?;
        Ok(PyMazeFrames { inner: inner.map_err(to_py)? })
    }

    /// Planning costs of candidates, float32 `[B, D]`.
    ///
    /// One whose actions are not finite costs NaN.
    ///
    /// Args:
    ///     starts: `MazeFrames`, or uint8 images, that candidates start from, `[B]`.
    ///     goals: Frames or images that they are compared with, `[B]`.
    ///     actions: float `[B, D, H, 2]`, at most 2**28 numbers.
    ///
    /// Raises:
    ///     ValueError: Frames or actions that do not fit the world or each other.
    ///     TypeError: An argument of another kind.
    fn rollout_costs<'py>(
        &self,
        py: Python<'py>,
        starts: &Bound<'py, PyAny>,
        goals: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Costs<'py>> {
        let starts = self.frames(py, "starts", starts)?;
        let goals = self.frames(py, "goals", goals)?;
        let actions = worlds::any_actions::<Ix4>(actions, "a float array [B, D, H, 2]")?;
        worlds::rollout_costs(py, &self.inner, [&starts, &goals], actions)
    }

    /// Planning costs of the same candidates from one start to every goal, float32 `[B, D]`.
    ///
    /// Those of `rollout_costs`, to the last bit.
    ///
    /// Args:
    ///     start: The frame or image that all candidates start from, `[1]`.
    ///     goals: Frames or images that they are compared with, `[B]`.
    ///     actions: float `[D, H, 2]`, at most 2**28 numbers.
    ///
    /// Raises:
    ///     As `rollout_costs`.
    fn shared_rollout_costs<'py>(
        &self,
        py: Python<'py>,
        start: &Bound<'py, PyAny>,
        goals: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Costs<'py>> {
        let start = self.frames(py, "start", start)?;
        let goals = self.frames(py, "goals", goals)?;
        let actions = worlds::any_actions::<Ix3>(actions, "a float array [D, H, 2]")?;
        worlds::shared_rollout_costs(py, &self.inner, [&start, &goals], actions)
    }

    /// States that candidates lead through, float64 `[D, H, S]`.
    ///
    /// Args:
    ///     start: The frame or image that all candidates start from, `[1]`.
    ///     actions: float `[D, H, 2]`, at most 2**28 numbers.
    ///
    /// Raises:
    ///     As `rollout_costs`.
    fn rollout<'py>(
        &self,
        py: Python<'py>,
        start: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let start = self.frames(py, "start", start)?;
        if start.len() != 1 {
            let problem = format!("start: must be one frame, got {}", start.len());
            return Err(PyValueError::new_err(problem));
        }
        let actions = worlds::any_actions::<Ix3>(actions, "a float array [D, H, 2]")?;
        Ok(match &start.states() {
            States::Paper(states) => self.rows_of_rollout(py, &states[0], &actions)?,
            States::Laid(states) => self.rows_of_rollout(py, &states[0], &actions)?,
        }
        .into_pyarray(py))
    }

    fn __repr__(&self) -> String {
        let MazeWorldConfig { image_size, blur, over_horizon } = self.inner.config();
        let name = over_horizon.name();
        format!("MazeWorld(image_size={image_size}, blur={blur:?}, over_horizon='{name}')")
    }
}

action_box!(PyMazeWorld);

impl PyMazeWorld {
    fn rows_of_rollout<S: Ground>(
        &self,
        py: Python<'_>,
        start: &State<S>,
        actions: &Array3<f32>,
    ) -> PyResult<Array3<f64>> {
        let states = detached(py, || self.inner.rollout(start.clone(), actions.view()))?;
        let states = states.map_err(to_py)?;
        let (d, h) = states.dim();
        let rows = rows_of(states.iter());
        let columns = rows.ncols();
        let rows = rows.into_shape_with_order((d, h, columns));
        rows.map_err(|error| PyValueError::new_err(error.to_string()))
    }

    /// Images of this world's size.
    fn images<'py>(
        &self,
        argument: &str,
        object: &Bound<'py, PyAny>,
    ) -> PyResult<PyReadonlyArray4<'py, u8>> {
        let size = self.inner.config().image_size;
        images_of_size(argument, object, size)
    }

    fn frames(
        &self,
        py: Python<'_>,
        argument: &str,
        object: &Bound<'_, PyAny>,
    ) -> PyResult<MazeFrames> {
        if let Ok(frames) = object.cast::<PyMazeFrames>() {
            return Ok(frames.get().inner.clone());
        }
        let images = self.images(argument, object)?;
        let images = images.as_array();
        let standard = images.as_standard_layout();
        let bytes = standard.as_slice().unwrap_or_default();
        detached(py, || self.inner.observe(bytes))?.map_err(to_py)
    }
}

/// The oracle among subgoal generators: images of a scene with the agent anywhere it can stand.
///
/// Uniformly: what a perfect generative model of the maze would do.
///
/// Args:
///     latent_dim: Numbers of a latent, at least 2: the first two say where the agent is.
///     layout: What images are read as showing; None for the paper's maze.
///
/// Raises:
///     ValueError: A number out of range.
///     TypeError: An argument of another kind.
#[pyclass(name = "MazeSubgoals", module = "hvf_core", frozen)]
pub struct PyMazeSubgoals {
    inner: MazeSubgoals,
    layout: Option<Arc<Kept>>,
}

#[pymethods]
impl PyMazeSubgoals {
    #[new]
    #[pyo3(
        signature = (latent_dim = Given::of(8), layout = None),
        text_signature = "(latent_dim=8, layout=None)"
    )]
    fn new(latent_dim: Whole, layout: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        let latent_dim = latent_dim.count("latent_dim")?;
        let layout = other_than_paper(layout_of(layout)?);
        Ok(Self { inner: MazeSubgoals::new(latent_dim).map_err(to_py)?, layout })
    }

    /// Numbers of a latent, `L`.
    #[getter]
    fn latent_dim(&self) -> usize {
        self.inner.latent_dim()
    }

    /// `MazeFrames` of `M * K` images, sample-major.
    ///
    /// Args:
    ///     scene: One frame of any world: `MazeFrames`, a uint8 image `[1, S, S, 3]`, or frames
    ///         with such `images`.
    ///     latents: float `[M, K, L]`.
    ///
    /// Raises:
    ///     ValueError: A scene of more or less than one frame, or latents of another shape.
    ///     TypeError: An argument of another kind.
    fn decode(
        &self,
        scene: &Bound<'_, PyAny>,
        latents: &Bound<'_, PyAny>,
    ) -> PyResult<PyMazeFrames> {
        let latents = numbers::<f32, Ix3>("latents", latents, "a float array [M, K, L]")?;
        let found = match scene.cast::<PyMazeFrames>() {
            Ok(frames) => frames.get().inner.clone(),
            Err(_) => located(scene, self.layout.as_deref())?,
        };
        let frames = detached(scene.py(), || self.inner.decode(&found, latents))?;
        Ok(PyMazeFrames { inner: frames.map_err(to_py)? })
    }

    fn __repr__(&self) -> String {
        format!("MazeSubgoals(latent_dim={})", self.inner.latent_dim())
    }
}

/// Frames read off the images of another world's frames.
fn located(scene: &Bound<'_, PyAny>, layout: Option<&Kept>) -> PyResult<MazeFrames> {
    let images = scene.getattr_opt(intern!(scene.py(), "images"))?;
    let images = images.as_ref().unwrap_or(scene);
    let size = match images.cast::<PyUntypedArray>() {
        Ok(array) if array.ndim() == 4 => array.shape()[1],
        _ => 0,
    };
    let images = images_of_size("scene", images, size)?;
    let images = images.as_array();
    let standard = images.as_standard_layout();
    let renderer =
        Renderer::shared(size).map_err(|error| PyValueError::new_err(format!("scene: {error}")))?;
    let bytes = standard.as_slice().unwrap_or_default();
    let read = || match layout {
        None => MazeFrames::from_images(&renderer, bytes),
        Some(kept) => MazeFrames::from_images_in(&kept.layout, &renderer, bytes),
    };
    detached(scene.py(), read)?.map_err(to_py)
}

/// A uint8 array `[N, size, size, 3]`; a single image gets an axis.
fn images_of_size<'py>(
    argument: &str,
    object: &Bound<'py, PyAny>,
    size: usize,
) -> PyResult<PyReadonlyArray4<'py, u8>> {
    let expected = format!("MazeFrames or uint8 images [N, {size}, {size}, 3]");
    let one = axes_of::<u8>(object) == Some(3);
    let batch = if one { object.get_item(object.py().None())? } else { object.clone() };
    let images = array::<u8, Ix4>(argument, &batch, &expected)?;
    if images.shape()[1..] != [size, size, 3] {
        return Err(PyValueError::new_err(unfit(argument, &expected, object)));
    }
    Ok(images)
}

/// Adds this file's classes to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyMazeWorld>()?;
    module.add_class::<PyMazeSubgoals>()
}
