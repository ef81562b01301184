//! RMS norms of the heads of queries and keys.

use burn::backend::Dispatch;
use burn::backend::tensor::FloatTensor;
use burn::nn::RmsNorm;
use burn::tensor::Tensor;
use clift_kernels::HeadRows;

use crate::ops::autodiff::{Differentiable, InputGrads};
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
        fn rms_norm_heads(x, gammas; rows: HeadRows) = rows;
    }
}

impl<B: Kernels> Differentiable<B, 2> for HeadRows {
    type Saved = [FloatTensor<B>; 2];

    fn forward(&self, inputs: [FloatTensor<B>; 2]) -> FloatTensor<B> {
        B::rms_norm_forward(inputs, *self)
    }

    fn forward_saving(&self, inputs: [FloatTensor<B>; 2]) -> (FloatTensor<B>, Self::Saved) {
        (B::rms_norm_forward(inputs.clone(), *self), inputs)
    }

    fn gradients(&self, [x, gammas]: Self::Saved, grad: FloatTensor<B>, _: [bool; 2]) -> InputGrads<B, 2> {
        B::rms_norm_backward([x, gammas, grad], *self).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::testing::{
        assert_close, assert_finite, check_gradients, check_native, devices, output_and_gradients, random,
    };

    /// Returns the norm of the first `K` parts of rows with their gammas, `[1, 1, K E]`.
    fn norm([num_parts, num_heads, head_width]: [usize; 3]) -> impl Fn([Tensor<3>; 2]) -> Tensor<3> {
        let rows = HeadRows { num_parts, num_heads, head_width, epsilon: 1e-5 };
        move |[x, gammas]| apply(x, gammas.flatten(0, 2), rows)
    }

    fn inputs(count: usize, sizes: [usize; 3], num_gammas: usize, device: &Device) -> [Tensor<3>; 2] {
        let shapes = [([1, count, sizes.iter().product()], 1), ([1, 1, num_gammas * sizes[2]], 2)];
        shapes.map(|(shape, seed)| random(shape, seed, device))
    }

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in devices() {
            for num_gammas in [1, 2, 3] {
                check_gradients(inputs(3, [3, 2, 6], num_gammas, &device), norm([3, 2, 6]), 1e-6);
            }
        }
    }

    #[test]
    fn native_kernels_equal_f64_at_odd_shapes() {
        for (count, sizes, num_gammas) in
            [(1, [1, 1, 5], 1), (700, [3, 4, 32], 2), (333, [2, 3, 8], 1), (65, [3, 2, 37], 3), (9, [3, 12, 64], 2)]
        {
            check_native(inputs(count, sizes, num_gammas, &Device::flex()), norm(sizes), 1e-5);
        }
    }

    #[test]
    fn a_head_of_zeros_gives_zeros_and_finite_gradients() {
        for device in devices() {
            let [x, gammas] = inputs(2, [3, 2, 8], 2, &device).map(|input| input.cast(DType::F32));
            let zeros = x.zeros_like();
            let (output, grads) = output_and_gradients([zeros.clone(), gammas], x, norm([3, 2, 8]));
            assert_close(&output, &zeros, 1e-12);
            assert_finite(grads);
        }
    }
}
