//! Layouts of the maze: `MazeLayout`, and states of whichever layout.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::{Arc, Mutex, PoisonError};

use hvf_core_rs::maze::ground::Ground;
use hvf_core_rs::maze::layout::{preset, Gap, Region, Wall, PRESETS};
use hvf_core_rs::maze::{Layout, LayoutScene, LayoutState, State, States};
use ndarray::{Array2, Ix1, Ix2};
use numpy::{IntoPyArray, PyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyList, PyTuple};

use crate::arguments::{instance, numbers, Text};
use crate::error::to_py;

/// Scenes that a layout keeps, each with its backdrop.
const SCENES_KEPT: usize = 512;

/// A layout and its scenes of late.
pub struct Kept {
    /// The layout.
    pub layout: Arc<Layout>,
    scenes: Mutex<HashMap<Vec<u64>, Arc<LayoutScene>>>,
}

impl Kept {
    fn scene(&self, gaps: &[f64]) -> hvf_core_rs::Result<Arc<LayoutScene>> {
        let key: Vec<u64> = gaps.iter().map(|gap| gap.to_bits()).collect();
        let mut scenes = self.scenes.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(scene) = scenes.get(&key) {
            return Ok(Arc::clone(scene));
        }
        let scene = Arc::new(self.layout.scene(gaps)?);
        if scenes.len() == SCENES_KEPT {
            scenes.clear();
        }
        scenes.insert(key, Arc::clone(&scene));
        Ok(scene)
    }
}

/// A maze of any layout: walls as boxes that may be turned and may have gaps.
///
/// A state of a layout is a row `(x, y, gap, ..)` of `2 + G` numbers, metres: where the centres of
/// the agent and of the gaps (along their walls) are. Layouts compare by what they are, and can be
/// copied and pickled.
///
/// Args:
///     name: Its name.
///     walls: Float `[W, 5]`, rows `(x, y, half_x, half_y, angle)`: centre and half extents,
///         metres, turn in degrees, anticlockwise.
///     start: Where episodes start, `(low x, high x, low y, high y)`, metres.
///     goal: Where they aim.
///     arena: Half-widths of the arena, up to 0.3 m, which is what the camera sees; None for 0.3.
///     gaps: Float `[G, 4]`, rows `(wall, half, low, high)` in the order of their walls, at most
///         one a wall: an opening of half-width `half` across the wall's second axis, whose centre
///         every episode draws from `[low, high]`, from the wall's centre. None for none.
///
/// Raises:
///     ValueError: Numbers out of range, a wall outside the arena, a gap that the agent does not
///         fit through, a start or goal that walls fill, a goal that cannot be reached.
///     TypeError: An argument of another kind.
#[pyclass(name = "MazeLayout", module = "hvf_core", frozen)]
pub struct PyMazeLayout {
    /// The layout.
    pub kept: Arc<Kept>,
}

