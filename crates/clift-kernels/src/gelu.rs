//! GELU by the normal distribution function (erf, not the tanh approximation) and its gradient.

use rayon::prelude::*;

use crate::primitives::partition::PIECE;
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::{F32, Operands, Simd};

/// Computes `output = x * Phi(x)` with the normal distribution function `Phi`.
pub fn gelu_forward(set: InstructionSet, x: &[f32], output: &mut [f32]) {
    apply::<false>(set, x, output);
}

/// Replaces the gradient of the output by the gradient of `x`: `grad *= Phi(x) + x * phi(x)` with the normal density
/// `phi`.
pub fn gelu_backward(set: InstructionSet, x: &[f32], grad: &mut [f32]) {
    apply::<true>(set, x, grad);
}

fn apply<const GRADIENT: bool>(set: InstructionSet, x: &[f32], to: &mut [f32]) {
    assert_eq!(x.len(), to.len(), "slices of equal length");
    let pieces = x.par_chunks(PIECE).zip(to.par_chunks_mut(PIECE));
    pieces.for_each(|(x, to)| set.run(Gelu::<GRADIENT> { x, to }));
}

struct Gelu<'a, const GRADIENT: bool> {
    x: &'a [f32],
    to: &'a mut [f32],
}

impl<const GRADIENT: bool> Kernel for Gelu<'_, GRADIENT> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        for (x, to) in self.x.chunks(S::LANES).zip(self.to.chunks_mut(S::LANES)) {
            let x = simd.read(x);
            let (distribution, bell) = distribution(simd, x);
            let value = if GRADIENT {
                let density = simd.mul(bell, simd.splat(0.398_942_3)); // 1 / sqrt(2 pi)
                // The density stays above zero for large |x|: bound the factor.
                let bounded = simd.max(simd.splat(-40.0), simd.min(simd.splat(40.0), x));
                simd.mul(simd.read(to), simd.mul_add(bounded, density, distribution))
            } else {
                simd.mul(x, distribution)
            };
            simd.write(to, value);
        }
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
    let bell = F32::exp2(simd, simd.mul(simd.mul(x, x), simd.splat(-0.5 * std::f32::consts::LOG2_E)));
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
