//! Linear layers as one operation, alone or fused with a preceding GELU or layer norm.
//!
//! The result of the GELU or norm is not kept for the backward but computed again from its input: the GELU's result is
//! the widest activation of a transformer block, and every block has two or three norms.
// B scenes, N rows of a scene, I inputs, O outputs

use burn::backend::tensor::FloatTensor;
use burn::backend::{Dispatch, TensorMetadata};
use burn::module::Param;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Shape, Tensor, assert_shape};

use crate::ops::autodiff::{Differentiable, InputGrads};
use crate::ops::backends::dispatch::operations;
use crate::ops::composed::primitives::rows;
use crate::ops::kernels::{Kernels, SavedTensor};
use crate::ops::mac_counter;
use crate::ops::precision::Precision;

/// Computes `x W + b`, with `b = 0` for a layer without bias.
///
/// # Shapes
/// - `x`: `[batch, count, inputs]`
/// - returns `[batch, count, outputs]`
pub fn linear(layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    apply(parameters(layer, &x), x, LinearLayer { gelu: false, precision: Precision::current() })
}

/// Computes [`linear`] in f32, independent of the precision of this thread: for layers whose inputs are rays, and for gates.
pub fn linear_in_f32(layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    apply(parameters(layer, &x), x, LinearLayer { gelu: false, precision: Precision::F32 })
}

/// Computes `gelu(x) W + b` with `gelu(x) = x Phi(x)` and the normal distribution function `Phi`.
///
/// # Shapes
/// - as [`linear`]
pub fn gelu_linear(layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    apply(parameters(layer, &x), x, LinearLayer { gelu: true, precision: Precision::current() })
}

/// Computes `norm(x) W + b` with `norm(x) = (x - mean) / sqrt(variance + 1e-5) * gamma + beta` per row, with `beta = 0` for
/// a norm without bias.
///
/// # Shapes
/// - as [`linear`]
pub fn norm_linear(norm: &LayerNorm, layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    let gamma = norm.gamma.val();
    let beta = norm.beta.as_ref().map_or_else(|| gamma.clone().detach().zeros_like(), Param::val);
    norm_then_linear([gamma, beta], parameters(layer, &x), x)
}

fn apply((weight, bias): (Tensor<2>, Tensor<1>), x: Tensor<3>, operation: LinearLayer) -> Tensor<3> {
    let [x, weight, bias] = [x.into_dispatch(), weight.into_dispatch(), bias.into_dispatch()];
    Tensor::from_dispatch(<Dispatch as LinearOps>::linear_layer(x, weight, bias, operation))
}

fn norm_then_linear(norm: [Tensor<1>; 2], (weight, bias): (Tensor<2>, Tensor<1>), x: Tensor<3>) -> Tensor<3> {
    let [inputs, _outputs] = weight.dims();
    assert_eq!(norm.each_ref().map(Tensor::dims), [[inputs]; 2], "gamma and beta have a value per column");
    let [gamma, beta] = norm.map(Tensor::into_dispatch);
    let [x, weight, bias] = [x.into_dispatch(), weight.into_dispatch(), bias.into_dispatch()];
    let precision = Precision::current();
    Tensor::from_dispatch(<Dispatch as LinearOps>::norm_then_linear(x, gamma, beta, weight, bias, precision))
}

/// Returns weight and bias, zeros without one, of a layer with input `x`, and counts its multiply-accumulates.
fn parameters(layer: &Linear, x: &Tensor<3>) -> (Tensor<2>, Tensor<1>) {
    let weight = layer.weight.val();
    let ([inputs, outputs], [batch, count, _]) = (weight.dims(), x.dims());
    let no_bias = || Tensor::zeros([outputs], (&weight.device(), weight.dtype()));
    let bias = layer.bias.as_ref().map_or_else(no_bias, Param::val);
    assert_shape!(x, [.., inputs]);
    mac_counter::add_linear(batch * count, inputs, outputs);
    (weight, bias)
}