#[pymethods]
impl PyMazeLayout {
    #[new]
    #[pyo3(
        signature = (name, walls, start, goal, arena = None, gaps = None),
        text_signature = "(name, walls, start, goal, arena=(0.3, 0.3), gaps=())"
    )]
    fn new(
        name: Text,
        walls: &Bound<'_, PyAny>,
        start: &Bound<'_, PyAny>,
        goal: &Bound<'_, PyAny>,
        arena: Option<&Bound<'_, PyAny>>,
        gaps: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let name = name.get("name")?;
        let mut made: Vec<Wall> = table::<5>("walls", walls)?
            .into_iter()
            .map(|[x, y, half_x, half_y, angle]| Wall {
                angle,
                ..Wall::new([x, y], [half_x, half_y])
            })
            .collect();
        let gaps = gaps.map_or(Ok(Vec::new()), |gaps| table::<4>("gaps", gaps))?;
        let mut next = 0;
        for [wall, half, low, high] in gaps {
            let index = wall as usize;
            if wall.fract() != 0.0 || wall < next as f64 || index >= made.len() {
                return Err(PyValueError::new_err(format!(
                    "gaps: must name walls in ascending order, each once, from 0 to {}; got {wall}",
                    made.len() as i64 - 1
                )));
            }
            made[index].gap = Some(Gap { half, range: [low, high] });
            next = index + 1;
        }
        let arena = arena.map_or(Ok([0.3; 2]), |arena| row::<2>("arena", arena))?;
        let (start, goal) = (row::<4>("start", start)?, row::<4>("goal", goal)?);
        let region = |[a, b, c, d]: [f64; 4]| Region { x: [a, b], y: [c, d] };
        Layout::new(name.as_ref(), arena, made, region(start), region(goal))
            .map(Self::of)
            .map_err(to_py)
    }

    /// The layout of a name, one of `MAZE_LAYOUTS`.
    ///
    /// Args:
    ///     name: 'easy', 'medium' or 'hard' (the paper's), 'corridor-1' to 'corridor-7' (walls from
    ///         border to border with a gap each), 'u-maze' or 'spiral'.
    ///
    /// Raises:
    ///     ValueError: Another name.
    ///     TypeError: What is no string.
    #[staticmethod]
    fn preset(name: Text) -> PyResult<Self> {
        preset(&name.get("layout")?).map(Self::of).map_err(to_py)
    }

    /// Its name.
    #[getter]
    fn name(&self) -> &str {
        self.kept.layout.name()
    }

    /// Half-widths of the arena, m.
    #[getter]
    fn arena(&self) -> (f64, f64) {
        self.kept.layout.arena().into()
    }

    /// Walls, float64 `[W, 5]` (a copy).
    #[getter]
    fn walls<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        let walls = self.kept.layout.walls();
        let row =
            |wall: &Wall| [wall.centre[0], wall.centre[1], wall.half[0], wall.half[1], wall.angle];
        Array2::from_shape_fn((walls.len(), 5), |(i, k)| row(&walls[i])[k]).into_pyarray(py)
    }

    /// Gaps, float64 `[G, 4]` (a copy).
    #[getter]
    fn gaps<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        let walls = self.kept.layout.walls().iter().enumerate();
        let rows: Vec<[f64; 4]> = walls
            .filter_map(|(i, wall)| wall.gap.map(|gap| (i, gap)))
            .map(|(i, gap)| [i as f64, gap.half, gap.range[0], gap.range[1]])
            .collect();
        Array2::from_shape_fn((rows.len(), 4), |(i, k)| rows[i][k]).into_pyarray(py)
    }

    /// Where episodes start, `(low x, high x, low y, high y)`, m.
    #[getter]
    fn start(&self) -> (f64, f64, f64, f64) {
        let Region { x, y } = self.kept.layout.start();
        (x[0], x[1], y[0], y[1])
    }

    /// Where episodes aim, `(low x, high x, low y, high y)`, m.
    #[getter]
    fn goal(&self) -> (f64, f64, f64, f64) {
        let Region { x, y } = self.kept.layout.goal();
        (x[0], x[1], y[0], y[1])
    }

    /// Numbers of a state's row: 2 and one for each gap.
    #[getter]
    fn columns(&self) -> usize {
        self.kept.layout.columns()
    }

    fn __eq__(&self, other: &Bound<'_, PyAny>) -> bool {
        let other = other.cast::<Self>();
        other.is_ok_and(|other| other.get().kept.layout == self.kept.layout)
    }

    fn __hash__(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        self.kept.layout.name().hash(&mut hasher);
        hasher.finish()
    }

    /// How to make it again: layouts can be copied and pickled.
    fn __reduce__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let class = py.get_type::<Self>();
        if self.kept.layout.difficulty().is_some() {
            let preset = class.getattr(intern!(py, "preset"))?;
            return (preset, (self.name(),)).into_pyobject(py);
        }
        let (walls, gaps) = (self.walls(py), self.gaps(py));
        let parts = (self.name(), walls, self.start(), self.goal(), self.arena(), gaps);
        (class, parts).into_pyobject(py)
    }

    fn __repr__(&self) -> String {
        let layout = &self.kept.layout;
        let gaps = layout.gaps().count();
        format!("MazeLayout('{}', {} walls, {gaps} gaps)", layout.name(), layout.walls().len())
    }
}

