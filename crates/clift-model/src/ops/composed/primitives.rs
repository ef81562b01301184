//! Slices, sums and means that several operations use.

use std::ops::Range;

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::{Shape, Slice};

pub(crate) fn narrow<B: Backend>(x: &FloatTensor<B>, dim: usize, range: Range<usize>) -> FloatTensor<B> {
    let shape = x.shape();
    if range == (0..shape[dim]) {
        return x.clone();
    }
    let ranges = (0..shape.num_dims()).map(|i| if i == dim { range.clone() } else { 0..shape[i] });
    B::float_slice(x.clone(), &ranges.map(Slice::from).collect::<Vec<_>>())
}

/// `[B, N, D] -> [BN, D]`
pub(crate) fn rows<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let [batch, count, dim] = x.shape().dims();
    B::float_reshape(x, Shape::new([batch * count, dim]))
}

/// Sum over rows: `[B, N, D] -> [D]`.
pub(crate) fn sum_rows<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let x = rows::<B>(x);
    let [_, dim] = x.shape().dims();
    B::float_reshape(B::float_sum_dim(x, 0), Shape::new([dim]))
}

/// Mean over the last dimension: `[.., D] -> [.., 1]`.
pub(crate) fn mean<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let shape = x.shape();
    let last = shape.num_dims() - 1;
    B::float_mul_scalar(B::float_sum_dim(x, last), (1.0 / shape[last] as f64).into())
}

/// Returns the factor of the scores of attention, `1 / sqrt(head width)`.
pub(crate) fn score_scale(dim: usize, num_heads: usize) -> f64 {
    1.0 / ((dim / num_heads) as f64).sqrt()
}
