//! The transform of heads in camera-relative attention, by the camera and the patch of every token.

use burn::backend::Dispatch;
use burn::backend::tensor::FloatTensor;
use burn::tensor::{Tensor, assert_shape};
use clift_kernels::{HeadTransform, transform_len};

use crate::ops::autodiff::{Differentiable, InputGrads};
use crate::ops::backends::dispatch::operations;
use crate::ops::kernels::Kernels;

pub(crate) const QUERY_KEY_VALUE: &[HeadTransform] = &[HeadTransform::QUERY, HeadTransform::KEY, HeadTransform::KEY];
pub(crate) const QUERY: &[HeadTransform] = &[HeadTransform::QUERY];
pub(crate) const KEY_VALUE: &[HeadTransform] = &[HeadTransform::KEY, HeadTransform::KEY];
pub(crate) const OUTPUT: &[HeadTransform] = &[HeadTransform::OUTPUT];

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

/// Parts of a row with their transforms, and the number of heads of each part.
#[derive(Clone, Copy, Debug)]
pub struct Heads {
    parts: &'static [HeadTransform],
    num_heads: usize,
}

impl<B: Kernels> Differentiable<B, 2> for Heads {
    type Saved = FloatTensor<B>;

    fn forward_saving(&self, [x, transforms]: [FloatTensor<B>; 2]) -> (FloatTensor<B>, Self::Saved) {
        (B::head_transform(x, transforms.clone(), self.parts, self.num_heads), transforms)
    }

    fn gradients(&self, transforms: Self::Saved, grad: FloatTensor<B>, _: [bool; 2]) -> InputGrads<B, 2> {
        let parts: Vec<_> = self.parts.iter().map(|part| part.of_gradient()).collect();
        [Some(B::head_transform(grad, transforms, &parts, self.num_heads)), None]
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::testing::{check_gradients, check_native, devices, random};

    /// Parts with the number and width of their heads.
    const CASES: [(&[HeadTransform], usize, usize); 6] = [
        (QUERY_KEY_VALUE, 2, 8),
        (QUERY, 1, 16),
        (KEY_VALUE, 3, 32),
        (OUTPUT, 2, 64),
        (QUERY_KEY_VALUE, 2, 96),
        (OUTPUT, 1, 40),
    ];

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in devices() {
            for (parts, num_heads, head_width) in CASES.into_iter().take(4) {
                let transforms = random([2, 3, transform_len(head_width)], 1, &device);
                let x = random([2, 3, parts.len() * num_heads * head_width], 2, &device);
                check_gradients([x], |[x]| transform_heads(x, transforms.clone(), parts, num_heads), 1e-6);
            }
        }
    }

    #[test]
    fn native_kernels_equal_f64() {
        let device = Device::flex();
        for (parts, num_heads, head_width) in CASES {
            let x = random([2, 301, parts.len() * num_heads * head_width], 2, &device);
            let transforms = random([2, 301, transform_len(head_width)], 1, &device).cast(DType::F32);
            let transform = |[x]: [Tensor<3>; 1]| {
                let transforms = transforms.clone().cast(x.dtype());
                transform_heads(x, transforms, parts, num_heads)
            };
            check_native([x], transform, 1e-6);
        }
    }
}
