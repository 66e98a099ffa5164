//! The compact learned dynamics model for Python: `KeypointWorld`, `KeypointFrames`.

use hvf_core_rs::image::OverHorizon;
use hvf_core_rs::keypoint::{Cell, CellWeights, KeypointFrames, KeypointWorld, Sprite};
use hvf_core_rs::planner::{ActionSpace, Frames, WorldModel};
use ndarray::{Ix1, Ix2, Ix3, Ix4};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyArray4};
use pyo3::prelude::*;

use crate::arguments::{array, indices, instance, numbers, point, text, Given, Real, Text, Whole};
use crate::error::to_py;
use crate::threads::detached;

/// Frames of a `KeypointWorld`.
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

    /// Frames of the same scene with the moving part elsewhere.
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

/// The compact learned dynamics model as a world model. Actions beyond the box are taken as they
/// are: the model extrapolates.
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

    /// Lowest action, float32 `[A]`.
    #[getter]
    fn action_low<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, self.inner.action_space().low())
    }

    /// Highest action, float32 `[A]`.
    #[getter]
    fn action_high<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, self.inner.action_space().high())
    }

    /// Frames of this world from images, keypoints and scene maps.
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

    /// Planning costs float32 `[B, D]` of `actions [B, D, H, A]`.
    fn rollout_costs<'py>(
        &self,
        py: Python<'py>,
        starts: &Bound<'py, PyAny>,
        goals: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let starts = frames("starts", starts)?;
        let goals = frames("goals", goals)?;
        let actions = array::<f32, Ix4>("actions", actions, "float32 [B, D, H, A]")?;
        let actions = actions.as_array().to_owned();
        let costs = detached(py, || self.inner.rollout_costs(starts, goals, actions.into()))?
            .map_err(to_py)?;
        Ok(costs.into_pyarray(py))
    }

    /// Predicted keypoints float32 `[B, D, H, 2]` of `actions [B, D, H, A]`.
    fn rollout<'py>(
        &self,
        py: Python<'py>,
        starts: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray4<f32>>> {
        let starts = frames("starts", starts)?;
        let actions = array::<f32, Ix4>("actions", actions, "float32 [B, D, H, A]")?;
        let actions = actions.as_array();
        let paths = detached(py, || self.inner.rollout(starts, actions))?.map_err(to_py)?;
        Ok(paths.into_pyarray(py))
    }
}

fn frames<'a>(argument: &str, object: &'a Bound<'_, PyAny>) -> PyResult<&'a KeypointFrames> {
    Ok(&instance::<PyKeypointFrames>(argument, object)?.get().inner)
}

/// Adds this file's classes to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyKeypointWorld>()?;
    module.add_class::<PyKeypointFrames>()
}
