//! The transform of heads in camera-relative attention, by the camera and the patch of every token.

use burn::backend::Dispatch;
use burn::backend::tensor::FloatTensor;
use burn::tensor::{Tensor, assert_shape};
use clift_kernels::{HeadTransform, transform_len};

use crate::ops::autodiff::Differentiable;
use crate::ops::backends::dispatch::operations;
use crate::ops::composed::head_transform::Heads;
use crate::ops::kernels::Kernels;

/// Queries, keys and values side by side.
pub(crate) const QUERY_KEY_VALUE: &[HeadTransform] = &[HeadTransform::Query, HeadTransform::Key, HeadTransform::Key];
/// Queries alone.
pub(crate) const QUERY: &[HeadTransform] = &[HeadTransform::Query];
/// Keys and values side by side.
pub(crate) const KEY_VALUE: &[HeadTransform] = &[HeadTransform::Key, HeadTransform::Key];
/// Output of attention.
pub(crate) const OUTPUT: &[HeadTransform] = &[HeadTransform::Output];

/// Transforms every head of tokens. Transforms are linear and have no gradient of their own.
///
/// # Shapes
/// - `x` and the result: `[batch, count, parts * dim]`
/// - `transforms`: `[batch, count, transform_len(dim / num_heads)]`
pub(crate) fn transform_heads(
    x: Tensor<3>,
    transforms: Tensor<3>,
    parts: &'static [HeadTransform],
    num_heads: usize,
) -> Tensor<3> {
    let [batch, count, width] = x.dims();
    assert_shape!(transforms, [batch, count, transform_len(width / parts.len() / num_heads)]);
    Tensor::from_dispatch(<Dispatch as HeadTransformOps>::transform_heads(
        x.into_dispatch(),
        transforms.into_dispatch(),
        Heads { parts, num_heads },
    ))
}

operations! {
    /// The operation of [`transform_heads`] on a backend.
    pub trait HeadTransformOps {
        fn transform_heads(x, transforms; heads: Heads) = heads;
    }
}

impl<B: Kernels> Differentiable<B, 2> for Heads {
    /// Transforms.
    type Saved = FloatTensor<B>;

    fn forward(&self, [x, transforms]: [FloatTensor<B>; 2]) -> FloatTensor<B> {
        B::head_transform(x, transforms, *self, false)
    }

    fn forward_saving(&self, [x, transforms]: [FloatTensor<B>; 2]) -> (FloatTensor<B>, Self::Saved) {
        (B::head_transform(x, transforms.clone(), *self, false), transforms)
    }

    fn gradients(
        &self,
        transforms: Self::Saved,
        grad_output: FloatTensor<B>,
        _needed: [bool; 2],
    ) -> [Option<FloatTensor<B>>; 2] {
        [Some(B::head_transform(grad_output, transforms, *self, true)), None]
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::testing::{check_gradients, check_native, devices, random};

    const CASES: [(&[HeadTransform], usize, usize); 4] =
        [(QUERY_KEY_VALUE, 2, 8), (QUERY, 1, 16), (KEY_VALUE, 3, 32), (OUTPUT, 2, 24)];

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in devices() {
            for (parts, num_heads, head_width) in CASES {
                let transforms = random([2, 3, transform_len(head_width)], 1, &device);
                let x = random([2, 3, parts.len() * num_heads * head_width], 2, &device);
                check_gradients([x], |[x]| transform_heads(x, transforms.clone(), parts, num_heads), 1e-6);
            }
        }
    }

    #[test]
    fn native_kernels_equal_the_composed_operation() {
        let device = Device::flex();
        for (parts, num_heads, head_width) in CASES {
            let x = random([2, 70, parts.len() * num_heads * head_width], 2, &device);
            let cotangent = random(x.dims(), 3, &device);
            let transforms = random([2, 70, transform_len(head_width)], 1, &device);
            let transform = |[x]: [Tensor<3>; 1]| {
                let transforms = transforms.clone().cast(x.dtype());
                transform_heads(x, transforms, parts, num_heads)
            };
            check_native([x], cotangent, transform, 1e-6);
        }
    }
}
