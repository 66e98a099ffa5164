//! Weights of a latent world's networks, as Python gives them: dictionaries of NumPy arrays.

use hvf_core_rs::latent::{Dynamics, LatentCost, Readout};
use hvf_core_rs::nn::{Activation, GruWeights, Linear, ResidualWeights};
use hvf_core_rs::Error;
use ndarray::aview1;
use numpy::{PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::{PyKeyError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyMapping};

use crate::arguments::{array, items, wrong_type, Real, Text};
use crate::error::to_py;

/// Most entries of a dictionary.
const MOST_ENTRIES: usize = 1 << 6;
/// Most blocks of a network.
const MOST_BLOCKS: usize = 1 << 10;

/// Weights and bias of a layer.
struct Layer<'py>(PyReadonlyArray2<'py, f32>, PyReadonlyArray1<'py, f32>);

impl<'py> Layer<'py> {
    fn read(place: &str, object: &Bound<'py, PyAny>) -> PyResult<Self> {
        let [weights, bias] = pair(place, "weights and bias of a layer", object)?;
        Ok(Self(
            array(&format!("{place}[0]"), &weights, "float32 [outputs, inputs]")?,
            array(&format!("{place}[1]"), &bias, "float32 [outputs]")?,
        ))
    }

    fn view(&self) -> Linear<'_> {
        (self.0.as_array(), self.1.as_array())
    }
}

/// The two things in a sequence.
fn pair<'py>(
    place: &str,
    what: &str,
    object: &Bound<'py, PyAny>,
) -> PyResult<[Bound<'py, PyAny>; 2]> {
    let parts = several(place, what, object, 2)?;
    let count = parts.len();
    parts.try_into().map_err(|_| {
        let found = if count > 2 { "more".into() } else { count.to_string() };
        PyValueError::new_err(format!("{place}: expected {what}, 2 things, got {found}"))
    })
}

/// The things in a tuple or list, at most one more than `most`.
fn several<'py>(
    place: &str,
    what: &str,
    object: &Bound<'py, PyAny>,
    most: usize,
) -> PyResult<Vec<Bound<'py, PyAny>>> {
    items(place, object, &format!("{what}, a tuple or list"), most)
}

/// The entries of a dictionary, by names that it must or may have.
struct Entries<'a, 'py> {
    argument: &'a str,
    found: Bound<'py, PyDict>,
}

impl<'a, 'py> Entries<'a, 'py> {
    fn read(argument: &'a str, what: &str, object: &Bound<'py, PyAny>) -> PyResult<Self> {
        let expected = format!("{what}, a dict");
        let found = match object.cast::<PyDict>() {
            Ok(found) => found.copy()?,
            // State dictionaries of torch are ordered ones.
            Err(_) => {
                let mapping = object.cast::<PyMapping>();
                let mapping = mapping.map_err(|_| wrong_type(argument, &expected, object))?;
                let names = items(argument, object, &expected, MOST_ENTRIES)?;
                if names.len() > MOST_ENTRIES {
                    return Err(PyValueError::new_err(format!(
                        "{argument}: must have at most {MOST_ENTRIES} entries, got more"
                    )));
                }
                let found = PyDict::new(object.py());
                for name in names {
                    let entry = mapping.get_item(&name);
                    entry.and_then(|entry| found.set_item(&name, entry)).map_err(|exception| {
                        // It has not what it says it has, or under no name.
                        let py = object.py();
                        let lacking = exception.is_instance_of::<PyKeyError>(py);
                        match lacking || exception.is_instance_of::<PyTypeError>(py) {
                            true => wrong_type(argument, &expected, object),
                            false => exception,
                        }
                    })?;
                }
                found
            }
        };
        Ok(Self { argument, found })
    }

    fn has(&self, name: &str) -> PyResult<bool> {
        self.found.contains(name)
    }

    /// Takes an entry out.
    fn take(&self, name: &str) -> PyResult<Option<Bound<'py, PyAny>>> {
        let entry = self.found.get_item(name)?;
        if entry.is_some() {
            self.found.del_item(name)?;
        }
        Ok(entry)
    }

    /// Takes an entry out that must be there.
    fn must(&self, name: &str) -> PyResult<Bound<'py, PyAny>> {
        self.take(name)?.ok_or_else(|| {
            PyValueError::new_err(format!("{}: must have an entry '{name}'", self.argument))
        })
    }

    /// Complains about what nobody took.
    fn finish(self) -> PyResult<()> {
        match self.found.keys().iter().next() {
            None => Ok(()),
            Some(name) => Err(PyValueError::new_err(format!(
                "{}: has no entry {}",
                self.argument,
                name.repr()?
            ))),
        }
    }

    fn place(&self, name: &str) -> String {
        format!("{}['{name}']", self.argument)
    }
}

/// Weights of a residual network.
struct Network<'py> {
    input: Layer<'py>,
    activation: Activation,
    blocks: Vec<[Layer<'py>; 2]>,
    output: Layer<'py>,
}

