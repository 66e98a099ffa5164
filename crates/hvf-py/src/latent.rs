//! The latent world for Python: `LatentWorld`, `LatentFrames`.

use hvf_core_rs::image::OverHorizon;
use hvf_core_rs::latent::{Known, LatentFrames, LatentWorld};
use hvf_core_rs::planner::{ActionSpace, Frames, WorldModel};
use ndarray::{Array2, Array4, Ix1};
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArray4, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray4,
};
use pyo3::exceptions::PyAttributeError;
use pyo3::prelude::*;

use crate::arguments::{array, indices, instance, numbers, text, Text, Whole};
use crate::error::to_py;
use crate::latent_weights;
use crate::threads::detached;
use crate::worlds::{self, action_box, rollout_costs_doc, shared_rollout_costs_doc, Costs};

/// Frames of a `LatentWorld`: latents, and what is known of the frames besides. Immutable.
///
/// Frames are of no world: any with latents of this length takes them. As starts, only their
/// latents count; as goals, their targets (where there are none, what the world reads out of their
/// latents) and constants. `frames[i]` are those at an integer (one frame, still a batch) or at
/// integers `[N]`; they share memory.
///
/// Args:
///     latents: float32 `[N, Z]`.
///     targets: What the read-out of a predicted latent is compared with where a frame is the goal,
///         float32 `[N, P]`; None for the read-out of the frame's own latent.
///     constants: What every predicted frame that counts costs more where a frame is the goal,
///         float32 `[N]`; None for nothing. A read-out of the main part of an image makes its whole
///         pixel cost so: the rest of the goal image, which no read-out can reach, is a constant.
///     images: What the frames look like, uint8 `[N, H, W, 3]`: kept for others.
///
/// Raises:
///     ValueError: Another shape, not as many of one as of the other, or numbers that are not
///         finite.
///     TypeError: Another dtype, or what is no array.
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

    /// The images, uint8 `[N, H, W, 3]` (a copy).
    ///
    /// Raises:
    ///     AttributeError: No images were given.
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

/// A world whose frames are latents, moved by a network that is given by its weights.
///
/// For models whose state is a vector, trained with torch or anything else: rollouts and costs run
/// in Rust on all cores, without torch and without the GIL. To plan from images, give the planner
/// an object with this world as its `native` and a method `observe(images) -> LatentFrames`.
///
/// *Dynamics.* An action `[A]` is scaled so that its box is from -1 to 1 (one beyond the box is
/// taken as it is): `u`. Then `z' = z + scale * network([z, u])`, or `z' = GRUCell(u, z)`.
///
/// *Networks* are dicts of weights as `torch.nn.Linear` stores them, `(weight [outputs, inputs],
/// bias [outputs])`, all float32:
///
/// ```python
/// {"input": (weight, bias),
///  "blocks": [((weight, bias), (weight, bias)), ...],   # may be left out
///  "output": (weight, bias),
///  "activation": "relu" or "sin"}                       # may be left out: "relu"
/// ```
///
/// that is `h = activation(input(x))`, `h = relu(h + second(relu(first(h))))` for every block,
/// `output(h)`.
///
/// *Cost.* `sum(weights * (read(z) - target)**2) + constant` of every predicted latent that counts;
/// target and constant are the goal's (`LatentFrames`). Without a read-out, `read(z) = z`.
///
/// The same costs to the last bit alone and in a batch, with rollouts shared or not, on any number
/// of threads, on any machine; those of torch within float32's rounding.
///
/// Args:
///     action_low: Lowest action, `[A]`.
///     action_high: Highest action, `[A]`.
///     dynamics: A network's dict, from `Z + A` numbers (the latent first) to `Z`, with one more
///         entry, `"scale"`: a number or float32 `[Z]`, 1 if left out; or the weights of a
///         `torch.nn.GRUCell(A, Z)` under their names there (`weight_ih [3 Z, A]`,
///         `weight_hh [3 Z, Z]`, `bias_ih`, `bias_hh [3 Z]`): `cell.state_dict()`, as arrays.
///     readout: What is compared of a latent: None for the latent itself (`P = Z`), a network's
///         dict from `Z` numbers to `P`, or a float32 matrix `[P, Z]`. A matrix costs no more than
///         `Z` rows would, however many it has, but is compared with goals' latents only, not with
///         targets.
///     weights: Of the numbers of the read-out, float32 `[P]`, none negative; None for 1.
///     over_horizon: 'last', 'sum' or 'min' over the predicted latents.
///     hold: Steps of actions that one step of the dynamics is long. The first of each `hold`
///         actions is taken. A horizon must be a multiple of it, and so should the planners'
///         `action_repeat`.
///
/// Raises:
///     ValueError: Shapes that do not fit each other, numbers out of range or not finite, entries
///         that are missing or unknown; the message names the argument.
///     TypeError: An argument of another kind or dtype.
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

    /// Length of a latent, `Z`.
    #[getter]
    fn latent_dim(&self) -> usize {
        self.inner.latent_dim()
    }

    /// Which predicted latents count.
    #[getter]
    fn over_horizon(&self) -> &'static str {
        self.inner.over_horizon().name()
    }

    /// Steps of actions that one step of the dynamics is long.
    #[getter]
    fn hold(&self) -> usize {
        self.inner.hold()
    }

    /// The most candidates that the planners ask for in one call: fewer for dearer networks.
    #[getter]
    fn max_candidates(&self) -> usize {
        self.inner.max_candidates()
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

    /// Predicted latents, float32 `[B, D, H / hold, Z]`.
    ///
    /// Args:
    ///     starts: Frames that candidates start from, `[B]`.
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
        let paths = detached(py, || self.inner.rollout(starts, actions.view()))?.map_err(to_py)?;
        Ok(paths.into_pyarray(py))
    }

    fn __repr__(&self) -> String {
        let (latent, dim) = (self.inner.latent_dim(), self.inner.action_space().dim());
        format!("LatentWorld(latents of {latent}, actions of {dim})")
    }
}

action_box!(PyLatentWorld);

fn frames<'a>(argument: &str, object: &'a Bound<'_, PyAny>) -> PyResult<&'a LatentFrames> {
    Ok(&instance::<PyLatentFrames>(argument, object)?.get().inner)
}

/// Adds this file's classes to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyLatentWorld>()?;
    module.add_class::<PyLatentFrames>()
}
