//! What planners are called with beside models and frames: seeds, earlier plans, names.

use hvf_core_rs::planner::BestOf;
use ndarray::{Array3, Axis, Ix1, Ix2, Ix3};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;

use super::results::{PyPlan, PyPlans};
pub use crate::arguments::Whole;
use crate::arguments::{items, numbers, Given, Text};

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

/// A plan to start from: a `Plan` or actions `[H, A]`, as `[1, H, A]`.
pub fn one_warm_start(plan: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Array3<f32>>> {
    let Some(plan) = plan else {
        return Ok(None);
    };
    if let Ok(plan) = plan.cast::<PyPlan>() {
        return Ok(Some(plan.get().inner.actions.clone().insert_axis(Axis(0))));
    }
    let actions = numbers::<f32, Ix2>("warm_start", plan, "a Plan or a float array [H, A]")?;
    Ok(Some(actions.insert_axis(Axis(0))))
}

/// Plans to start from: `Plans` or actions `[B, H, A]`.
pub fn warm_starts(plans: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Array3<f32>>> {
    let Some(plans) = plans else {
        return Ok(None);
    };
    if let Ok(plans) = plans.cast::<PyPlans>() {
        return Ok(Some(plans.get().stacked_actions()));
    }
    numbers::<f32, Ix3>("warm_start", plans, "Plans or a float array [B, H, A]").map(Some)
}

/// A corner of a box of actions, `[A]`.
pub fn corner(argument: &str, corner: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Vec<f64>>> {
    let read = |corner| numbers::<f64, Ix1>(argument, corner, "a float array [A]");
    Ok(corner.map(read).transpose()?.map(|corner| corner.to_vec()))
}

/// Which iterations an answer may come from, by name.
pub fn best_of(name: Text) -> PyResult<BestOf> {
    match &*name.get("best")? {
        "all" => Ok(BestOf::All),
        "last" => Ok(BestOf::Last),
        other => {
            Err(PyValueError::new_err(format!("best: must be 'all' or 'last', got '{other}'")))
        }
    }
}

/// The name of [`best_of`].
pub fn best_name(best: BestOf) -> &'static str {
    match best {
        BestOf::All => "all",
        BestOf::Last => "last",
    }
}
