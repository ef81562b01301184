//! Linear layer, GELU with exact gradient, norms and convolutions, on any backend.
// B scenes, N tokens, D width, P parts of a row, K parts with a norm, H heads, E width of a head

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::Shape;
use burn::tensor::ops::ConvOptions;
use clift_kernels::HeadRows;

use crate::ops::composed::primitives::{mean, narrow, rows, sum_rows};

/// Added to the variance of a layer norm, as in PyTorch.
pub const EPSILON: f64 = 1e-5;

/// Computes `x W + b`: `[B, N, I] -> [B, N, O]`.
pub(crate) fn linear<B: Backend>(
    [x, weight, bias]: [FloatTensor<B>; 3],
    matmul: impl Fn(FloatTensor<B>, FloatTensor<B>) -> FloatTensor<B>,
) -> FloatTensor<B> {
    let [batch, count, _] = x.shape().dims();
    let [_, outputs] = weight.shape().dims();
    let product = matmul(rows::<B>(x), weight); // [BN, O]
    let bias = B::float_expand(B::float_reshape(bias, Shape::new([1, outputs])), product.shape());
    B::float_reshape(B::float_add(product, bias), Shape::new([batch, count, outputs]))
}

pub(crate) fn gelu_forward<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    B::float_mul(x.clone(), normal_cdf::<B>(x))
}

/// Computes `grad (Phi(x) + x phi(x))`.
pub(crate) fn gelu_backward<B: Backend>(x: FloatTensor<B>, grad: FloatTensor<B>) -> FloatTensor<B> {
    let density = B::float_exp(B::float_mul_scalar(B::float_mul(x.clone(), x.clone()), (-0.5).into()));
    let density = B::float_mul_scalar(density, (1.0 / (2.0 * std::f64::consts::PI).sqrt()).into());
    B::float_mul(grad, B::float_add(normal_cdf::<B>(x.clone()), B::float_mul(x, density)))
}

fn normal_cdf<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let erf = B::float_erf(B::float_mul_scalar(x, std::f64::consts::FRAC_1_SQRT_2.into()));
    B::float_mul_scalar(B::float_add_scalar(erf, 1.0.into()), 0.5.into())
}

/// Convolves images `[B, I, H, W]` with zeros around them by `weight: [O, I, 3, 3]`.
pub(crate) fn convolution<B: Backend>([x, weight, bias]: [FloatTensor<B>; 3]) -> FloatTensor<B> {
    B::conv2d(x, weight, Some(bias), one_pixel_around())
}

pub(crate) fn convolution_backward<B: Backend>([x, weight, grad]: [FloatTensor<B>; 3]) -> FloatTensor<B> {
    B::conv2d_x_backward(x, weight, grad, one_pixel_around())
}

fn one_pixel_around() -> ConvOptions<2> {
    ConvOptions::new([1, 1], [1, 1], [1, 1], 1)
}

/// Computes `(x - mean) / sqrt(variance + 1e-5) * gamma + beta`.
pub(crate) fn layer_norm_forward<B: Backend>([x, gamma, beta]: [FloatTensor<B>; 3]) -> FloatTensor<B> {
    let (normal, _) = layer_normalize::<B>(x);
    B::float_add(B::float_mul(normal, row::<B>(gamma)), row::<B>(beta))
}

/// Computes the gradients. With `y` the normalized rows and `g = dO gamma`: `dx = (g - mean(g) - y mean(g y)) / deviation`,
/// `dgamma = sum(dO y)`, `dbeta = sum(dO)`.
pub(crate) fn layer_norm_backward<B: Backend>([x, gamma, grad]: [FloatTensor<B>; 3]) -> [FloatTensor<B>; 3] {
    let (normal, inverse) = layer_normalize::<B>(x);
    let grad_gamma = sum_rows::<B>(B::float_mul(grad.clone(), normal.clone()));
    let grad_beta = sum_rows::<B>(grad.clone());
    let slope = B::float_mul(grad, row::<B>(gamma));
    let along = B::float_mul(normal.clone(), mean::<B>(B::float_mul(slope.clone(), normal)));
    let grad_x = B::float_mul(B::float_sub(B::float_sub(slope.clone(), mean::<B>(slope)), along), inverse);
    [grad_x, grad_gamma, grad_beta]
}

