//! The compact learned dynamics model for Python: `KeypointWorld`, `KeypointFrames`.

use hvf_core_rs::image::OverHorizon;
use hvf_core_rs::keypoint::{Cell, CellWeights, KeypointFrames, KeypointWorld, Sprite};
use hvf_core_rs::planner::{ActionSpace, Frames, WorldModel};
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArray3, PyArray4, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArray3, PyReadonlyArray4,
};
use pyo3::prelude::*;

use crate::error::to_py;

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

    fn __getitem__(&self, index: PyReadonlyArray1<'_, i64>) -> PyResult<Self> {
        let count = self.inner.len() as i64;
        let index: Vec<usize> = index
            .as_array()
            .iter()
            .map(|&i| usize::try_from(if i < 0 { i + count } else { i }).unwrap_or(usize::MAX))
            .collect();
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
    fn moved(
        &self,
        images: PyReadonlyArray4<'_, u8>,
        keypoints: PyReadonlyArray2<'_, f32>,
    ) -> PyResult<Self> {
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
        image_size, blur=0.0, over_horizon="last"
    ))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        patch: PyReadonlyArray2<'_, f32>,
        patch_bias: PyReadonlyArray1<'_, f32>,
        context: PyReadonlyArray2<'_, f32>,
        middle: PyReadonlyArray2<'_, f32>,
        middle_bias: PyReadonlyArray1<'_, f32>,
        output: PyReadonlyArray2<'_, f32>,
        output_bias: PyReadonlyArray1<'_, f32>,
        free: PyReadonlyArray2<'_, f32>,
        action_scale: f32,
        spacing: usize,
        substeps: usize,
        half_size: [f32; 2],
        edge: [f32; 2],
        colour: [f32; 3],
        action_low: Vec<f32>,
        action_high: Vec<f32>,
        image_size: usize,
        blur: f64,
        over_horizon: &str,
    ) -> PyResult<Self> {
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
            let over_horizon = OverHorizon::from_name(over_horizon)?;
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
        images: PyReadonlyArray4<'_, u8>,
        keypoints: PyReadonlyArray2<'_, f32>,
        maps: PyReadonlyArray3<'_, f32>,
    ) -> PyResult<PyKeypointFrames> {
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
        starts: &PyKeypointFrames,
        goals: &PyKeypointFrames,
        actions: PyReadonlyArray4<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let actions = actions.as_array().to_owned();
        let costs = py
            .detach(|| self.inner.rollout_costs(&starts.inner, &goals.inner, actions.into()))
            .map_err(to_py)?;
        Ok(costs.into_pyarray(py))
    }

    /// Predicted keypoints float32 `[B, D, H, 2]` of `actions [B, D, H, A]`.
    fn rollout<'py>(
        &self,
        py: Python<'py>,
        starts: &PyKeypointFrames,
        actions: PyReadonlyArray4<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray4<f32>>> {
        let actions = actions.as_array().to_owned();
        let paths =
            py.detach(|| self.inner.rollout(&starts.inner, actions.view())).map_err(to_py)?;
        Ok(paths.into_pyarray(py))
    }
}

/// Adds this file's classes to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyKeypointWorld>()?;
    module.add_class::<PyKeypointFrames>()
}
