//! The compact learned dynamics model for Python: `KeypointWorld`, `KeypointFrames`.

use hvf_core_rs::image::OverHorizon;
use hvf_core_rs::keypoint::{Cell, CellWeights, KeypointFrames, KeypointWorld, Sprite};
use hvf_core_rs::planner::{ActionSpace, Frames};
use ndarray::{Array4, Ix1, Ix2, Ix3, Ix4};
use numpy::{IntoPyArray, PyArray2, PyArray3, PyArray4};
use pyo3::prelude::*;

use crate::arguments::{array, indices, instance, numbers, point, text, Given, Real, Text, Whole};
use crate::error::to_py;
use crate::threads::detached;
use crate::worlds::{self, action_box, rollout_costs_doc, Costs};

/// Frames of a `KeypointWorld`: images, where the moving part is, and a map of the rest.
///
/// Made by `KeypointWorld.frames`. `frames[i]` are those at an integer (one frame, still a batch)
/// or at integers `[N]`. What the model sees in a scene is computed once, when first needed; frames
/// picked with `[]` and frames from `moved` share it.
#[pyclass(name = "KeypointFrames", module = "hvf_core", frozen)]
pub struct PyKeypointFrames {
    /// The frames.
    pub inner: KeypointFrames,
}

#[pymethods]
impl PyKeypointFrames {
    fn __len__(&self) -> usize {
        self.inner.len()
    }

    /// The frames at `index`: an integer (one frame, still a batch), or a list or an array of
    /// integers; negative ones count from the end. Raises IndexError beyond the batch.
    fn __getitem__(&self, index: &Bound<'_, PyAny>) -> PyResult<Self> {
        let index = indices(index, self.inner.len())?;
        Ok(Self { inner: self.inner.select(&index).map_err(to_py)? })
    }

    /// The images, uint8 `[N, S, S, 3]` (a copy).
    #[getter]
    fn images<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray4<u8>> {
        let (count, size) = (self.inner.len(), self.inner.image_size());
        let mut bytes = Vec::with_capacity(count * size * size * 3);
        for i in 0..count {
            bytes.extend_from_slice(self.inner.image(i));
        }
        ndarray::Array4::from_shape_vec((count, size, size, 3), bytes)
            .unwrap_or_default()
            .into_pyarray(py)
    }

    /// The keypoints, float32 `[N, 2]`, (row, column) in pixels (a copy).
    #[getter]
    fn keypoints<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f32>> {
        let count = self.inner.len();
        ndarray::Array2::from_shape_fn((count, 2), |(i, axis)| self.inner.keypoint(i)[axis])
            .into_pyarray(py)
    }

    /// The scene maps, float32 `[N, S, S]` (a copy).
    #[getter]
    fn maps<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray3<f32>> {
        let (count, size) = (self.inner.len(), self.inner.image_size());
        let maps = (0..count).flat_map(|i| self.inner.map(i)).copied().collect();
        ndarray::Array3::from_shape_vec((count, size, size), maps)
            .unwrap_or_default()
            .into_pyarray(py)
    }

    /// Frames of the same scene in which the moving part is elsewhere.
    ///
    /// Args:
    ///     images: uint8 `[N, S, S, 3]`.
    ///     keypoints: float32 `[N, 2]`, (row, column) in pixels.
    ///
    /// Raises:
    ///     ValueError: Not exactly one frame here, shapes that do not fit each other, or keypoints
    ///         that are not finite.
    ///     TypeError: Arrays of another dtype, or what is no array.
    fn moved(&self, images: &Bound<'_, PyAny>, keypoints: &Bound<'_, PyAny>) -> PyResult<Self> {
        let images = array::<u8, Ix4>("images", images, "uint8 [N, S, S, 3]")?;
        let keypoints = array::<f32, Ix2>("keypoints", keypoints, "float32 [N, 2]")?;
        let inner = self.inner.moved(images.as_array(), keypoints.as_array()).map_err(to_py)?;
        Ok(Self { inner })
    }

    fn __repr__(&self) -> String {
        format!("KeypointFrames({} frames of {} pixels)", self.inner.len(), self.inner.image_size())
    }
}

