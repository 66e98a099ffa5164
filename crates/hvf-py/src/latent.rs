//! The latent world for Python: `LatentWorld`, `LatentFrames`.

use hvf_core_rs::image::OverHorizon;
use hvf_core_rs::latent::{Known, LatentFrames, LatentWorld};
use hvf_core_rs::planner::{ActionSpace, Frames, WorldModel};
use ndarray::{Array, Array2, Array4, ArrayView, Dimension, Ix1};
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArray4, PyReadonlyArray1, PyReadonlyArray2,
    PyReadonlyArray3, PyReadonlyArray4,
};
use pyo3::exceptions::{PyAttributeError, PyValueError};
use pyo3::prelude::*;

use crate::arguments::{array, indices, instance, numbers, text, Text, Whole};
use crate::error::to_py;
use crate::latent_weights;
use crate::threads::detached;

/// The most numbers that one call takes actions of.
const MAX_VALUES: usize = 1 << 28;

/// Frames of a `LatentWorld`: latents, and what is known of the frames besides. Immutable; the stub
/// file describes every argument.
#[pyclass(name = "LatentFrames", module = "hvf_core", frozen)]
pub struct PyLatentFrames {
    /// The frames.
    pub inner: LatentFrames,
}

#[pymethods]
impl PyLatentFrames {
    #[new]
    #[pyo3(signature = (latents, targets=None, constants=None, images=None))]
    fn new(
        latents: &Bound<'_, PyAny>,
        targets: Option<&Bound<'_, PyAny>>,
        constants: Option<&Bound<'_, PyAny>>,
        images: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let latents: PyReadonlyArray2<'_, f32> = array("latents", latents, "float32 [N, Z]")?;
        let targets: Option<PyReadonlyArray2<'_, f32>> =
            targets.map(|given| array("targets", given, "float32 [N, P]")).transpose()?;
        let constants: Option<PyReadonlyArray1<'_, f32>> =
            constants.map(|given| array("constants", given, "float32 [N]")).transpose()?;
        let images: Option<PyReadonlyArray4<'_, u8>> =
            images.map(|given| array("images", given, "uint8 [N, H, W, 3]")).transpose()?;
        let known = Known {
            targets: targets.as_ref().map(|rows| rows.as_array()),
            constants: constants.as_ref().map(|numbers| numbers.as_array()),
            images: images.as_ref().map(|images| images.as_array()),
        };
        Ok(Self { inner: LatentFrames::new(latents.as_array(), known).map_err(to_py)? })
    }

    fn __len__(&self) -> usize {
        self.inner.len()
    }

    /// The frames at `index`: an integer (one frame, still a batch) or an integer array.
    fn __getitem__(&self, index: &Bound<'_, PyAny>) -> PyResult<Self> {
        let picked = indices(index, self.inner.len())?;
        Ok(Self { inner: self.inner.select(&picked).map_err(to_py)? })
    }

    /// The latents, float32 `[N, Z]` (a copy).
    #[getter]
    fn latents<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f32>> {
        let shape = (self.inner.len(), self.inner.latent_dim());
        Array2::from_shape_fn(shape, |(i, z)| self.inner.latent(i)[z]).into_pyarray(py)
    }

    /// What read-outs are compared with, float32 `[N, P]` (a copy), or None.
    #[getter]
    fn targets<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray2<f32>>> {
        let shape = (self.inner.len(), self.inner.target_dim()?);
        let value = |(i, p)| self.inner.target(i).map_or(0.0, |target| target[p]);
        Some(Array2::from_shape_fn(shape, value).into_pyarray(py))
    }

    /// What predicted frames cost more, float32 `[N]` (a copy).
    #[getter]
    fn constants<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        let constants = (0..self.inner.len()).map(|i| self.inner.constant(i));
        PyArray1::from_iter(py, constants)
    }

    /// The images, uint8 `[N, H, W, 3]` (a copy). Raises AttributeError where none were given.
    #[getter]
    fn images<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray4<u8>>> {
        let kept = self
            .inner
            .images()
            .ok_or_else(|| PyAttributeError::new_err("images: these frames keep none"))?;
        let shape = (self.inner.len(), kept.height, kept.width, 3);
        Ok(Array4::from_shape_vec(shape, kept.bytes).unwrap_or_default().into_pyarray(py))
    }

    fn __repr__(&self) -> String {
        format!("LatentFrames({} frames of {})", self.inner.len(), self.inner.latent_dim())
    }
}

/// A world whose frames are latents, moved by a network that is given by its weights. The stub file
/// describes every argument.
///
/// `dynamics` is a dict: of a network with residual blocks (`input`, `blocks`, `output`,
/// `activation`, `scale`), or the weights of a `torch.nn.GRUCell` under their names there. `readout`
/// is None, a matrix, or a dict of a network. The planners use it without the GIL.
#[pyclass(name = "LatentWorld", module = "hvf_core", frozen)]
pub struct PyLatentWorld {
    /// The world.
    pub inner: LatentWorld,
}

