//! What the planners return.

use hvf_core_rs::planner::{IterationStats, Plan, SearchStats};
use ndarray::{
    stack, Array, Array1, Array2, Array3, Array4, ArrayView, Axis, Dimension, RemoveAxis,
};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyArray4};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyIterator, PyList};

use crate::arguments::one_index;

/// One figure of an iteration, by name.
type Figure = (&'static str, fn(&IterationStats) -> f32);

/// The figures of an iteration, in the order of their columns.
const FIGURES: [Figure; 5] = [
    ("best", |stats| stats.best),
    ("elite_mean", |stats| stats.elite_mean),
    ("elite_worst", |stats| stats.elite_worst),
    ("population_mean", |stats| stats.population_mean),
    ("max_std", |stats| stats.max_std),
];

/// The best actions found for one problem.
#[pyclass(name = "Plan", module = "hvf_core", frozen)]
pub struct PyPlan {
    /// The plan.
    pub inner: Plan,
}

#[pymethods]
impl PyPlan {
    /// Actions, float32 `[H, A]`.
    #[getter]
    fn actions<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f32>> {
        self.inner.actions.clone().into_pyarray(py)
    }

    /// Predicted cost of these actions: the lowest of the iterations that `best` says.
    #[getter]
    fn cost(&self) -> f32 {
        self.inner.cost
    }

    /// Best candidates of the last iteration, best first, float32 `[S, H, A]`.
    ///
    /// `S` is the planner's `shift_elites`. A next plan with this `warm_start` begins with them.
    #[getter]
    fn elites<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray3<f32>> {
        self.inner.elites.clone().into_pyarray(py)
    }

    /// Iterations that were run, `I`.
    #[getter]
    fn iterations(&self) -> usize {
        self.inner.history.len()
    }

    /// Costs of every iteration by name, float32 `[I]` each.
    ///
    /// `best`, `elite_mean` and `elite_worst` of the elites, `population_mean` of all finite costs,
    /// and `max_std`, the largest deviation of the refitted Gaussian.
    #[getter]
    fn history<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let columns = PyDict::new(py);
        for (name, figure) in FIGURES {
            let column: Vec<f32> = self.inner.history.iter().map(figure).collect();
            columns.set_item(name, column.into_pyarray(py))?;
        }
        Ok(columns)
    }

    fn __repr__(&self) -> String {
        let (horizon, dim) = self.inner.actions.dim();
        format!(
            "Plan(cost={}, actions=float32[{horizon}, {dim}], iterations={})",
            self.inner.cost,
            self.inner.history.len()
        )
    }
}

/// The best actions found for every problem of a batch; `plans[b]` is a `Plan`.
#[pyclass(name = "Plans", module = "hvf_core", frozen)]
pub struct PyPlans {
    /// The plans; none of a search by likelihood that was interrupted.
    pub inner: Vec<Plan>,
}

/// Arrays of one shape as one, `[B, ..]`; of none, one without any values.
fn stacked<'a, D: Dimension>(
    arrays: impl Iterator<Item = ArrayView<'a, f32, D>>,
) -> Array<f32, D::Larger>
where
    D::Larger: RemoveAxis,
{
    let views: Vec<_> = arrays.collect();
    if views.is_empty() {
        return Array::default(D::Larger::zeros(D::NDIM.unwrap_or(0) + 1));
    }
    stack(Axis(0), &views).expect("plans of one batch have one shape")
}

impl PyPlans {
    /// Actions of all plans, `[B, H, A]`.
    pub fn stacked_actions(&self) -> Array3<f32> {
        stacked(self.inner.iter().map(|plan| plan.actions.view()))
    }

    /// Best candidates of all plans, `[B, S, H, A]`.
    pub fn stacked_elites(&self) -> Array4<f32> {
        stacked(self.inner.iter().map(|plan| plan.elites.view()))
    }
}

#[pymethods]
impl PyPlans {
    /// Actions, float32 `[B, H, A]`.
    #[getter]
    fn actions<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray3<f32>> {
        self.stacked_actions().into_pyarray(py)
    }

    /// As `Plan.elites`, float32 `[B, S, H, A]`.
    #[getter]
    fn elites<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray4<f32>> {
        self.stacked_elites().into_pyarray(py)
    }