impl PyMazeLayout {
    fn of(layout: Arc<Layout>) -> Self {
        Self { kept: Arc::new(Kept { layout, scenes: Mutex::default() }) }
    }
}

/// The layout that a call means; `None` is the paper's maze.
pub fn layout_of(argument: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Arc<Kept>>> {
    let Some(object) = argument.filter(|object| !object.is_none()) else {
        return Ok(None);
    };
    let layout = instance::<PyMazeLayout>("layout", object)?.get();
    Ok(Some(Arc::clone(&layout.kept)))
}

/// A layout whose states are not the paper's.
pub fn other_than_paper(layout: Option<Arc<Kept>>) -> Option<Arc<Kept>> {
    layout.filter(|kept| kept.layout.difficulty().is_none())
}

/// Rows of `C` numbers; none of an empty sequence.
fn table<const C: usize>(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec<[f64; C]>> {
    // NumPy makes one axis of these.
    let no_list = object.cast::<PyList>().is_ok_and(|list| list.is_empty());
    if no_list || object.cast::<PyTuple>().is_ok_and(|tuple| tuple.is_empty()) {
        return Ok(Vec::new());
    }
    crate::maze::rows::<C>(argument, object)
}

fn row<const C: usize>(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<[f64; C]> {
    let expected = format!("{C} numbers");
    let found = numbers::<f64, Ix1>(argument, object, &expected)?;
    let vector = found.to_vec();
    <[f64; C]>::try_from(vector).map_err(|vector| {
        PyValueError::new_err(format!("{argument}: expected {expected}, got {}", vector.len()))
    })
}

/// States `[N, 2 + G]` of a layout, or `[N, 4]` of the paper's maze.
pub fn states_in(
    argument: &str,
    array: &Bound<'_, PyAny>,
    layout: Option<&Kept>,
) -> PyResult<States> {
    let Some(kept) = layout else {
        return crate::maze::states(argument, array).map(States::Paper);
    };
    let columns = kept.layout.columns();
    let expected = format!("a float array [N, {columns}]");
    let found = numbers::<f64, Ix2>(argument, array, &expected)?;
    if found.ncols() != columns {
        return Err(PyValueError::new_err(format!(
            "{argument}: expected {expected}, got shape {:?}",
            found.shape()
        )));
    }
    let mut last: Option<Arc<LayoutScene>> = None;
    let state = |index: usize, row: Vec<f64>| -> PyResult<LayoutState> {
        let refused = |error| PyValueError::new_err(format!("{argument}[{index}]: {error}"));
        let (position, gaps) = row.split_at(2);
        let scene = match last.take().filter(|scene| scene.gaps() == gaps) {
            Some(scene) => scene,
            None => kept.scene(gaps).map_err(refused)?,
        };
        last = Some(Arc::clone(&scene));
        LayoutState::at(&scene, [position[0], position[1]]).map_err(refused)
    };
    let mut state = state;
    let rows = found.rows().into_iter().map(|row| row.to_vec()).enumerate();
    let states: PyResult<Vec<LayoutState>> = rows.map(|(i, row)| state(i, row)).collect();
    states.map(States::Laid)
}

/// Writes the row of a state.
pub fn write_row<S: Ground>(state: &State<S>, row: &mut [f64]) {
    row[..2].copy_from_slice(&state.position);
    row[2..].copy_from_slice(state.scene.gaps());
}

/// Adds the class and the names of layouts to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyMazeLayout>()?;
    module.add("MAZE_LAYOUTS", PyTuple::new(module.py(), PRESETS)?)?;
    Ok(())
}
