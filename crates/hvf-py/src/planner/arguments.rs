//! What planners are called with beside models: a frame, seeds, earlier plans, corners.

use hvf_core_rs::planner::{Frames, Plan};
use ndarray::{Array3, Array4, Axis, Ix1, Ix2, Ix3, Ix4, Slice};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::border::{Axes, Border, FramesOf};
use super::results::{PyPlan, PyPlans};
pub use crate::arguments::Whole;
use crate::arguments::{items, numbers, Given};

/// One seed for all problems or one for each; none is seed 0.
pub fn seeds(seeds: Option<&Bound<'_, PyAny>>, problems: usize) -> PyResult<Vec<u64>> {
    const EXPECTED: &str = "an integer, a sequence of integers, or None";
    let Some(seeds) = seeds else {
        return Ok(vec![0; problems]);
    };
    match seeds.extract::<Whole>()?.get("seeds") {
        Ok(seed) => return Ok(vec![Given::of(seed).seed("seeds")?; problems]),
        Err(other) if !other.is_instance_of::<PyTypeError>(seeds.py()) => return Err(other),
        Err(_) => {}
    }
    let list = items("seeds", seeds, EXPECTED, problems)?;
    if list.len() != problems {
        let found = match list.len() {
            more if more > problems => "more".into(),
            fewer => fewer.to_string(),
        };
        return Err(PyValueError::new_err(format!(
            "seeds: must be as many as goals ({problems}), got {found}"
        )));
    }
    list.into_iter().map(|seed| seed.extract::<Whole>()?.seed("seeds")).collect()
}

/// The last plans of a batch, and their best candidates where these are known.
pub struct LastPlans {
    /// Actions, `[B, H, A]`.
    pub actions: Array3<f32>,
    /// Best candidates, `[B, S, H, A]`.
    pub elites: Option<Array4<f32>>,
}

/// A plan to start from: a `Plan` or actions `[H, A]`; and its best candidates `[S, H, A]`, unless it
/// brings its own, of which the next plan takes `most`.
pub fn one_warm_start(
    plan: Option<&Bound<'_, PyAny>>,
    elites: Option<&Bound<'_, PyAny>>,
    most: usize,
) -> PyResult<Option<LastPlans>> {
    let read = |elites| numbers::<f32, Ix3>("warm_elites", elites, "a float array [S, H, A]");
    let given = elites.map(read).transpose()?.map(|elites| elites.insert_axis(Axis(0)));
    let Some(plan) = plan else {
        return none_without_plan(given);
    };
    if let Ok(plan) = plan.cast::<PyPlan>() {
        let Plan { actions, elites, .. } = &plan.get().inner;
        return Ok(Some(LastPlans {
            actions: actions.clone().insert_axis(Axis(0)),
            elites: given.or_else(|| Some(best(elites.clone().insert_axis(Axis(0)), most))),
        }));
    }
    let actions = numbers::<f32, Ix2>("warm_start", plan, "a Plan or a float array [H, A]")?;
    Ok(Some(LastPlans { actions: actions.insert_axis(Axis(0)), elites: given }))
}

/// Plans to start from: `Plans` or actions `[B, H, A]`; and their best candidates `[B, S, H, A]`,
/// unless they bring their own, of which each next plan takes `most`.
pub fn warm_starts(
    plans: Option<&Bound<'_, PyAny>>,
    elites: Option<&Bound<'_, PyAny>>,
    most: usize,
) -> PyResult<Option<LastPlans>> {
    let read = |elites| numbers::<f32, Ix4>("warm_elites", elites, "a float array [B, S, H, A]");
    let given = elites.map(read).transpose()?;
    let Some(plans) = plans else {
        return none_without_plan(given);
    };
    if let Ok(plans) = plans.cast::<PyPlans>() {
        let plans = plans.get();
        return Ok(Some(LastPlans {
            actions: plans.stacked_actions(),
            elites: given.or_else(|| Some(best(plans.stacked_elites(), most))),
        }));
    }
    let actions = numbers::<f32, Ix3>("warm_start", plans, "Plans or a float array [B, H, A]")?;
    Ok(Some(LastPlans { actions, elites: given }))
}

/// At most `most` candidates of each plan: a planner may shift fewer than the last one did.
fn best(mut elites: Array4<f32>, most: usize) -> Array4<f32> {
    elites.slice_axis_inplace(Axis(1), Slice::from(..elites.len_of(Axis(1)).min(most)));
    elites
}

fn none_without_plan(elites: Option<Array4<f32>>) -> PyResult<Option<LastPlans>> {
    match elites {
        None => Ok(None),
        Some(_) => {
            Err(PyValueError::new_err("warm_elites: belong to a warm_start, and there is none"))
        }
    }
}

/// A corner of a box of actions, `[A]`.
pub fn corner(argument: &str, corner: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Vec<f64>>> {
    let read = |corner| numbers::<f64, Ix1>(argument, corner, "a float array [A]");
    Ok(corner.map(read).transpose()?.map(|corner| corner.to_vec()))
}

/// One frame, named in the error if it is more or fewer.
pub fn one_frame<B: Border>(
    border: &B,
    argument: &str,
    object: &Bound<'_, PyAny>,
) -> PyResult<FramesOf<B>> {
    let frames = border.read(argument, object, Axes::OneOrBatch)?;
    match frames.len() {
        1 => Ok(frames),
        count => Err(PyValueError::new_err(format!(
            "{argument}: must be one uint8 image [H, W, 3] or one frame of the model, got {count} \
             frames"
        ))),
    }
}

/// `name=value, ..` of a dictionary.
pub fn keywords(arguments: &Bound<'_, PyDict>) -> PyResult<String> {
    let parts: Vec<String> = arguments
        .iter()
        .map(|(name, value)| Ok(format!("{name}={}", value.repr()?)))
        .collect::<PyResult<_>>()?;
    Ok(parts.join(", "))
}
