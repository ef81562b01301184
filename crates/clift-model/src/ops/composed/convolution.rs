//! Convolutions of 3 x 3 values by Burn.

use burn::backend::Backend;
use burn::backend::tensor::FloatTensor;
use burn::tensor::ops::ConvOptions;

/// Convolves images `[B, I, H, W]` with zeros around them by `weight: [O, I, 3, 3]`.
pub(crate) fn forward<B: Backend>(x: FloatTensor<B>, weight: FloatTensor<B>, bias: FloatTensor<B>) -> FloatTensor<B> {
    B::conv2d(x, weight, Some(bias), options())
}

/// Computes the gradient of `x`.
pub(crate) fn backward<B: Backend>(x: FloatTensor<B>, weight: FloatTensor<B>, grad: FloatTensor<B>) -> FloatTensor<B> {
    B::conv2d_x_backward(x, weight, grad, options())
}

fn options() -> ConvOptions<2> {
    ConvOptions::new([1, 1], [1, 1], [1, 1], 1)
}

/// Returns the kernel of the gradient, `[3, 3, O, I]`: flipped along rows and columns, with inputs and outputs swapped.
#[cfg(feature = "wgpu")]
pub(crate) fn weight_of_gradient<B: Backend>(weight: FloatTensor<B>) -> FloatTensor<B> {
    B::float_permute(B::float_flip(weight, &[2, 3]), &[2, 3, 0, 1])
}
