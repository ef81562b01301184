//! Matrix products without a backward: of cameras, in K-means and in optimizers.

use burn::tensor::Tensor;

/// Multiplies matrices, `[.., M, K]` by `[.., K, N]`: on GPUs by the kernels of clift, with sums in f32 and without a gradient.
pub fn matmul_without_gradient<const D: usize>(lhs: Tensor<D>, rhs: Tensor<D>) -> Tensor<D> {
    #[cfg(feature = "wgpu")]
    if let Some(product) = product_on_gpu(&lhs, &rhs) {
        return if lhs.is_autodiff() { product.autodiff() } else { product };
    }
    lhs.matmul(rhs)
}

#[cfg(feature = "wgpu")]
fn product_on_gpu<const D: usize>(lhs: &Tensor<D>, rhs: &Tensor<D>) -> Option<Tensor<D>> {
    use crate::ops::backends::cube_buffers::{cube_tensor, float_tensor};
    use crate::ops::kernels::Kernels;
    use crate::ops::precision::Precision;
    let inner = |x: &Tensor<D>| cube_tensor(&if x.is_autodiff() { x.clone().inner() } else { x.clone() });
    Some(float_tensor(<burn::backend::Cube as Kernels>::matmul(Precision::F32, inner(lhs)?, inner(rhs)?)))
}
