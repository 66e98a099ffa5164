//! Frames of the maze for Python.

use hvf_core_rs::maze::ground::Ground;
use hvf_core_rs::maze::{MazeFrames, Renderer, State, States};
use hvf_core_rs::planner::Frames;
use ndarray::{Array2, Array4};
use numpy::{IntoPyArray, PyArray2, PyArray4};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use super::layout::{layout_of, other_than_paper, states_in, write_row};
use crate::arguments::{indices, Given, Whole};
use crate::error::to_py;
use crate::threads::detached;

/// Frames of the maze: states, with the images they were read off where there are any.
///
/// Frames of states have their images drawn where they are needed; `MazeWorld.observe` makes frames
/// of images. `frames[i]` are those at an integer (one frame, still a batch) or at integers `[N]`.
///
/// Args:
///     states: float `[N, 4]`, rows `(x, y, w1, w2)`, metres.
///     image_size: Height and width of the images, pixels, from 8 to 2048.
///     layout: The layout that the states are of, whose rows are `(x, y, gap, ..)`; None for the
///         paper's maze.
///
/// Raises:
///     ValueError: States or sizes that `maze_render` refuses.
///     TypeError: An argument of another kind.
#[pyclass(name = "MazeFrames", module = "hvf_core", frozen)]
pub struct PyMazeFrames {
    /// The frames.
    pub inner: MazeFrames,
}

#[pymethods]
impl PyMazeFrames {
    #[new]
    #[pyo3(
        signature = (states, image_size = Given::of(64), layout = None),
        text_signature = "(states, image_size=64, layout=None)"
    )]
    fn new(
        states: &Bound<'_, PyAny>,
        image_size: Whole,
        layout: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let layout = other_than_paper(layout_of(layout)?);
        let image_size = image_size.count("image_size")?;
        Renderer::shared(image_size)
            .map_err(|error| PyValueError::new_err(format!("image_size: {error}")))?;
        let states = states_in("states", states, layout.as_deref())?;
        Ok(Self { inner: MazeFrames::from_states(states, image_size) })
    }

    fn __len__(&self) -> usize {
        self.inner.len()
    }

    /// The frames at `index`: an integer (one frame, still a batch), or a list or an array of
    /// integers; negative ones count from the end. Raises IndexError beyond the batch.
    fn __getitem__(&self, index: &Bound<'_, PyAny>) -> PyResult<Self> {
        let index = indices(index, self.inner.len())?;
        Ok(Self { inner: self.inner.select(&index).map_err(to_py)? })
    }

    /// States, float64 `[N, 4]`, rows `(x, y, w1, w2)`, or those of a layout (a copy).
    #[getter]
    fn states<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        let rows = match self.inner.states() {
            States::Paper(states) => rows_of(states.iter()),
            States::Laid(states) => rows_of(states.iter()),
        };
        rows.into_pyarray(py)
    }

    /// Images, uint8 `[N, S, S, 3]` (a copy): those that were observed, or else drawn.
    #[getter]
    fn images<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray4<u8>>> {
        let (count, size) = (self.inner.len(), self.inner.image_size());
        let bytes = detached(py, || {
            let renderer = Renderer::new(size)?;
            let mut bytes = Vec::with_capacity(count * renderer.frame_len());
            for i in 0..count {
                bytes.extend_from_slice(&self.inner.image(&renderer, i)?);
            }
            Ok(bytes)
        })?;
        let images = Array4::from_shape_vec((count, size, size, 3), bytes.map_err(to_py)?);
        Ok(images.map_err(|error| PyValueError::new_err(error.to_string()))?.into_pyarray(py))
    }

    /// Height and width of the images, pixels.
    #[getter]
    fn image_size(&self) -> usize {
        self.inner.image_size()
    }

    fn __repr__(&self) -> String {
        format!("MazeFrames({} frames of {} pixels)", self.inner.len(), self.inner.image_size())
    }
}

/// Rows of states of one layout, `[N, columns]`.
pub(super) fn rows_of<'s, S: Ground>(
    states: impl ExactSizeIterator<Item = &'s State<S>>,
) -> Array2<f64> {
    let mut states = states.peekable();
    let columns = 2 + states.peek().map_or(2, |state| state.scene.gaps().len());
    let mut rows = Array2::zeros((states.len(), columns));
    for (mut row, state) in rows.rows_mut().into_iter().zip(states) {
        if let Some(row) = row.as_slice_mut() {
            write_row(state, row);
        }
    }
    rows
}

/// Adds this file's class to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyMazeFrames>()
}
