//! Layer norm, and RMS norms of heads, on any backend.
// B scenes, N tokens, D width, P parts of a row, K parts with a norm, H heads, E width of a head

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::Shape;
use clift_kernels::HeadRows;

use crate::ops::composed::primitives::{mean, narrow, sum_rows};

/// Added to the variance of a layer norm, as in PyTorch.
pub const EPSILON: f64 = 1e-5;

/// Inputs of the backward of a layer norm.
#[derive(Clone, Debug)]
pub struct LayerNormInputs<T> {
    /// Input, `[B, N, D]`.
    pub x: T,
    /// Scale, `[D]`.
    pub gamma: T,
    /// Mean and inverse deviation of every row, `[BN, 2]`, if the native kernel computed them.
    pub statistics: Option<T>,
}

/// Computes `(x - mean) / sqrt(variance + 1e-5) * gamma + beta`.
pub(crate) fn layer_norm_forward<B: Backend>([x, gamma, beta]: [FloatTensor<B>; 3]) -> FloatTensor<B> {
    let (normal, _) = layer_normalize::<B>(x);
    B::float_add(B::float_mul(normal, row::<B>(gamma)), row::<B>(beta))
}

/// Computes the gradients. With `y` the normalized rows and `g = dO gamma`: `dx = (g - mean(g) - y mean(g y)) / deviation`,
/// `dgamma = sum(dO y)`, `dbeta = sum(dO)`.
pub(crate) fn layer_norm_backward<B: Backend>(
    LayerNormInputs { x, gamma, .. }: LayerNormInputs<FloatTensor<B>>,
    grad: FloatTensor<B>,
) -> [FloatTensor<B>; 3] {
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
    let parts = NormParts::new::<B>(&x, &gammas, rows);
    let (normal, _) = rms_normalize::<B>(parts.select::<B>(&x), rows.epsilon);
    parts.replace::<B>(x, B::float_mul(normal, parts.per_head::<B>(gammas)))
}

/// Computes the gradients. With `y = x r` and `g = dO gamma`: `dx = r (g - y mean(g y))`, `dgamma = sum(dO y)` over tokens
/// and heads.
pub(crate) fn rms_norm_backward<B: Backend>(
    [x, gammas]: [FloatTensor<B>; 2],
    grad: FloatTensor<B>,
    rows: HeadRows,
) -> [FloatTensor<B>; 2] {
    let parts = NormParts::new::<B>(&x, &gammas, rows);
    let (normal, inverse) = rms_normalize::<B>(parts.select::<B>(&x), rows.epsilon);
    let grad_parts = parts.select::<B>(&grad);
    let product = B::float_mul(grad_parts.clone(), normal.clone());
    let grad_gammas = B::float_reshape(B::float_sum_dim(B::float_sum_dim(product, 0), 2), gammas.shape());
    let slope = B::float_mul(grad_parts, parts.per_head::<B>(gammas));
    let along = mean::<B>(B::float_mul(slope.clone(), normal.clone()));
    let grad_x = B::float_mul(B::float_sub(slope, B::float_mul(normal, along)), inverse);
    [parts.replace::<B>(grad, grad_x), grad_gammas]
}

/// The parts of rows with a norm as a tensor `[BN, K, H, E]`.
struct NormParts {
    rows: HeadRows,
    /// BN
    num_rows: usize,
    /// K
    count: usize,
}

impl NormParts {
    fn new<B: Backend>(x: &FloatTensor<B>, gammas: &FloatTensor<B>, rows: HeadRows) -> Self {
        let [batch, count, _] = x.shape().dims();
        Self { rows, num_rows: batch * count, count: gammas.shape().num_elements() / rows.head_width }
    }

    /// `[B, N, P H E] -> [BN, P, H, E]`
    fn split<B: Backend>(&self, x: &FloatTensor<B>) -> FloatTensor<B> {
        let HeadRows { num_parts, num_heads, head_width, .. } = self.rows;
        B::float_reshape(x.clone(), Shape::new([self.num_rows, num_parts, num_heads, head_width]))
    }

    /// Returns the parts with a norm.
    fn select<B: Backend>(&self, x: &FloatTensor<B>) -> FloatTensor<B> {
        narrow::<B>(&self.split::<B>(x), 1, 0..self.count)
    }

    /// Returns `x` with other values of the parts that have a norm.
    fn replace<B: Backend>(&self, x: FloatTensor<B>, values: FloatTensor<B>) -> FloatTensor<B> {
        let mut parts = vec![values];
        if self.count < self.rows.num_parts {
            parts.push(narrow::<B>(&self.split::<B>(&x), 1, self.count..self.rows.num_parts));
        }
        B::float_reshape(B::float_cat(parts, 1), x.shape())
    }

    /// `[K E] -> [1, K, 1, E]`
    fn per_head<B: Backend>(&self, gammas: FloatTensor<B>) -> FloatTensor<B> {
        B::float_reshape(gammas, Shape::new([1, self.count, 1, self.rows.head_width]))
    }
}
