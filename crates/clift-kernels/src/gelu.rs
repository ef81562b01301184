//! GELU by the normal distribution function (erf, not the tanh approximation) and its gradient.

use crate::primitives::elementwise::{Elementwise, apply};
use crate::simd::dispatch::InstructionSet;
use crate::simd::vector::Simd;

/// Computes `output = x * Phi(x)` with the normal distribution function `Phi`.
pub fn gelu_forward(set: InstructionSet, x: &[f32], output: &mut [f32]) {
    apply(set, Gelu, x, output);
}

/// Replaces the gradient of the output by the gradient of `x`: `grad *= Phi(x) + x * phi(x)` with the normal density
/// `phi`.
pub fn gelu_backward(set: InstructionSet, x: &[f32], grad: &mut [f32]) {
    apply(set, GeluGrad, x, grad);
}

#[derive(Clone, Copy)]
struct Gelu;

impl Elementwise for Gelu {
    #[inline(always)]
    fn apply<S: Simd>(self, simd: S, x: S::V, _output: S::V) -> S::V {
        simd.mul(x, distribution(simd, x).0)
    }
}

#[derive(Clone, Copy)]
struct GeluGrad;

impl Elementwise for GeluGrad {
    #[inline(always)]
    fn apply<S: Simd>(self, simd: S, x: S::V, grad: S::V) -> S::V {
        let (distribution, bell) = distribution(simd, x);
        let density = simd.mul(bell, simd.splat(0.398_942_3)); // 1 / sqrt(2 pi)
        // The density stays above zero for large |x|: bound the factor.
        let bounded = simd.max(simd.splat(-40.0), simd.min(simd.splat(40.0), x));
        simd.mul(grad, simd.mul_add(bounded, density, distribution))
    }
}

/// Returns the normal distribution function of `x`, and `exp(-x^2 / 2)`.
///
/// Abramowitz and Stegun, 7.1.26: absolute error at most 8e-8, and a small relative error for large negative `x`.
#[inline(always)]
fn distribution<S: Simd>(simd: S, x: S::V) -> (S::V, S::V) {
    // Coefficients of 7.1.26 for erfc(|x| / sqrt(2)) / 2.
    const SLOPE: f32 = 0.327_591_1 * std::f32::consts::FRAC_1_SQRT_2;
    const COEFFICIENTS: [f32; 5] =
        [1.061_405_4 / 2.0, -1.453_152 / 2.0, 1.421_413_8 / 2.0, -0.284_496_74 / 2.0, 0.254_829_6 / 2.0];
    let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
    let size = simd.max(x, simd.sub(zero, x));
    let bell = simd.exp2(simd.mul(simd.mul(x, x), simd.splat(-0.5 * std::f32::consts::LOG2_E)));
    let t = simd.div(one, simd.mul_add(size, simd.splat(SLOPE), one));
    let mut tail = simd.splat(COEFFICIENTS[0]);
    for coefficient in &COEFFICIENTS[1..] {
        tail = simd.mul_add(tail, t, simd.splat(*coefficient));
    }
    let tail = simd.mul(simd.mul(tail, t), bell); // 1 - Phi(|x|), at most 1/2
    (simd.select_negative(x, tail, simd.sub(one, tail)), bell)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::assert_close;

    #[test]
    fn every_instruction_set_equals_f64_from_minus_30_to_30() {
        let x: Vec<f32> = (-3000..=3003).map(|i| i as f32 / 100.0).collect();
        let bell = |x: f64| (-0.5 * x * x).exp();
        // The series of the distribution function around zero, and its continued fraction outside.
        let phi = |x: f64| {
            let size = x.abs();
            let tail = if size < 4.0 {
                let mut term = size;
                let mut sum = size;
                for n in 1..200 {
                    term *= size * size / f64::from(2 * n + 1);
                    sum += term;
                }
                0.5 - sum * bell(size) / (2.0 * std::f64::consts::PI).sqrt()
            } else {
                let fraction = (1..=60).rev().fold(0.0, |rest, n| f64::from(n) / (size + rest));
                bell(size) / (2.0 * std::f64::consts::PI).sqrt() / (size + fraction)
            };
            if x < 0.0 { tail } else { 1.0 - tail }
        };
        let values: Vec<f64> = x.iter().map(|&x| f64::from(x) * phi(x.into())).collect();
        let slope = |x: f64| phi(x) + x * bell(x) / (2.0 * std::f64::consts::PI).sqrt();
        let slopes: Vec<f64> = x.iter().map(|&x| 3.0 * slope(x.into())).collect();
        for set in InstructionSet::available() {
            let mut output = vec![f32::NAN; x.len()];
            gelu_forward(set, &x, &mut output);
            // Values near zero are compared on their own scale.
            let near = |values: &[f64]| values[2500..3500].to_vec();
            assert_close(&output[2500..3500], &near(&values), 1e-6);
            assert_close(&output, &values, 1e-6);
            let mut grad = vec![3.0; x.len()];
            gelu_backward(set, &x, &mut grad);
            assert_close(&grad, &slopes, 1e-6);
        }
    }

    #[test]
    fn nan_and_infinity_propagate() {
        for set in InstructionSet::available() {
            let mut output = [0.0; 3];
            gelu_forward(set, &[f32::NAN, f32::INFINITY, -1e30], &mut output);
            assert!(output[0].is_nan());
            assert_eq!(output[1..], [f32::INFINITY, 0.0]);
            let mut grad = [1.0; 4];
            gelu_backward(set, &[f32::NAN, f32::INFINITY, -1e30, 3e38], &mut grad);
            assert!(grad[0].is_nan());
            for (got, expected) in grad[1..].iter().zip([1.0, 0.0, 1.0]) {
                assert!((got - expected).abs() < 1e-30, "{got} against {expected}");
            }
        }
    }
}
