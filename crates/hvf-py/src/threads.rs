//! Work without the GIL, on rayon's threads.

use std::process;
use std::sync::atomic::{AtomicU32, Ordering};

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;

/// The process whose threads do the work; 0 before there was any.
static OWNER: AtomicU32 = AtomicU32::new(0);

/// Runs `work` without the GIL. Everything that uses more than one thread goes through here.
///
/// A forked child has none of its parent's threads, and would wait for them for ever.
///
/// # Errors
/// RuntimeError in a child that was forked after its parent had worked.
pub fn detached<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> PyResult<T> {
    let me = process::id();
    match OWNER.compare_exchange(0, me, Ordering::Relaxed, Ordering::Relaxed) {
        Err(owner) if owner != me => Err(PyRuntimeError::new_err(
            "hvf_core was used before this process was forked, and its threads are not here; \
             start processes by 'spawn' or 'forkserver' (multiprocessing.get_context)",
        )),
        _ => Ok(py.detach(work)),
    }
}