/// The compact learned dynamics model, evaluated in Rust; a world model.
///
/// `hvf.worlds.keypoint.KeypointWorld` makes one from a trained `KeypointDynamics`. The cost is the
/// squared pixel distance of the predicted frame to the goal, per pixel, in closed form. A
/// candidate costs about `H * substeps * hidden**2` multiply-adds. Actions beyond the box are taken
/// as they are: the model, which was trained within it, extrapolates.
///
/// Args:
///     patch: Weights of the first layer for what is around the keypoint, float32
///         `[hidden, taps**2]`.
///     patch_bias: float32 `[hidden]`.
///     context: Weights of the first layer for action and memory, float32 `[hidden, A + C]`.
///     middle: float32 `[hidden, hidden]`.
///     middle_bias: float32 `[hidden]`.
///     output: Motion in pixels, then change of the memory, float32 `[2 + C, hidden]`.
///     output_bias: float32 `[2 + C]`.
///     free: Motion per substep that is linear in the action, float32 `[2, A]`.
///     action_scale: Number by which actions are divided.
///     spacing: Pixels between the taps of a patch.
///     substeps: Substeps of an action.
///     half_size: Half the sprite's size along rows and columns, in pixels.
///     edge: Width of its soft edge along rows and columns, in pixels.
///     colour: Its colour relative to the background, in units of full intensity.
///     action_low: Lowest action, `[A]`.
///     action_high: Highest action, `[A]`.
///     image_size: Height and width of the images, `S`.
///     blur: Standard deviation of the Gaussian blur before frames are compared, in pixels.
///     over_horizon: 'last', 'sum' or 'min' over the predicted frames.
///
/// Raises:
///     ValueError: Shapes that do not fit each other, or numbers out of range, of any size.
///     TypeError: Arrays of another dtype, or objects of another kind.
#[pyclass(name = "KeypointWorld", module = "hvf_core", frozen)]
pub struct PyKeypointWorld {
    /// The world.
    pub inner: KeypointWorld,
}