    /// Predicted costs, float32 `[B]`.
    #[getter]
    fn costs<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        let costs: Array1<f32> = self.inner.iter().map(|plan| plan.cost).collect();
        costs.into_pyarray(py)
    }

    /// Iterations that each problem ran, int64 `[B]`.
    #[getter]
    fn iterations<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<i64>> {
        let runs: Array1<i64> = self.inner.iter().map(|plan| plan.history.len() as i64).collect();
        runs.into_pyarray(py)
    }

    /// As `Plan.history`, float32 `[B, I]` each; NaN after a problem was done.
    #[getter]
    fn history<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let longest = self.inner.iter().map(|plan| plan.history.len()).max().unwrap_or(0);
        let columns = PyDict::new(py);
        for (name, figure) in FIGURES {
            let table = Array2::from_shape_fn((self.inner.len(), longest), |(plan, iteration)| {
                self.inner[plan].history.get(iteration).map_or(f32::NAN, figure)
            });
            columns.set_item(name, table.into_pyarray(py))?;
        }
        Ok(columns)
    }

    fn __len__(&self) -> usize {
        self.inner.len()
    }

    fn __getitem__(&self, index: &Bound<'_, PyAny>) -> PyResult<PyPlan> {
        let place = one_index(index, self.inner.len())?;
        Ok(PyPlan { inner: self.inner[place].clone() })
    }

    fn __iter__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyIterator>> {
        let plans = self.inner.iter().map(|plan| PyPlan { inner: plan.clone() });
        PyList::new(py, plans.collect::<Vec<_>>())?.try_iter()
    }

    fn __repr__(&self) -> String {
        let (horizon, dim) = self.inner.first().map_or((0, 0), |plan| plan.actions.dim());
        let count = self.inner.len();
        format!("Plans({count} plans, actions=float32[{count}, {horizon}, {dim}])")
    }
}

/// What the subgoal search found.
#[pyclass(name = "SearchResult", module = "hvf_core", frozen)]
pub struct PySearchResult {
    /// Subgoals in the order to reach them: frames of the model, `[K]`.
    #[pyo3(get)]
    pub subgoals: Py<PyAny>,
    /// Cost of the segments together: what `reduction` makes of `segment_costs`.
    #[pyo3(get)]
    pub cost: f32,
    /// Best plan of every segment, `K + 1`.
    #[pyo3(get)]
    pub plans: Py<PyPlans>,
    /// Latents of the subgoals, `[K, L]`.
    pub latents: Array2<f32>,
    /// Figures of every iteration.
    pub history: Vec<SearchStats>,
}

#[pymethods]
impl PySearchResult {
    /// Latents of the subgoals, float32 `[K, L]`.
    #[getter]
    fn latents<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f32>> {
        self.latents.clone().into_pyarray(py)
    }

    /// Planning cost of every segment, float32 `[K + 1]`.
    #[getter]
    fn segment_costs<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        self.plans.get().costs(py)
    }

    /// Iterations that were run, `I`; 0 without subgoals.
    #[getter]
    fn iterations(&self) -> usize {
        self.history.len()
    }

    /// Figures of every iteration by name, `[I]` each.
    ///
    /// Those of `Plan.history` over the samples (`population_mean`: the completed ones), and the
    /// planning problems `evaluated` (to their end, or until it was clear that they are not their
    /// sample's hardest) and `skipped`, int64.
    #[getter]
    fn history<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let columns = PyDict::new(py);
        for (name, figure) in FIGURES {
            let column: Vec<f32> = self.history.iter().map(|stats| figure(&stats.costs)).collect();
            columns.set_item(name, column.into_pyarray(py))?;
        }
        let counted = |count: fn(&SearchStats) -> usize| -> Bound<'py, PyArray1<i64>> {
            let column: Vec<i64> = self.history.iter().map(|stats| count(stats) as i64).collect();
            column.into_pyarray(py)
        };
        columns.set_item("evaluated", counted(|stats| stats.evaluated))?;
        columns.set_item("skipped", counted(|stats| stats.skipped))?;
        Ok(columns)
    }

    fn __repr__(&self) -> String {
        let costs: Vec<f32> = self.plans.get().inner.iter().map(|plan| plan.cost).collect();
        format!(
            "SearchResult(cost={}, segment_costs={costs:?}, iterations={})",
            self.cost,
            self.history.len()
        )
    }
}
