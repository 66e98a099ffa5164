//! The desk's learned dynamics model for Python: `LayerWorld`, `LayerFrames`.

use hvf_core_rs::image::OverHorizon;
use hvf_core_rs::layers::{
    Backdrop, Cell, CellWeights, Gallery, GalleryImages, LayerFrames, LayerWorld, Painter, Sprites,
};
use hvf_core_rs::nn::Linear;
use hvf_core_rs::planner::{Frames, WorldModel};
use ndarray::{Ix2, Ix3, Ix4};
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArray4, PyArray5, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArray4, PyReadonlyArray5,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arguments::{
    array, booleans, indices, instance, items, places, point, text, unfit, Given, Real, Text, Whole,
};
use crate::error::to_py;
use crate::threads::detached;

/// Weights and bias of a layer.
type Layer<'py> = (PyReadonlyArray2<'py, f32>, PyReadonlyArray1<'py, f32>);

/// Most layers of a network, and most networks of one kind.
const MOST_LAYERS: usize = 1 << 10;

fn few<'py>(
    argument: &str,
    object: &Bound<'py, PyAny>,
    expected: &str,
) -> PyResult<Vec<Bound<'py, PyAny>>> {
    let found = items(argument, object, expected, MOST_LAYERS)?;
    if found.len() > MOST_LAYERS {
        let problem = format!("{argument}: expected at most {MOST_LAYERS} {expected}, got more");
        return Err(PyValueError::new_err(problem));
    }
    Ok(found)
}

