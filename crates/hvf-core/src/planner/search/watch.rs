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
    /// Cost of what the search would answer now.
    pub cost: f32,
}

/// Who looks at a search while it works, and may end it.
pub struct Watch<'a, F> {
    /// Asked between two calls of a model.
    pub interrupt: Interrupt<'a>,
    /// Told after every iteration; its error ends the search.
    pub progress: &'a dyn Fn(Progress) -> Result<()>,
    /// Given, where an error ends the search after its first iteration, what it would have answered
    /// after the last iteration that was finished; by likelihood, without plans.
    pub partial: &'a dyn Fn(SearchResult<F>),
}

impl<F> Watch<'_, F> {
    /// Nobody: the search goes on to its end.
    pub fn nobody() -> Self {
        Self { interrupt: &|| Ok(()), progress: &|_| Ok(()), partial: &|_| () }
    }

    /// Tells how the optimisation stands, of so many iterations.
    pub(super) fn iterated(&self, solution: &Solution, iterations: usize) -> Result<()> {
        let iteration = solution.history.len();
        (self.progress)(Progress { iteration, iterations, cost: solution.cost })
    }
}

impl<F> Clone for Watch<'_, F> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<F> Copy for Watch<'_, F> {}
