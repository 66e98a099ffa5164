//! Looking at a search while it works.

use super::SearchResult;
use crate::planner::cem::Solution;
use crate::planner::mpc::Interrupt;
use crate::Result;

/// How a search stands after an iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Progress {
    /// Iterations that are done.
    pub iteration: usize,
    /// Most iterations.
    pub iterations: usize,
    /// Cost of what the search would answer now; of several searches, the mean of those that still
    /// go on.
    pub cost: f32,
}

/// Who looks at a search while it works, and may end it.
pub struct Watch<'a, F> {
    /// Asked between two calls of a model.
    pub interrupt: Interrupt<'a>,
    /// Told after every iteration; its error ends the search.
    pub progress: &'a dyn Fn(Progress) -> Result<()>,
    /// Given, where an error ends the search after its first iteration, what it would have answered
    /// after the last iteration that was finished; by likelihood, without plans. Of several
    /// searches, one by one, if all of them have got so far.
    pub partial: &'a dyn Fn(SearchResult<F>),
}

impl<F> Watch<'_, F> {
    /// Nobody: the search goes on to its end.
    pub fn nobody() -> Self {
        Self { interrupt: &|| Ok(()), progress: &|_| Ok(()), partial: &|_| () }
    }

    /// Tells how the optimisation of the searches that go on stands, of so many iterations.
    pub(super) fn iterated(&self, solutions: &[&Solution], iterations: usize) -> Result<()> {
        let iteration = solutions[0].history.len();
        let sum: f64 = solutions.iter().map(|solution| f64::from(solution.cost)).sum();
        let cost = (sum / solutions.len() as f64) as f32;
        (self.progress)(Progress { iteration, iterations, cost })
    }
}

impl<F> Clone for Watch<'_, F> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<F> Copy for Watch<'_, F> {}