fn layers<'py>(argument: &str, object: &Bound<'py, PyAny>) -> PyResult<Vec<Layer<'py>>> {
    const EXPECTED: &str = "layers (weights, bias)";
    let pairs = few(argument, object, EXPECTED)?;
    let layer = |pair: Bound<'py, PyAny>| match items(argument, &pair, EXPECTED, 2)?.as_slice() {
        [weights, bias] => Ok((
            array(argument, weights, "weights float32 [outputs, inputs]")?,
            array(argument, bias, "bias float32 [outputs]")?,
        )),
        _ => Err(PyValueError::new_err(unfit(argument, EXPECTED, &pair))),
    };
    pairs.into_iter().map(layer).collect()
}

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
        arm_index, table, sprites, blur=Given::of(0.0), over_horizon=text("last"),
        hold=Whole::of(1), scene_weight=Given::of(0.0)
    ), text_signature = "(*, hand, sliders, parts, contact, reach, arm_low, arm_step, arm_places, \
                         arm_patches, arm_index, table, sprites, blur=0.0, over_horizon='last', \
                         hold=1, scene_weight=0.0)")]
    #[allow(clippy::too_many_arguments)]
    fn new(
        hand: &Bound<'_, PyAny>,
        sliders: &Bound<'_, PyAny>,
        parts: &Bound<'_, PyAny>,
        contact: &Bound<'_, PyAny>,
        reach: Real,
        arm_low: &Bound<'_, PyAny>,
        arm_step: &Bound<'_, PyAny>,
        arm_places: &Bound<'_, PyAny>,
        arm_patches: &Bound<'_, PyAny>,
        arm_index: &Bound<'_, PyAny>,
        table: &Bound<'_, PyAny>,
        sprites: &Bound<'_, PyAny>,
        blur: Real,
        over_horizon: Text,
        hold: Whole,
        scene_weight: Real,
    ) -> PyResult<Self> {
        let hand = layers("hand", hand)?;
        let sliders = few("sliders", sliders, "networks of layers")?;
        let sliders: Vec<Vec<Layer<'_>>> =
            sliders.iter().map(|network| layers("sliders", network)).collect::<PyResult<_>>()?;
        let parts = layers("parts", parts)?;
        let contact: PyReadonlyArray2<'_, f32> = array("contact", contact, "float32 [terms, 2]")?;
        let reach = reach.single("reach")?;
        let (arm_low, arm_step) = (point("arm_low", arm_low)?, point("arm_step", arm_step)?);
        let arm_places = places("arm_places", arm_places)?;
        let arm_patches: PyReadonlyArray4<'_, u8> =
            array("arm_patches", arm_patches, "uint8 [M, 4, T, T]")?;
        let arm_index: PyReadonlyArray2<'_, i32> =
            array("arm_index", arm_index, "int32 [places, tiles]")?;
        let table: PyReadonlyArray5<'_, u8> = array("table", table, "uint8 [bins, bins, 3, S, S]")?;
        let sprites: PyReadonlyArray4<'_, f32> = array("sprites", sprites, "float32 [R, 4, W, W]")?;
        let blur = blur.get("blur")?;
        let over_horizon = over_horizon.get("over_horizon")?;
        let hold = hold.count("hold")?;
        let scene_weight = scene_weight.get("scene_weight")?;
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
            LayerWorld::new(cell, painter, blur, OverHorizon::from_name(&over_horizon)?)?
                .holding(hold)?
                .weighing_scene(scene_weight)
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
        images: &Bound<'_, PyAny>,
        clean: &Bound<'_, PyAny>,
        regions: &Bound<'_, PyAny>,
        states: &Bound<'_, PyAny>,
    ) -> PyResult<PyLayerFrames> {
        let images = array::<u8, Ix4>("images", images, "uint8 [N, S, S, 3]")?;
        let clean = array::<f32, Ix4>("clean", clean, "float32 [N, S, S, 3]")?;
        let regions = booleans::<Ix4>("regions", regions, "bool [N, R, S, S]")?;
        let states = array::<f32, Ix2>("states", states, "float32 [N, X]")?;
        let inner = self
            .inner
            .frames(images.as_array(), clean.as_array(), regions.view(), states.as_array())
            .map_err(to_py)?;
        Ok(PyLayerFrames { inner })
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

    /// Planning costs float32 `[B, D]` of `actions [D, H, A]` from one start for every goal.
    fn shared_rollout_costs<'py>(
        &self,
        py: Python<'py>,
        start: &Bound<'py, PyAny>,
        goals: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let start = frames("start", start)?;
        let goals = frames("goals", goals)?;
        let actions = array::<f32, Ix3>("actions", actions, "float32 [D, H, A]")?;
        let actions = actions.as_array();
        let costs =
            detached(py, || self.inner.shared_costs(start, goals, actions))?.map_err(to_py)?;
        Ok(costs.into_pyarray(py))
    }

    /// Predicted states float32 `[B, D, H, X]` of `actions [B, D, H, A]`.
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

    /// Frames float32 `[N, S, S, 3]` in [0, 1] of what `starts` look like at `states [N, X]`.
    fn draw<'py>(
        &self,
        py: Python<'py>,
        starts: &Bound<'py, PyAny>,
        states: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray4<f32>>> {
        let starts = frames("starts", starts)?;
        let states = array::<f32, Ix2>("states", states, "float32 [N, X]")?;
        let states = states.as_array();
        let drawn = detached(py, || self.inner.draw(starts, states))?.map_err(to_py)?;
        Ok(drawn.into_pyarray(py))
    }

    /// Predicted frames uint8 `[N, H, S, S, 3]` of `actions [N, H, A]`.
    fn predict<'py>(
        &self,
        py: Python<'py>,
        starts: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray5<u8>>> {
        let starts = frames("starts", starts)?;
        let actions = array::<f32, Ix3>("actions", actions, "float32 [N, H, A]")?;
        let actions = actions.as_array();
        let predicted = detached(py, || self.inner.predict(starts, actions))?.map_err(to_py)?;
        Ok(predicted.into_pyarray(py))
    }
}

fn frames<'a>(argument: &str, object: &'a Bound<'_, PyAny>) -> PyResult<&'a LayerFrames> {
    Ok(&instance::<PyLayerFrames>(argument, object)?.get().inner)
}

/// Adds this file's classes to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyLayerWorld>()?;
    module.add_class::<PyLayerFrames>()
}
