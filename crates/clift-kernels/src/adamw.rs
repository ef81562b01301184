//! One pass of AdamW over a parameter (Loshchilov and Hutter 2019), and sums of squares.

use rayon::prelude::*;

use crate::InstructionSet;
use crate::elementwise::PIECE;
use crate::instruction_set::Kernel;
use crate::simd::Simd;

/// The numbers of one update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Update {
    /// Decay of the first and of the second moment.
    pub betas: [f32; 2],
    /// `lr / (1 - beta_1^t)`.
    pub rate: f32,
    /// `sqrt(1 - beta_2^t)`.
    pub root_correction: f32,
    /// Added to the corrected root of the second moment.
    pub epsilon: f32,
    /// `1 - lr * weight decay`.
    pub keep: f32,
    /// What gradients are multiplied by first.
    pub grad_scale: f32,
}

/// Updates a parameter and its two moments from its gradient:
/// `m = b1 m + (1 - b1) g`, `v = b2 v + (1 - b2) g^2`,
/// `p = keep p - rate m / (sqrt(v) / root_correction + epsilon)`.
pub fn update(set: InstructionSet, update: Update, [param, first, second]: [&mut [f32]; 3], grad: &[f32]) {
    let len = param.len();
    assert!(first.len() == len && second.len() == len && grad.len() == len, "a value of each for every parameter");
    let pieces = param
        .par_chunks_mut(PIECE)
        .zip(first.par_chunks_mut(PIECE))
        .zip(second.par_chunks_mut(PIECE))
        .zip(grad.par_chunks(PIECE));
    pieces.for_each(|(((param, first), second), grad)| set.run(Piece { update, param, first, second, grad }));
}

struct Piece<'a> {
    update: Update,
    param: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
    grad: &'a [f32],
}

impl Kernel for Piece<'_> {
    type Output = ();

    #[inline(always)]
    #[expect(clippy::inline_always, reason = "must be compiled with the instructions of its caller")]
    fn run<S: Simd>(self, simd: S) {
        let Self { update, param, first, second, grad } = self;
        let Update { betas, rate, root_correction, epsilon, keep, grad_scale } = update;
        let [beta_1, beta_2] = betas.map(|beta| simd.splat(beta));
        let [rest_1, rest_2] = betas.map(|beta| simd.splat(1.0 - beta));
        let (rate, keep, scale) = (simd.splat(rate), simd.splat(keep), simd.splat(grad_scale));
        let (correction, epsilon) = (simd.splat(1.0 / root_correction), simd.splat(epsilon));
        for start in (0..param.len()).step_by(S::LANES) {
            let grad = simd.mul(simd.read(&grad[start..]), scale);
            let m = simd.mul_add(simd.read(&first[start..]), beta_1, simd.mul(grad, rest_1));
            let v = simd.mul_add(simd.read(&second[start..]), beta_2, simd.mul(simd.mul(grad, grad), rest_2));
            let root = simd.mul_add(simd.sqrt(v), correction, epsilon);
            let delta = simd.div(simd.mul(rate, m), root);
            let value = simd.sub(simd.mul(simd.read(&param[start..]), keep), delta);
            simd.write(&mut first[start..], m);
            simd.write(&mut second[start..], v);
            simd.write(&mut param[start..], value);
        }
    }
}

/// Sum of squares, in f64 over pieces.
pub fn sum_of_squares(set: InstructionSet, values: &[f32]) -> f64 {
    let parts: Vec<f64> = values.par_chunks(PIECE).map(|piece| f64::from(set.run(Squares(piece)))).collect();
    parts.iter().sum()
}

struct Squares<'a>(&'a [f32]);

impl Kernel for Squares<'_> {
    type Output = f32;

    #[inline(always)]
    #[expect(clippy::inline_always, reason = "must be compiled with the instructions of its caller")]
    fn run<S: Simd>(self, simd: S) -> f32 {
        let mut total = simd.splat(0.0);
        for chunk in self.0.chunks(S::LANES) {
            let values = simd.read(chunk);
            total = simd.mul_add(values, values, total);
        }
        simd.sum(total)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_close, random};

    #[test]
    fn every_instruction_set_equals_f64_over_some_updates() {
        let len = 1037;
        for set in InstructionSet::available() {
            let mut state = [random(len, 1), vec![0.0; len], vec![0.0; len]];
            let mut expected = [0, 1, 2].map(|i| state[i].iter().map(|&v| f64::from(v)).collect::<Vec<_>>());
            let (b1, b2, lr, epsilon, decay, scale) = (0.9_f64, 0.95_f64, 1e-2_f64, 1e-8_f64, 0.05_f64, 0.5_f64);
            for t in 1..=5 {
                let grad = random(len, 10 + t as u64);
                let corrections = (1.0 - b1.powi(t), 1.0 - b2.powi(t));
                let numbers = Update {
                    betas: [b1 as f32, b2 as f32],
                    rate: (lr / corrections.0) as f32,
                    root_correction: corrections.1.sqrt() as f32,
                    epsilon: epsilon as f32,
                    keep: (1.0 - lr * decay) as f32,
                    grad_scale: scale as f32,
                };
                let [param, first, second] = &mut state;
                update(set, numbers, [param, first, second], &grad);
                let [param, first, second] = &mut expected;
                for i in 0..len {
                    let g = f64::from(grad[i]) * scale;
                    first[i] = b1 * first[i] + (1.0 - b1) * g;
                    second[i] = b2 * second[i] + (1.0 - b2) * g * g;
                    let root = (second[i] / corrections.1).sqrt() + epsilon;
                    param[i] = param[i] * (1.0 - lr * decay) - lr * first[i] / corrections.0 / root;
                }
            }
            for (got, expected) in state.iter().zip(&expected) {
                assert_close(got, expected, 1e-6);
            }
            let values = random(40_000, 3);
            let squares: f64 = values.iter().map(|&value| f64::from(value).powi(2)).sum();
            assert!((sum_of_squares(set, &values) / squares - 1.0).abs() < 1e-6);
        }
    }
}
