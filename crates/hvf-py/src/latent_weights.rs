//! Weights of a latent world's networks, as Python gives them: dictionaries of NumPy arrays.

use hvf_core_rs::latent::{Dynamics, LatentCost, Readout};
use hvf_core_rs::nn::{Activation, GruWeights, Linear, ResidualWeights};
use hvf_core_rs::Error;
use ndarray::aview1;
use numpy::{PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyMapping};

use crate::arguments::{array, describe};
use crate::error::to_py;

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
    let parts = items(place, what, object)?;
    let count = parts.len();
    parts.try_into().map_err(|_| {
        PyValueError::new_err(format!("{place}: expected {what}, 2 things, got {count}"))
    })
}

/// The things in a tuple or list.
fn items<'py>(
    place: &str,
    what: &str,
    object: &Bound<'py, PyAny>,
) -> PyResult<Vec<Bound<'py, PyAny>>> {
    object.extract().map_err(|_| {
        let found = describe(object);
        PyTypeError::new_err(format!("{place}: expected {what}, a tuple or list, got {found}"))
    })
}

/// The entries of a dictionary, by names that it must or may have.
struct Entries<'a, 'py> {
    argument: &'a str,
    found: Bound<'py, PyDict>,
}

impl<'a, 'py> Entries<'a, 'py> {
    fn read(argument: &'a str, what: &str, object: &Bound<'py, PyAny>) -> PyResult<Self> {
        let complaint = || {
            let found = describe(object);
            PyTypeError::new_err(format!("{argument}: expected {what}, a dict, got {found}"))
        };
        let found = match object.cast::<PyDict>() {
            Ok(found) => found.copy()?,
            // State dictionaries of torch are ordered ones.
            Err(_) => {
                let mapping = object.cast::<PyMapping>().map_err(|_| complaint())?;
                let found = PyDict::new(object.py());
                found.update(mapping).map_err(|_| complaint())?;
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
            Some(blocks) => items(&entries.place("blocks"), "blocks of two layers", &blocks)?
                .iter()
                .enumerate()
                .map(|(number, block)| {
                    let place = format!("{}[{number}]", entries.place("blocks"));
                    let layers = pair(&place, "two layers", block)?;
                    let [first, second] = layers.each_ref();
                    Ok([
                        Layer::read(&format!("{place}[0]"), first)?,
                        Layer::read(&format!("{place}[1]"), second)?,
                    ])
                })
                .collect::<PyResult<_>>()?,
        };
        let activation = match entries.take("activation")? {
            None => Activation::default(),
            Some(name) => {
                let place = entries.place("activation");
                let name: String = name.extract().map_err(|_| {
                    let found = describe(&name);
                    PyTypeError::new_err(format!("{place}: expected a name, got {found}"))
                })?;
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
        let scale = match entries.take("scale")? {
            None => None,
            Some(scale) => Some(match scale.extract::<f32>() {
                Ok(scale) => vec![scale],
                Err(_) => {
                    let expected = "float32 [Z], or a number";
                    let scale: PyReadonlyArray1<'_, f32> =
                        array(&entries.place("scale"), &scale, expected)?;
                    scale.as_array().to_vec()
                }
            }),
        };
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
