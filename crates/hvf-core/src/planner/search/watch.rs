//! Looking at a search while it works.

use super::SearchResult;
use crate::planner::mpc::Interrupt;
use crate::Result;

/// How a search stands after an iteration.
#[derive(Clone, Debug)]
pub struct Progress<F> {
    /// Most iterations; as many as [`SearchResult::history`] is long are done.
    pub iterations: usize,
    /// What the search would answer if it ended now. A search by likelihood has made no plans yet.
    pub best: SearchResult<F>,
}

/// Who looks at a search while it works, and may end it.
pub struct Watch<'a, F> {
    /// Asked between two calls of a model.
    pub interrupt: Interrupt<'a>,
    /// Told after every iteration; its error ends the search.
    pub progress: &'a dyn Fn(Progress<F>) -> Result<()>,
}

impl<F> Watch<'_, F> {
    /// Nobody: the search goes on to its end.
    pub fn nobody() -> Self {
        Self { interrupt: &|| Ok(()), progress: &|_| Ok(()) }
    }
}

impl<F> Clone for Watch<'_, F> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<F> Copy for Watch<'_, F> {}