operations! {
    /// The operations of [`linear`], [`gelu_linear`] and [`norm_linear`] on a backend.
    pub trait LinearOps {
        fn linear_layer(x, weight, bias; operation: LinearLayer) = operation;
        fn norm_then_linear(x, gamma, beta, weight, bias; precision: Precision) = NormLinear { precision };
    }
}

/// A linear layer, after a GELU or alone.
#[derive(Clone, Copy, Debug)]
pub struct LinearLayer {
    gelu: bool,
    precision: Precision,
}

impl<B: Kernels> Differentiable<B, 3> for LinearLayer {
    type Saved = (SavedTensor<FloatTensor<B>>, FloatTensor<B>);

    fn forward(&self, [x, weight, bias]: [FloatTensor<B>; 3]) -> FloatTensor<B> {
        let x = if self.gelu { B::exact_gelu_forward(x) } else { x };
        B::linear_forward(self.precision, [x, weight, bias])
    }

    fn forward_saving(&self, [x, weight, bias]: [FloatTensor<B>; 3]) -> (FloatTensor<B>, Self::Saved) {
        let output = Differentiable::<B, 3>::forward(self, [x.clone(), weight.clone(), bias]);
        // Other inputs may be held by other operations, too: the result of attention, the tokens of a scene.
        let x = if self.gelu { B::save(self.precision, x) } else { SavedTensor::whole(x) };
        (output, (x, weight))
    }

    /// With `a = x` or `gelu(x)`: `dW = a^T dO`, `db = sum dO`, `da = dO W^T`.
    fn gradients(
        &self,
        (x, weight): Self::Saved,
        grad: FloatTensor<B>,
        [of_x, of_weight, of_bias]: [bool; 3],
    ) -> InputGrads<B, 3> {
        let Self { gelu, precision } = *self;
        let x = B::restore(x);
        let grad_bias = of_bias.then(|| B::sum_rows(grad.clone()));
        let grad_weight = of_weight.then(|| {
            let activation = if gelu { B::exact_gelu_forward(x.clone()) } else { x.clone() };
            grad_of_weight::<B>(precision, activation, grad.clone())
        });
        let grad_x = of_x.then(|| {
            let grad = grad_of_input::<B>(precision, grad, weight);
            if gelu { B::exact_gelu_backward(x, grad) } else { grad }
        });
        [grad_x, grad_weight, grad_bias]
    }
}

/// A linear layer after a layer norm.
#[derive(Clone, Copy, Debug)]
struct NormLinear {
    precision: Precision,
}

impl<B: Kernels> Differentiable<B, 5> for NormLinear {
    /// Inputs without the bias, and the statistics of the norm.
    type Saved = ([FloatTensor<B>; 4], Option<FloatTensor<B>>);

    fn forward_saving(&self, [x, gamma, beta, weight, bias]: [FloatTensor<B>; 5]) -> (FloatTensor<B>, Self::Saved) {
        let (normal, statistics) = B::layer_norm_forward([x.clone(), gamma.clone(), beta.clone()]);
        let output = B::linear_forward(self.precision, [normal, weight.clone(), bias]);
        (output, ([x, gamma, beta, weight], statistics))
    }

    /// As for [`LinearLayer`] with `a = norm(x)`, and `da` passed on to the norm.
    fn gradients(
        &self,
        ([x, gamma, beta, weight], statistics): Self::Saved,
        grad: FloatTensor<B>,
        [of_x, of_gamma, of_beta, of_weight, of_bias]: [bool; 5],
    ) -> InputGrads<B, 5> {
        let grad_bias = of_bias.then(|| B::sum_rows(grad.clone()));
        let grad_weight = of_weight.then(|| {
            let (normal, _statistics) = B::layer_norm_forward([x.clone(), gamma.clone(), beta]);
            grad_of_weight::<B>(self.precision, normal, grad.clone())
        });
        let [grad_x, grad_gamma, grad_beta] = if of_x || of_gamma || of_beta {
            let grad = grad_of_input::<B>(self.precision, grad, weight);
            B::layer_norm_backward([x, gamma, grad], statistics).map(Some)
        } else {
            [None, None, None]
        };
        [grad_x, grad_gamma, grad_beta, grad_weight, grad_bias]
    }
}

