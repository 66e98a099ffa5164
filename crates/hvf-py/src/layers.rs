//! The desk's learned dynamics model for Python: `LayerWorld`, `LayerFrames`.

use hvf_core_rs::image::OverHorizon;
use hvf_core_rs::layers::{
    Backdrop, Cell, CellWeights, Gallery, GalleryImages, LayerFrames, LayerWorld, Linear, Painter,
    Sprites,
};
use hvf_core_rs::planner::{Frames, WorldModel};
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArray4, PyArray5, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArray3, PyReadonlyArray4, PyReadonlyArray5,
};
use pyo3::prelude::*;

use crate::error::to_py;

/// Weights and bias of a layer.
type Layer<'py> = (PyReadonlyArray2<'py, f32>, PyReadonlyArray1<'py, f32>);

fn network<'a>(layers: &'a [Layer<'_>]) -> Vec<Linear<'a>> {
    layers.iter().map(|(weights, bias)| (weights.as_array(), bias.as_array())).collect()
}

/// Frames of a `LayerWorld`.
#[pyclass(name = "LayerFrames", module = "hvf_core", frozen)]
pub struct PyLayerFrames {
    /// The frames.
    pub inner: LayerFrames,
}

#[pymethods]
impl PyLayerFrames {
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
            bytes.extend_from_slice(&self.inner.image(i));
        }
        ndarray::Array4::from_shape_vec((count, size, size, 3), bytes)
            .unwrap_or_default()
            .into_pyarray(py)
    }

    /// The states, float32 `[N, X]` (a copy).
    #[getter]
    fn states<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f32>> {
        let shape = (self.inner.len(), self.inner.state_size());
        ndarray::Array2::from_shape_fn(shape, |(i, x)| self.inner.state(i)[x]).into_pyarray(py)
    }

    fn __repr__(&self) -> String {
        format!("LayerFrames({} frames of {} pixels)", self.inner.len(), self.inner.image_size())
    }
}

/// The desk's learned dynamics model as a world model. Actions beyond the box are taken as they
/// are: the model extrapolates.
#[pyclass(name = "LayerWorld", module = "hvf_core", frozen)]
pub struct PyLayerWorld {
    /// The world.
    pub inner: LayerWorld,
}

#[pymethods]
impl PyLayerWorld {
    #[new]
    #[pyo3(signature = (
        *, hand, sliders, parts, contact, reach, arm_low, arm_step, arm_places, arm_patches,
        arm_index, table, sprites, blur=0.0, over_horizon="last"
    ))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        hand: Vec<Layer<'_>>,
        sliders: Vec<Vec<Layer<'_>>>,
        parts: Vec<Layer<'_>>,
        contact: PyReadonlyArray2<'_, f32>,
        reach: f32,
        arm_low: [f32; 3],
        arm_step: [f32; 3],
        arm_places: [usize; 3],
        arm_patches: PyReadonlyArray4<'_, u8>,
        arm_index: PyReadonlyArray2<'_, i32>,
        table: PyReadonlyArray5<'_, u8>,
        sprites: PyReadonlyArray4<'_, f32>,
        blur: f64,
        over_horizon: &str,
    ) -> PyResult<Self> {
        let build = || {
            let sprites = Sprites::new(sprites.as_array())?;
            let cell = Cell::new(&CellWeights {
                hand: network(&hand),
                sliders: sliders.iter().map(|layers| network(layers)).collect(),
                parts: network(&parts),
                contact: contact.as_array(),
                reach,
                roaming: sprites.count(),
            })?;
            let images = GalleryImages {
                low: arm_low,
                step: arm_step,
                places: arm_places,
                patches: arm_patches.as_array(),
                index: arm_index.as_array(),
            };
            let gallery = Gallery::new(&images, Backdrop::image_size(table.as_array())?)?;
            let backdrop = Backdrop::new(table.as_array(), gallery.tiles())?;
            let painter = Painter::new(backdrop, sprites, gallery)?;
            LayerWorld::new(cell, painter, blur, OverHorizon::from_name(over_horizon)?)
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

    /// Frames of this world.
    fn frames(
        &self,
        images: PyReadonlyArray4<'_, u8>,
        clean: PyReadonlyArray4<'_, f32>,
        regions: PyReadonlyArray4<'_, bool>,
        states: PyReadonlyArray2<'_, f32>,
    ) -> PyResult<PyLayerFrames> {
        let inner = self
            .inner
            .frames(images.as_array(), clean.as_array(), regions.as_array(), states.as_array())
            .map_err(to_py)?;
        Ok(PyLayerFrames { inner })
    }

    /// Planning costs float32 `[B, D]` of `actions [B, D, H, A]`.
    fn rollout_costs<'py>(
        &self,
        py: Python<'py>,
        starts: &PyLayerFrames,
        goals: &PyLayerFrames,
        actions: PyReadonlyArray4<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let actions = actions.as_array().to_owned();
        let costs = py
            .detach(|| self.inner.rollout_costs(&starts.inner, &goals.inner, actions.into()))
            .map_err(to_py)?;
        Ok(costs.into_pyarray(py))
    }

    /// Planning costs float32 `[B, D]` of `actions [D, H, A]` from one start for every goal.
    fn shared_rollout_costs<'py>(
        &self,
        py: Python<'py>,
        start: &PyLayerFrames,
        goals: &PyLayerFrames,
        actions: PyReadonlyArray3<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let actions = actions.as_array();
        let costs = py
            .detach(|| self.inner.shared_costs(&start.inner, &goals.inner, actions))
            .map_err(to_py)?;
        Ok(costs.into_pyarray(py))
    }

    /// Predicted states float32 `[B, D, H, X]` of `actions [B, D, H, A]`.
    fn rollout<'py>(
        &self,
        py: Python<'py>,
        starts: &PyLayerFrames,
        actions: PyReadonlyArray4<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray4<f32>>> {
        let actions = actions.as_array();
        let paths = py.detach(|| self.inner.rollout(&starts.inner, actions)).map_err(to_py)?;
        Ok(paths.into_pyarray(py))
    }

    /// Frames float32 `[N, S, S, 3]` in [0, 1] of what `starts` look like at `states [N, X]`.
    fn draw<'py>(
        &self,
        py: Python<'py>,
        starts: &PyLayerFrames,
        states: PyReadonlyArray2<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray4<f32>>> {
        let states = states.as_array();
        let frames = py.detach(|| self.inner.draw(&starts.inner, states)).map_err(to_py)?;
        Ok(frames.into_pyarray(py))
    }

    /// Predicted frames uint8 `[N, H, S, S, 3]` of `actions [N, H, A]`.
    fn predict<'py>(
        &self,
        py: Python<'py>,
        starts: &PyLayerFrames,
        actions: PyReadonlyArray3<'py, f32>,
    ) -> PyResult<Bound<'py, PyArray5<u8>>> {
        let actions = actions.as_array();
        let frames = py.detach(|| self.inner.predict(&starts.inner, actions)).map_err(to_py)?;
        Ok(frames.into_pyarray(py))
    }
}

/// Adds this file's classes to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyLayerWorld>()?;
    module.add_class::<PyLayerFrames>()
}