impl<'py> Network<'py> {
    fn read(entries: &Entries<'_, 'py>) -> PyResult<Self> {
        let layer = |name| Layer::read(&entries.place(name), &entries.must(name)?);
        let blocks = match entries.take("blocks")? {
            None => Vec::new(),
            Some(blocks) => read_blocks(&entries.place("blocks"), &blocks)?,
        };
        let activation = match entries.take("activation")? {
            None => Activation::default(),
            Some(name) => {
                let place = entries.place("activation");
                let name = name.extract::<Text>()?.get(&place)?;
                Activation::from_name(&name).map_err(|error| within(entries.argument, error))?
            }
        };
        Ok(Self { input: layer("input")?, activation, blocks, output: layer("output")? })
    }

    fn view(&self) -> ResidualWeights<'_> {
        ResidualWeights {
            input: self.input.view(),
            activation: self.activation,
            blocks: self.blocks.iter().map(|block| block.each_ref().map(Layer::view)).collect(),
            output: self.output.view(),
        }
    }
}

/// Blocks of two layers each.
fn read_blocks<'py>(place: &str, object: &Bound<'py, PyAny>) -> PyResult<Vec<[Layer<'py>; 2]>> {
    let blocks = several(place, "blocks of two layers", object, MOST_BLOCKS)?;
    if blocks.len() > MOST_BLOCKS {
        let problem = format!("{place}: must be at most {MOST_BLOCKS} blocks, got more");
        return Err(PyValueError::new_err(problem));
    }
    let read = |(number, block): (usize, &Bound<'py, PyAny>)| {
        let place = format!("{place}[{number}]");
        let [first, second] = pair(&place, "two layers", block)?;
        Ok([
            Layer::read(&format!("{place}[0]"), &first)?,
            Layer::read(&format!("{place}[1]"), &second)?,
        ])
    };
    blocks.iter().enumerate().map(read).collect()
}

/// A scale of all numbers or of each, `[Z]`.
fn read_scale(place: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec<f32>> {
    match object.extract::<Real>()?.single(place) {
        Ok(scale) => return Ok(vec![scale]),
        Err(other) if !other.is_instance_of::<PyTypeError>(object.py()) => return Err(other),
        Err(_) => {}
    }
    let scale: PyReadonlyArray1<'_, f32> = array(place, object, "float32 [Z], or a number")?;
    Ok(scale.as_array().to_vec())
}

/// An error about a part of `argument`.
fn within(argument: &str, error: Error) -> PyErr {
    match error {
        Error::Invalid { argument: part, problem } if part != argument => {
            PyValueError::new_err(format!("{argument}['{part}']: {problem}"))
        }
        other => to_py(other),
    }
}

/// Dynamics from a network's dict, or from the weights of a `torch.nn.GRUCell` by their names.
pub fn dynamics(object: &Bound<'_, PyAny>) -> PyResult<Dynamics> {
    let what = "weights of a network";
    let entries = Entries::read("dynamics", what, object)?;
    let made = if entries.has("weight_hh")? {
        let matrix =
            |name: &str| array(&entries.place(name), &entries.must(name)?, "float32 [3 Z, inputs]");
        let bias = |name: &str| array(&entries.place(name), &entries.must(name)?, "float32 [3 Z]");
        let (weight_ih, weight_hh): (PyReadonlyArray2<'_, f32>, PyReadonlyArray2<'_, f32>) =
            (matrix("weight_ih")?, matrix("weight_hh")?);
        let (bias_ih, bias_hh): (PyReadonlyArray1<'_, f32>, PyReadonlyArray1<'_, f32>) =
            (bias("bias_ih")?, bias("bias_hh")?);
        Dynamics::gru(&GruWeights {
            weight_ih: weight_ih.as_array(),
            weight_hh: weight_hh.as_array(),
            bias_ih: bias_ih.as_array(),
            bias_hh: bias_hh.as_array(),
        })
    } else {
        let network = Network::read(&entries)?;
        let scale = entries.take("scale")?;
        let scale = scale.map(|scale| read_scale(&entries.place("scale"), &scale)).transpose()?;
        Dynamics::mlp(&network.view(), aview1(scale.as_deref().unwrap_or(&[1.0])))
    };
    entries.finish()?;
    made.map_err(|error| within("dynamics", error))
}

/// The cost of a read-out: none, a matrix, or a network's dict.
pub fn cost(
    latent_dim: usize,
    readout: Option<&Bound<'_, PyAny>>,
    weights: Option<&Bound<'_, PyAny>>,
) -> PyResult<LatentCost> {
    let weights: Option<PyReadonlyArray1<'_, f32>> =
        weights.map(|weights| array("weights", weights, "float32 [P]")).transpose()?;
    let weights = weights.as_ref().map(|weights| weights.as_array());
    let made = |readout: &Readout<'_>| LatentCost::new(latent_dim, readout, weights).map_err(to_py);
    let Some(object) = readout else {
        return made(&Readout::Latent);
    };
    if object.cast::<PyMapping>().is_ok() {
        let entries = Entries::read("readout", "weights of a network", object)?;
        let network = Network::read(&entries)?;
        entries.finish()?;
        return made(&Readout::Network(network.view()));
    }
    let expected = "float32 [P, Z], or a dict of a network's weights";
    let matrix: PyReadonlyArray2<'_, f32> = array("readout", object, expected)?;
    let view = matrix.as_array();
    made(&Readout::Matrix(view))
}