#[pymethods]
impl PyKeypointWorld {
    #[new]
    #[pyo3(signature = (
        *, patch, patch_bias, context, middle, middle_bias, output, output_bias, free,
        action_scale, spacing, substeps, half_size, edge, colour, action_low, action_high,
        image_size, blur=Given::of(0.0), over_horizon=text("last")
    ), text_signature = "(*, patch, patch_bias, context, middle, middle_bias, output, \
                         output_bias, free, action_scale, spacing, substeps, half_size, edge, \
                         colour, action_low, action_high, image_size, blur=0.0, \
                         over_horizon='last')")]
    #[allow(clippy::too_many_arguments)]
    fn new(
        patch: &Bound<'_, PyAny>,
        patch_bias: &Bound<'_, PyAny>,
        context: &Bound<'_, PyAny>,
        middle: &Bound<'_, PyAny>,
        middle_bias: &Bound<'_, PyAny>,
        output: &Bound<'_, PyAny>,
        output_bias: &Bound<'_, PyAny>,
        free: &Bound<'_, PyAny>,
        action_scale: Real,
        spacing: Whole,
        substeps: Whole,
        half_size: &Bound<'_, PyAny>,
        edge: &Bound<'_, PyAny>,
        colour: &Bound<'_, PyAny>,
        action_low: &Bound<'_, PyAny>,
        action_high: &Bound<'_, PyAny>,
        image_size: Whole,
        blur: Real,
        over_horizon: Text,
    ) -> PyResult<Self> {
        let matrix = |name, object| array::<f32, Ix2>(name, object, "float32 [outputs, inputs]");
        let vector = |name, object| array::<f32, Ix1>(name, object, "float32 [outputs]");
        let patch = matrix("patch", patch)?;
        let patch_bias = vector("patch_bias", patch_bias)?;
        let context = matrix("context", context)?;
        let middle = matrix("middle", middle)?;
        let middle_bias = vector("middle_bias", middle_bias)?;
        let output = matrix("output", output)?;
        let output_bias = vector("output_bias", output_bias)?;
        let free = matrix("free", free)?;
        let action_scale = action_scale.single("action_scale")?;
        let (spacing, substeps) = (spacing.count("spacing")?, substeps.count("substeps")?);
        let half_size = point("half_size", half_size)?;
        let (edge, colour) = (point("edge", edge)?, point("colour", colour)?);
        let corner = |name, object| numbers::<f32, Ix1>(name, object, "a float array [A]");
        let action_low = corner("action_low", action_low)?.to_vec();
        let action_high = corner("action_high", action_high)?.to_vec();
        let (image_size, blur) = (image_size.count("image_size")?, blur.get("blur")?);
        let over_horizon = over_horizon.get("over_horizon")?;
        let build = || {
            let actions = ActionSpace::new(action_low, action_high)?;
            let weights = CellWeights {
                patch: patch.as_array(),
                patch_bias: patch_bias.as_array(),
                context: context.as_array(),
                middle: middle.as_array(),
                middle_bias: middle_bias.as_array(),
                output: output.as_array(),
                output_bias: output_bias.as_array(),
                free: free.as_array(),
                action_scale,
                spacing,
                substeps,
            };
            let cell = Cell::new(weights)?;
            let sprite = Sprite { half_size, edge, colour };
            let over_horizon = OverHorizon::from_name(&over_horizon)?;
            KeypointWorld::new(cell, sprite, actions, image_size, blur, over_horizon)
        };
        Ok(Self { inner: build().map_err(to_py)? })
    }

    /// Frames of this world.
    ///
    /// Args:
    ///     images: uint8 `[N, S, S, 3]`.
    ///     keypoints: float32 `[N, 2]`, (row, column) in pixels.
    ///     maps: What does not move, as the model was trained to see it, float32 `[N, S, S]`.
    ///
    /// Raises:
    ///     ValueError: Shapes that do not fit each other or the world, or numbers that are not
    ///         finite.
    ///     TypeError: Arrays of another dtype, or what is no array.
    fn frames(
        &self,
        images: &Bound<'_, PyAny>,
        keypoints: &Bound<'_, PyAny>,
        maps: &Bound<'_, PyAny>,
    ) -> PyResult<PyKeypointFrames> {
        let images = array::<u8, Ix4>("images", images, "uint8 [N, S, S, 3]")?;
        let keypoints = array::<f32, Ix2>("keypoints", keypoints, "float32 [N, 2]")?;
        let maps = array::<f32, Ix3>("maps", maps, "float32 [N, S, S]")?;
        let inner = self
            .inner
            .frames(images.as_array(), keypoints.as_array(), maps.as_array())
            .map_err(to_py)?;
        Ok(PyKeypointFrames { inner })
    }

    #[doc = rollout_costs_doc!()]
    fn rollout_costs<'py>(
        &self,
        py: Python<'py>,
        starts: &Bound<'py, PyAny>,
        goals: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Costs<'py>> {
        let frames = [frames("starts", starts)?, frames("goals", goals)?];
        let actions = worlds::actions(actions, "float32 [B, D, H, A]")?;
        worlds::rollout_costs(py, &self.inner, frames, actions)
    }

    /// Predicted keypoints, float32 `[B, D, H, 2]`, (row, column) in pixels.
    ///
    /// Args:
    ///     starts: Frames of this world that candidates start from, `[B]`.
    ///     actions: float32 `[B, D, H, A]`, at most 2**28 numbers, as must the answer be.
    ///
    /// Raises:
    ///     As `rollout_costs`.
    fn rollout<'py>(
        &self,
        py: Python<'py>,
        starts: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray4<f32>>> {
        let starts = frames("starts", starts)?;
        let actions: Array4<f32> = worlds::actions(actions, "float32 [B, D, H, A]")?;
        let (problems, candidates, steps, _) = actions.dim();
        worlds::few("actions", &[problems, candidates, steps, 2])?;
        let paths = detached(py, || self.inner.rollout(starts, actions.view()))?.map_err(to_py)?;
        Ok(paths.into_pyarray(py))
    }
}

action_box!(PyKeypointWorld);

fn frames<'a>(argument: &str, object: &'a Bound<'_, PyAny>) -> PyResult<&'a KeypointFrames> {
    Ok(&instance::<PyKeypointFrames>(argument, object)?.get().inner)
}

/// Adds this file's classes to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyKeypointWorld>()?;
    module.add_class::<PyKeypointFrames>()
}
