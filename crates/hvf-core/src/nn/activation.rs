//! Nonlinear functions of lanes: the same bits on every machine, NaN for NaN.

use crate::lanes::Lanes;
use crate::{Error, Result};

/// What follows the first layer of a network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Activation {
    /// Negative values become zero.
    #[default]
    Relu,
    /// The sine: what comes after is a sum of waves.
    Sin,
}

impl Activation {
    /// From its name: `"relu"` or `"sin"`.
    ///
    /// # Errors
    /// Any other name.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "relu" => Ok(Self::Relu),
            "sin" => Ok(Self::Sin),
            other => Err(Error::invalid(
                "activation",
                format!("expected 'relu' or 'sin', got '{other}'"),
            )),
        }
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Relu => "relu",
            Self::Sin => "sin",
        }
    }

    /// Of every number.
    #[inline(always)]
    pub(super) fn apply(self, units: &mut [Lanes]) {
        let each = units.as_flattened_mut().iter_mut();
        match self {
            Self::Relu => each.for_each(|unit| *unit = rectified(*unit)),
            Self::Sin => each.for_each(|unit| *unit = sin(*unit)),
        }
    }
}

/// Negative values to zero.
#[inline(always)]
pub(crate) fn rectified(value: f32) -> f32 {
    // `max` would take NaN for zero.
    if value < 0.0 {
        0.0
    } else {
        value
    }
}

/// Hyperbolic tangent, within 4e-7 of the true value.
///
/// The rational function that Eigen uses (`generic_fast_tanh_float`): a library's `tanh` is not
/// the same everywhere, and is not vectorised.
#[inline(always)]
pub(crate) fn tanh(value: f32) -> f32 {
    const ODD: [f32; 7] = [
        -2.760_768_5e-16,
        2.000_188e-13,
        -8.604_672e-11,
        5.122_297e-8,
        1.485_722_4e-5,
        6.372_619e-4,
        4.893_525e-3,
    ];
    const EVEN: [f32; 4] = [1.198_258_4e-6, 1.185_347e-4, 2.268_434_6e-3, 4.893_525e-3];
    // Beyond this it is one, but for rounding.
    let x = value.clamp(-7.905_311, 7.905_311);
    let square = x * x;
    let mut numerator = ODD[0];
    for term in &ODD[1..] {
        numerator = numerator.mul_add(square, *term);
    }
    let mut denominator = EVEN[0];
    for term in &EVEN[1..] {
        denominator = denominator.mul_add(square, *term);
    }
    x * numerator / denominator
}

/// Sine, within 3e-7 of the true value up to 10,000, from -1 to 1 for every number.
///
/// The nearest multiple of pi is taken off in three parts, and the sine of the rest is the
/// polynomial that SLEEF uses (`sinf_u35`).
#[inline(always)]
pub(crate) fn sin(value: f32) -> f32 {
    const PARTS: [f32; 3] = [3.141_479_5, 1.131_594_2e-4, 1.984_187_3e-9];
    const TERMS: [f32; 4] = [2.608_316e-6, -1.981_069e-4, 8.333_079e-3, -1.666_666e-1];
    // Added to a number of up to 2^22 it leaves the nearest whole number in the lowest bits.
    const WHOLE: f32 = 12_582_912.0;
    let shifted = value.mul_add(std::f32::consts::FRAC_1_PI, WHOLE);
    let turns = shifted - WHOLE;
    let mut x = value;
    for part in PARTS {
        x = turns.mul_add(-part, x);
    }
    let square = x * x;
    let mut sum = TERMS[0];
    for term in &TERMS[1..] {
        sum = sum.mul_add(square, *term);
    }
    let sine = (square * sum).mul_add(x, x).clamp(-1.0, 1.0);
    f32::from_bits(sine.to_bits() ^ (shifted.to_bits() << 31))
}

/// `1 / (1 + exp(-value))`, within 3e-7 of the true value.
#[inline(always)]
pub(crate) fn sigmoid(value: f32) -> f32 {
    tanh(0.5 * value).mul_add(0.5, 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// From -20 to 20 and the numbers nearest to zero.
    fn values() -> impl Iterator<Item = f32> {
        let near = (0..120).map(|exponent| 0.7_f32.powi(exponent));
        (-200_000..=200_000).map(|i| i as f32 * 1e-4).chain(near.clone()).chain(near.map(|x| -x))
    }

    #[test]
    fn tanh_and_sigmoid_are_near_the_true_functions() {
        for x in values() {
            let (exact, found) = (f64::from(x).tanh(), f64::from(tanh(x)));
            assert!((found - exact).abs() <= 4e-7 * exact.abs().max(1e-30), "tanh({x}): {found}");
            assert!(found.abs() <= 1.0);
            let (exact, found) = (1.0 / (1.0 + f64::from(-x).exp()), f64::from(sigmoid(x)));
            assert!((found - exact).abs() <= 3e-7, "sigmoid({x}): {found}");
            assert!((0.0..=1.0).contains(&found));
        }
        assert_eq!(tanh(0.0), 0.0);
        for (x, exact) in [(f32::INFINITY, 1.0), (f32::NEG_INFINITY, -1.0)] {
            assert!((tanh(x) - exact).abs() <= 4e-7);
            assert!((sigmoid(x) - 0.5 * (exact + 1.0)).abs() <= 3e-7);
        }
    }

    #[test]
    fn sine_is_near_the_true_function_and_bounded() {
        for x in values().chain((-100_000..=100_000).map(|i| i as f32 * 0.1)) {
            let (exact, found) = (f64::from(x).sin(), f64::from(sin(x)));
            assert!((found - exact).abs() <= 3e-7, "sin({x}): {found}, not {exact}");
        }
        for x in [1e5, 3e7, 1e20, f32::MAX, -f32::MAX] {
            assert!((-1.0..=1.0).contains(&sin(x)), "sin({x})");
        }
        assert!(sin(f32::INFINITY).is_nan());
    }

    #[test]
    fn activations_have_names() {
        for activation in [Activation::Relu, Activation::Sin] {
            assert_eq!(Activation::from_name(activation.name()).ok(), Some(activation));
        }
        assert!(Activation::from_name("gelu").is_err());
    }

    #[test]
    fn nan_stays_nan() {
        for function in [tanh, sigmoid, sin, rectified] {
            assert!(function(f32::NAN).is_nan());
        }
        assert_eq!([-1.0, 0.0, 2.0].map(rectified), [0.0, 0.0, 2.0]);
    }
}
