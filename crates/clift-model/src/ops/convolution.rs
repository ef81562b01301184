//! Convolutions of 3 x 3 values with constant weights, of networks inside a loss.

use burn::backend::Dispatch;
use burn::backend::tensor::FloatTensor;
use burn::tensor::{Tensor, assert_shape};

use crate::ops::autodiff::{Differentiable, InputGrads};
use crate::ops::backends::dispatch::operations;
use crate::ops::kernels::Kernels;

/// Convolves images with zeros around them. Weights and biases get no gradient.
///
/// # Shapes
/// - `x`: `[batch, inputs, height, width]`
/// - `weight`: `[outputs, inputs, 3, 3]`, `bias`: `[outputs]`
/// - returns `[batch, outputs, height, width]`
pub(crate) fn convolution(x: Tensor<4>, weight: Tensor<4>, bias: Tensor<1>) -> Tensor<4> {
    let [outputs, inputs, _, _] = weight.dims();
    let [batch, _, height, width] = x.dims();
    assert_shape!(x, [batch, inputs, height, width]);
    assert_shape!(weight, [outputs, inputs, 3, 3]);
    assert_shape!(bias, [outputs]);
    let [x, weight, bias] = [x.into_dispatch(), weight.into_dispatch(), bias.into_dispatch()];
    Tensor::from_dispatch(<Dispatch as ConvolutionOps>::convolution(x, weight, bias))
}

operations! {
    /// The operation of [`convolution`] on a backend.
    pub trait ConvolutionOps {
        fn convolution(x, weight, bias;) = Convolution;
    }
}

#[derive(Clone, Copy, Debug)]
struct Convolution;

impl<B: Kernels> Differentiable<B, 3> for Convolution {
    type Saved = [FloatTensor<B>; 2];

    fn forward_saving(&self, [x, weight, bias]: [FloatTensor<B>; 3]) -> (FloatTensor<B>, Self::Saved) {
        (B::convolution([x.clone(), weight.clone(), bias]), [x, weight])
    }

    fn gradients(&self, [x, weight]: Self::Saved, grad: FloatTensor<B>, _: [bool; 3]) -> InputGrads<B, 3> {
        [Some(B::convolution_backward([x, weight, grad])), None, None]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{check_gradients, devices, random};

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in devices() {
            let (weight, bias) = (random([4, 3, 3, 3], 1, &device), random([4], 2, &device));
            let convolve =
                |[x]: [Tensor<3>; 1]| convolution(x.reshape([2, 3, 4, 5]), weight.clone(), bias.clone()).flatten(2, 3);
            check_gradients([random([2, 3, 20], 3, &device)], convolve, 1e-6);
        }
    }
}