/// Returns `(x - mean) / deviation` and `1 / deviation`.
fn layer_normalize<B: Backend>(x: FloatTensor<B>) -> (FloatTensor<B>, FloatTensor<B>) {
    rms_normalize::<B>(B::float_sub(x.clone(), mean::<B>(x)), EPSILON)
}

/// Returns `x r` and `r = 1 / sqrt(mean(x^2) + epsilon)`, over the last dimension.
fn rms_normalize<B: Backend>(x: FloatTensor<B>, epsilon: f64) -> (FloatTensor<B>, FloatTensor<B>) {
    let square = mean::<B>(B::float_mul(x.clone(), x.clone()));
    let inverse = B::float_recip(B::float_sqrt(B::float_add_scalar(square, epsilon.into())));
    (B::float_mul(x, inverse.clone()), inverse)
}

/// `[D] -> [1, 1, D]`
fn row<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let [dim] = x.shape().dims();
    B::float_reshape(x, Shape::new([1, 1, dim]))
}

/// Computes `x / sqrt(mean(x^2) + epsilon) * gamma` of every head of the parts with a norm.
pub(crate) fn rms_norm_forward<B: Backend>([x, gammas]: [FloatTensor<B>; 2], rows: HeadRows) -> FloatTensor<B> {
    let gammas = per_head::<B>(gammas, rows);
    let (heads, others) = split_parts::<B>(&x, &gammas, rows);
    let (normal, _) = rms_normalize::<B>(heads, rows.epsilon);
    join_parts::<B>(B::float_mul(normal, gammas), others, x.shape())
}

/// Computes the gradients. With `y = x r` and `g = dO gamma`: `dx = r (g - y mean(g y))`, `dgamma = sum(dO y)` over tokens
/// and heads.
pub(crate) fn rms_norm_backward<B: Backend>(
    [x, gammas, grad]: [FloatTensor<B>; 3],
    rows: HeadRows,
) -> [FloatTensor<B>; 2] {
    let gammas_shape = gammas.shape();
    let gammas = per_head::<B>(gammas, rows);
    let (heads, _) = split_parts::<B>(&x, &gammas, rows);
    let (normal, inverse) = rms_normalize::<B>(heads, rows.epsilon);
    let (grad_heads, others) = split_parts::<B>(&grad, &gammas, rows);
    let product = B::float_mul(grad_heads.clone(), normal.clone());
    let grad_gammas = B::float_reshape(B::float_sum_dim(B::float_sum_dim(product, 0), 2), gammas_shape);
    let slope = B::float_mul(grad_heads, gammas);
    let along = mean::<B>(B::float_mul(slope.clone(), normal.clone()));
    let grad_heads = B::float_mul(B::float_sub(slope, B::float_mul(normal, along)), inverse);
    [join_parts::<B>(grad_heads, others, x.shape()), grad_gammas]
}

/// `[K E] -> [1, K, 1, E]`
fn per_head<B: Backend>(gammas: FloatTensor<B>, HeadRows { head_width, .. }: HeadRows) -> FloatTensor<B> {
    let count = gammas.shape().num_elements() / head_width;
    B::float_reshape(gammas, Shape::new([1, count, 1, head_width]))
}

/// Splits rows into the parts with a gamma, `[BN, K, H, E]`, and the others, if there are any.
fn split_parts<B: Backend>(
    x: &FloatTensor<B>,
    gammas: &FloatTensor<B>,
    HeadRows { num_parts, num_heads, head_width, .. }: HeadRows,
) -> (FloatTensor<B>, Option<FloatTensor<B>>) {
    let [batch, count, _] = x.shape().dims();
    let x = B::float_reshape(x.clone(), Shape::new([batch * count, num_parts, num_heads, head_width]));
    let count = gammas.shape()[1];
    (narrow::<B>(&x, 1, 0..count), (count < num_parts).then(|| narrow::<B>(&x, 1, count..num_parts)))
}

fn join_parts<B: Backend>(heads: FloatTensor<B>, others: Option<FloatTensor<B>>, shape: Shape) -> FloatTensor<B> {
    B::float_reshape(B::float_cat([heads].into_iter().chain(others).collect(), 1), shape)
}