#[pymethods]
impl PyLatentWorld {
    #[new]
    #[pyo3(signature = (
        action_low, action_high, dynamics, *, readout=None, weights=None, over_horizon=text("last"),
        hold=Whole::of(1)
    ), text_signature = "(action_low, action_high, dynamics, *, readout=None, weights=None, \
                         over_horizon='last', hold=1)")]
    #[allow(clippy::too_many_arguments)]
    fn new(
        action_low: &Bound<'_, PyAny>,
        action_high: &Bound<'_, PyAny>,
        dynamics: &Bound<'_, PyAny>,
        readout: Option<&Bound<'_, PyAny>>,
        weights: Option<&Bound<'_, PyAny>>,
        over_horizon: Text,
        hold: Whole,
    ) -> PyResult<Self> {
        let low = numbers::<f32, Ix1>("action_low", action_low, "a float array [A]")?.to_vec();
        let high = numbers::<f32, Ix1>("action_high", action_high, "a float array [A]")?.to_vec();
        let actions = ActionSpace::new(low, high).map_err(to_py)?;
        let over_horizon = over_horizon.get("over_horizon")?;
        let over_horizon = OverHorizon::from_name(&over_horizon).map_err(to_py)?;
        let hold = hold.count("hold")?;
        let dynamics = latent_weights::dynamics(dynamics)?;
        let cost = latent_weights::cost(dynamics.latent_dim(), readout, weights)?;
        let made = LatentWorld::new(dynamics, cost, actions, over_horizon, hold);
        Ok(Self { inner: made.map_err(to_py)? })
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

    /// Length of a latent, `Z`.
    #[getter]
    fn latent_dim(&self) -> usize {
        self.inner.latent_dim()
    }

    /// Which predicted frames count.
    #[getter]
    fn over_horizon(&self) -> &'static str {
        self.inner.over_horizon().name()
    }

    /// Steps of actions that one step of the dynamics is long.
    #[getter]
    fn hold(&self) -> usize {
        self.inner.hold()
    }

    /// The most candidates that the planners should ask for in one call.
    #[getter]
    fn max_candidates(&self) -> usize {
        self.inner.max_candidates()
    }

    /// Planning costs float32 `[B, D]` of `actions [B, D, H, A]`.
    fn rollout_costs<'py>(
        &self,
        py: Python<'py>,
        starts: &Bound<'py, PyAny>,
        goals: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let (starts, goals) = (frames("starts", starts)?, frames("goals", goals)?);
        let actions = array("actions", actions, "float32 [B, D, H, A]")?;
        let actions = owned(actions.as_array())?;
        let costs = detached(py, || self.inner.rollout_costs(starts, goals, actions.into()))?
            .map_err(to_py)?;
        Ok(costs.into_pyarray(py))
    }

    /// Planning costs float32 `[B, D]` of `actions [D, H, A]` from one start for every goal: those
    /// of `rollout_costs`, to the last bit.
    fn shared_rollout_costs<'py>(
        &self,
        py: Python<'py>,
        start: &Bound<'py, PyAny>,
        goals: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let (start, goals) = (frames("start", start)?, frames("goals", goals)?);
        let actions: PyReadonlyArray3<'_, f32> = array("actions", actions, "float32 [D, H, A]")?;
        let actions = owned(actions.as_array())?;
        let costs = detached(py, || self.inner.shared_costs(start, goals, actions.view()))?
            .map_err(to_py)?;
        Ok(costs.into_pyarray(py))
    }

    /// Predicted latents float32 `[B, D, H / hold, Z]` of `actions [B, D, H, A]`.
    fn rollout<'py>(
        &self,
        py: Python<'py>,
        starts: &Bound<'py, PyAny>,
        actions: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray4<f32>>> {
        let starts = frames("starts", starts)?;
        let actions = array("actions", actions, "float32 [B, D, H, A]")?;
        let actions: Array4<f32> = owned(actions.as_array())?;
        let paths = detached(py, || self.inner.rollout(starts, actions.view()))?.map_err(to_py)?;
        Ok(paths.into_pyarray(py))
    }

    fn __repr__(&self) -> String {
        let (latent, dim) = (self.inner.latent_dim(), self.inner.action_space().dim());
        format!("LatentWorld(latents of {latent}, actions of {dim})")
    }
}

fn frames<'a>(argument: &str, object: &'a Bound<'_, PyAny>) -> PyResult<&'a LatentFrames> {
    Ok(&instance::<PyLatentFrames>(argument, object)?.get().inner)
}

/// A copy of actions, if they are not more than any memory holds (arrays may repeat themselves).
fn owned<D: Dimension>(actions: ArrayView<'_, f32, D>) -> PyResult<Array<f32, D>> {
    if actions.len() > MAX_VALUES {
        return Err(PyValueError::new_err(format!(
            "actions: must be at most {MAX_VALUES} numbers, got {:?}",
            actions.shape()
        )));
    }
    Ok(actions.to_owned())
}

/// Adds this file's classes to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyLatentWorld>()?;
    module.add_class::<PyLatentFrames>()
}
