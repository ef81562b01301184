//! Linear layer, on any backend.

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::Shape;

use crate::ops::composed::primitives::rows;

/// Computes `x W + b`: `[B, N, I] -> [B, N, O]`.
pub(crate) fn forward<B: Backend>(
    [x, weight, bias]: [FloatTensor<B>; 3],
    matmul: impl Fn(FloatTensor<B>, FloatTensor<B>) -> FloatTensor<B>,
) -> FloatTensor<B> {
    let [batch, count, _] = x.shape().dims();
    let [_, outputs] = weight.shape().dims();
    let product = matmul(rows::<B>(x), weight); // [BN, O]
    let bias = B::float_expand(B::float_reshape(bias, Shape::new([1, outputs])), product.shape());
    B::float_reshape(B::float_add(product, bias), Shape::new([batch, count, outputs]))
}
