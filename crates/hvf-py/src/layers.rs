//! The desk's learned dynamics model for Python: `LayerWorld`, `LayerFrames`.

use hvf_core_rs::image::OverHorizon;
use hvf_core_rs::layers::{
    Backdrop, Cell, CellWeights, Gallery, GalleryImages, LayerFrames, LayerWorld, Painter, Sprites,
};
use hvf_core_rs::nn::Linear;
use hvf_core_rs::planner::Frames;
use ndarray::{Array3, Array4, Ix2, Ix4};
use numpy::{
    IntoPyArray, PyArray2, PyArray4, PyArray5, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArray4, PyReadonlyArray5,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arguments::{
    array, booleans, indices, instance, items, places, point, text, unfit, Given, Real, Text, Whole,
};
use crate::error::to_py;
use crate::threads::detached;
use crate::worlds::{self, action_box, rollout_costs_doc, shared_rollout_costs_doc, Costs};

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

/// Frames of a `LayerWorld`: images, the same without the arm, where parts are, and states.
///
/// Made by `LayerWorld.frames`. `frames[i]` are those at an integer (one frame, still a batch) or
/// at integers `[N]`; they share memory.
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

/// The desk's learned dynamics model, evaluated in Rust; a world model with actions in [-1, 1].
///
/// `hvf.worlds.layers.LayerWorld` makes one from a trained
/// `hvf.models.layers.dynamics.LayerDynamics`. The cost is the squared pixel distance of the
/// predicted frame to the goal, per pixel. Costs agree with those of torch to 1e-3 of their value,
/// rollouts of 15 steps to 1e-2 pixels. Actions beyond the box are taken as they are: the model,
/// which was trained within it, extrapolates.
///
/// Letters in shapes: `A` = 3 action dimensions, `G` = 2 sliders, `R` parts that roam, `C` length
/// of their memory, `T` size of a tile, `W` size of a sprite, `S` image size, `X` = A + G + 3R
/// length of a state (hand; sliders; row, column and presence of each part).
/// Networks are lists of layers, weights `[outputs, inputs]` and bias `[outputs]` as in
/// `torch.nn.Linear`, with rectified units between.
///
/// Args:
///     hand: From hand, action and sliders (2A + G) to the hand's motion (A).
///     sliders: For each, from sliders, hand, motion and action (G + 3A) to its motion (1).
///     parts: From the hand beside the part, the hand's way, hand, motion, action, the part and its
///         memory (7 + 3A + C) to its motion, change of presence and of memory (3 + C).
///     contact: Terms of the pixel where the hand meets parts, float32
///         `[1 + A + A (A + 1) / 2, 2]`.
///     reach: Pixels from the hand's way beyond which a part does not move.
///     arm_low: The hand's code at the first place of the grid of the arm's images, A numbers.
///     arm_step: From one place to the next.
///     arm_places: Places of the grid in each dimension.
///     arm_patches: Opacity and colour times opacity of tiles, uint8 `[M, 4, T, T]`; the first is
///         empty.
///     arm_index: Number of the patch in each tile of each place's image, int32
///         `[places, (S / T)**2]`.
///     table: What is behind everything, uint8 `[bins, bins, 3, S, S]` over the sliders' ways.
///     sprites: Opacity and colour times opacity of each part, float32 `[R, 4, W, W]`.
///     blur: Standard deviation of the Gaussian blur before frames are compared, in pixels.
///     over_horizon: 'last', 'sum' or 'min' over the predicted frames.
///     hold: Steps that each action is held for; only frames after a held action count.
///     scene_weight: How often what is behind the arm counts, beside the whole frame: the squared
///         distance of frames without their arms, where the goal's hides nothing, without a blur.
///
/// Raises:
///     ValueError: Shapes that do not fit each other, or numbers out of range, of any size.
///     TypeError: Arrays of another dtype, or objects of another kind.
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

    /// Frames of this world.
    ///
    /// Args:
    ///     images: uint8 `[N, S, S, 3]`.
    ///     clean: The same without the arm, in [0, 1], float32 `[N, S, S, 3]`.
    ///     regions: Where each part is in them, bool `[N, R, S, S]`.
    ///     states: float32 `[N, X]`.
    ///
    /// Raises:
    ///     ValueError: Shapes that do not fit each other or the world, or numbers that are not
    ///         finite.
    ///     TypeError: Arrays of another dtype, or what is no array.
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

    #[doc = shared_rollout_costs_doc!()]
    fn shared_rollout_costs<'py>(
        &self,
        py: Python<'py>,
        start: &Bound<'py, PyAny>,
        goals: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Costs<'py>> {
        let frames = [frames("start", start)?, frames("goals", goals)?];
        let actions = worlds::actions(actions, "float32 [D, H, A]")?;
        worlds::shared_rollout_costs(py, &self.inner, frames, actions)
    }

    /// Predicted states, float32 `[B, D, H, X]`.
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
        worlds::few("actions", &[problems, candidates, steps, starts.state_size()])?;
        let paths = detached(py, || self.inner.rollout(starts, actions.view()))?.map_err(to_py)?;
        Ok(paths.into_pyarray(py))
    }

    /// What frames look like with other states, float32 `[N, S, S, 3]` in [0, 1].
    ///
    /// Args:
    ///     starts: Frames of this world, `[N]`: their scene, and what is seen where.
    ///     states: The states to be drawn, float32 `[N, X]`.
    ///
    /// Raises:
    ///     ValueError: Frames or states that do not fit the world or each other.
    ///     TypeError: An argument of another kind or dtype.
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

    /// Predicted frames, uint8 `[N, H, S, S, 3]`.
    ///
    /// Args:
    ///     starts: Frames of this world, `[N]`.
    ///     actions: What is done from each, float32 `[N, H, A]`. The answer may have at most 2**28
    ///         numbers.
    ///
    /// Raises:
    ///     As `rollout_costs`.
    fn predict<'py>(
        &self,
        py: Python<'py>,
        starts: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray5<u8>>> {
        let starts = frames("starts", starts)?;
        let actions: Array3<f32> = worlds::actions(actions, "float32 [N, H, A]")?;
        let (count, steps, _) = actions.dim();
        let size = starts.image_size();
        worlds::few("actions", &[count, steps, size, size, 3])?;
        let predicted = detached(py, || self.inner.predict(starts, actions.view()))?;
        Ok(predicted.map_err(to_py)?.into_pyarray(py))
    }
}

action_box!(PyLayerWorld);

fn frames<'a>(argument: &str, object: &'a Bound<'_, PyAny>) -> PyResult<&'a LayerFrames> {
    Ok(&instance::<PyLayerFrames>(argument, object)?.get().inner)
}

/// Adds this file's classes to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyLayerWorld>()?;
    module.add_class::<PyLayerFrames>()
}