/// `x^T grad`: `[I, O]`
fn grad_of_weight<B: Kernels>(precision: Precision, x: FloatTensor<B>, grad: FloatTensor<B>) -> FloatTensor<B> {
    B::matmul(precision, B::float_swap_dims(rows::<B>(x), 0, 1), rows::<B>(grad))
}

/// `grad W^T`: `[B, N, O] -> [B, N, I]`
fn grad_of_input<B: Kernels>(precision: Precision, grad: FloatTensor<B>, weight: FloatTensor<B>) -> FloatTensor<B> {
    let [batch, count, _] = grad.shape().dims();
    let [inputs, _] = weight.shape().dims();
    let product = B::matmul(precision, rows::<B>(grad), B::float_swap_dims(weight, 0, 1));
    B::float_reshape(product, Shape::new([batch, count, inputs]))
}

#[cfg(test)]
pub(crate) mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::testing::{
        assert_close, assert_finite, check_gradients, check_native, devices, output_and_gradients, random,
    };

    /// Input, gamma, beta, weight and bias.
    fn inputs([rows, inputs, outputs]: [usize; 3], device: &Device) -> [Tensor<3>; 5] {
        let shapes = [[1, rows, inputs], [1, 1, inputs], [1, 1, inputs], [1, inputs, outputs], [1, 1, outputs]];
        let mut seed = 0;
        shapes.map(|shape| {
            seed += 1;
            random(shape, seed, device)
        })
    }

    /// A layer alone, after a GELU, and after a norm, of an input, gamma, beta, weight and bias.
    pub(crate) const LAYERS: [fn([Tensor<3>; 5]) -> Tensor<3>; 3] = [
        |[x, _, _, weight, bias]| {
            apply(flat(weight, bias), x, LinearLayer { gelu: false, precision: Precision::current() })
        },
        |[x, _, _, weight, bias]| {
            apply(flat(weight, bias), x, LinearLayer { gelu: true, precision: Precision::current() })
        },
        |[x, gamma, beta, weight, bias]| {
            norm_then_linear([gamma, beta].map(|values| values.flatten(0, 2)), flat(weight, bias), x)
        },
    ];

    fn flat(weight: Tensor<3>, bias: Tensor<3>) -> (Tensor<2>, Tensor<1>) {
        let [_, inputs, outputs] = weight.dims();
        (weight.reshape([inputs, outputs]), bias.reshape([outputs]))
    }

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in devices() {
            for layer in LAYERS {
                check_gradients(inputs([5, 8, 6], &device), layer, 1e-6);
            }
        }
    }

    #[test]
    fn native_kernels_equal_f64_at_odd_shapes() {
        for sizes in [[1, 5, 7], [3, 12, 1], [777, 37, 9], [500, 96, 90], [65, 768, 5]] {
            let [x, gamma, beta, weight, bias] = inputs(sizes, &Device::flex());
            for layer in LAYERS {
                // Of mean 3, in -7 to 13.
                let x = x.clone() * 10.0 + 3.0;
                check_native([x, gamma.clone(), beta.clone(), weight.clone(), bias.clone()], layer, 1e-5);
            }
        }
    }

    #[test]
    fn a_constant_row_gives_beta_and_finite_gradients() {
        for device in devices() {
            let [_, gamma, beta, weight, _] = inputs([2, 12, 12], &device).map(|input| input.cast(DType::F32));
            let x = Tensor::<3>::full([1, 2, 12], 3.0, &device);
            let identity = Tensor::<2>::eye(12, &device).unsqueeze::<3>();
            let inputs = [x, gamma, beta.clone(), identity, beta.zeros_like()];
            let cotangent = weight.narrow(1, 0, 2);
            let (output, grads) = output_and_gradients(inputs, cotangent, LAYERS[2]);
            assert_close(&output, &beta.expand([1, 2, 12]), 1e-4);
            assert_finite(grads);
        }
    }
}
