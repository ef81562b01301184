//! RMS norms of the heads of queries and keys.

use burn::backend::Dispatch;
use burn::backend::tensor::FloatTensor;
use burn::nn::RmsNorm;
use burn::tensor::Tensor;
use clift_kernels::HeadRows;

use crate::ops::autodiff::Differentiable;
use crate::ops::backends::dispatch::operations;
use crate::ops::kernels::Kernels;

/// Computes `x / sqrt(mean(x^2) + epsilon) * gamma` of every head of the first parts of rows, a norm for each of them; the
/// other parts stay. A row has queries, keys and values side by side, or fewer of them.
///
/// # Shapes
/// - `x` and the result: `[batch, count, num_parts * num_heads * head_width]`
/// - gamma of a norm: `[head_width]`
pub(crate) fn rms_norm_heads<const K: usize>(x: Tensor<3>, norms: [&RmsNorm; K], num_parts: usize) -> Tensor<3> {
    let [_batch, _count, width] = x.dims();
    let [head_width] = norms[0].gamma.dims();
    let num_heads = width / num_parts / head_width;
    let epsilon = norms[0].epsilon;
    let gammas = Tensor::cat(norms.iter().map(|norm| norm.gamma.val()).collect(), 0);
    apply(x, gammas, HeadRows { num_parts, num_heads, head_width, epsilon })
}

fn apply(x: Tensor<3>, gammas: Tensor<1>, rows: HeadRows) -> Tensor<3> {
    Tensor::from_dispatch(<Dispatch as RmsNormOps>::rms_norm_heads(x.into_dispatch(), gammas.into_dispatch(), rows))
}

operations! {
    /// The operation of [`rms_norm_heads`] on a backend; `gammas` has those of all norms.
    pub trait RmsNormOps {
        fn rms_norm_heads(x, gammas; rows: HeadRows) = HeadNorms(rows);
    }
}

#[derive(Clone, Copy, Debug)]
struct HeadNorms(HeadRows);

impl<B: Kernels> Differentiable<B, 2> for HeadNorms {
    /// Inputs.
    type Saved = [FloatTensor<B>; 2];

    fn forward(&self, inputs: [FloatTensor<B>; 2]) -> FloatTensor<B> {
        B::rms_norm_forward(inputs, self.0)
    }

    fn forward_saving(&self, inputs: [FloatTensor<B>; 2]) -> (FloatTensor<B>, Self::Saved) {
        (B::rms_norm_forward(inputs.clone(), self.0), inputs)
    }

    fn gradients(
        &self,
        inputs: Self::Saved,
        grad_output: FloatTensor<B>,
        _needed: [bool; 2],
    ) -> [Option<FloatTensor<B>>; 2] {
        B::rms_norm_backward(inputs, grad_output, self.0).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::testing::{
        assert_close, assert_finite, check_equal, check_gradients, check_native, devices, output_and_gradients, random,
    };

    /// Normalizes the first two of three parts; gammas are `[1, 1, E]`.
    fn norm([x, query, key]: [Tensor<3>; 3]) -> Tensor<3> {
        let ([_, _, width], [_, _, head_width]) = (x.dims(), query.dims());
        let rows = HeadRows { num_parts: 3, num_heads: width / 3 / head_width, head_width, epsilon: 1e-5 };
        apply(x, Tensor::cat(vec![query, key], 2).reshape([2 * head_width]), rows)
    }

    fn inputs(num_heads: usize, head_width: usize, device: &Device) -> [Tensor<3>; 3] {
        let shapes = [[2, 35, 3 * num_heads * head_width], [1, 1, head_width], [1, 1, head_width]];
        let mut seed = 0;
        shapes.map(|shape| {
            seed += 1;
            random(shape, seed, device)
        })
    }

    /// The operation as Burn's own norms of the parts.
    fn plain([x, query, key]: [Tensor<3>; 3]) -> Tensor<3> {
        let ([batch, count, width], [_, _, head_width]) = (x.dims(), query.dims());
        let part = |i: usize| x.clone().narrow(2, i * width / 3, width / 3);
        let norm = |x: Tensor<3>, gamma: Tensor<3>| {
            let x = x.reshape([batch, count, width / 3 / head_width, head_width]);
            let scale = (x.clone().square().mean_dim(3) + 1e-5).sqrt();
            (x / scale * gamma.unsqueeze_dim(2)).reshape([batch, count, width / 3])
        };
        Tensor::cat(vec![norm(part(0), query), norm(part(1), key), part(2)], 2)
    }

    #[test]
    fn gradients_equal_central_differences_and_plain_autodiff_in_f64() {
        for device in devices() {
            let [x, query, key] = inputs(2, 6, &device);
            check_gradients([x.narrow(1, 0, 3), query, key], norm, 1e-6);
            let cotangent = random([2, 35, 36], 9, &device);
            check_equal(inputs(2, 6, &device), cotangent, norm, plain, 1e-12);
        }
    }

    #[test]
    fn native_kernels_equal_the_composed_operation() {
        let device = Device::flex();
        for (num_heads, head_width) in [(2, 8), (3, 32), (1, 37)] {
            let cotangent = random([2, 35, 3 * num_heads * head_width], 4, &device);
            check_native(inputs(num_heads, head_width, &device), cotangent, norm, 1e-5);
        }
    }

    #[test]
    fn a_head_of_zeros_gives_zeros_and_finite_gradients() {
        for device in devices() {
            let inputs = inputs(2, 8, &device).map(|input| input.cast(DType::F32));
            let [_, query, key] = inputs;
            let x = Tensor::<3>::zeros([1, 2, 48], &device);
            let cotangent = random([1, 2, 48], 3, &device).cast(DType::F32);
            let (output, grads) = output_and_gradients([x.clone(), query, key], cotangent, norm);
            assert_close(&output, &x, 1e-12);
            assert_finite(grads);
        }
    }
}
