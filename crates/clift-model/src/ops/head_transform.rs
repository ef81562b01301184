//! The transform of heads in camera-relative attention, by the camera and the patch of every token.
// B scenes, N tokens, P parts of a row, H heads, E width of a head

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::tensor::{Shape, Slice, Tensor, assert_shape};
use clift_kernels::{HeadTransform, InstructionSet, transform_len};

use crate::ops::autodiff::register;
use crate::ops::flex::{contiguous, is_native, values, values_mut};

/// Queries, keys and values side by side.
pub(crate) const QUERY_KEY_VALUE: &[HeadTransform] = &[HeadTransform::Query, HeadTransform::Key, HeadTransform::Key];
/// Queries alone.
pub(crate) const QUERY: &[HeadTransform] = &[HeadTransform::Query];
/// Keys and values side by side.
pub(crate) const KEY_VALUE: &[HeadTransform] = &[HeadTransform::Key, HeadTransform::Key];
/// Output of attention.
pub(crate) const OUTPUT: &[HeadTransform] = &[HeadTransform::Output];

/// Parts of a row with their transforms, and the number of heads of each part.
#[derive(Clone, Copy, Debug)]
pub struct Heads {
    parts: &'static [HeadTransform],
    num_heads: usize,
}

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

/// The operation of [`transform_heads`] on a backend.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "wgpu"), Autodiff)]
pub trait HeadTransformOps: Backend {
    /// See [`transform_heads`].
    fn transform_heads(x: FloatTensor<Self>, transforms: FloatTensor<Self>, heads: Heads) -> FloatTensor<Self>;
}

/// The operation on a backend. The default implementation runs on every backend.
pub trait HeadTransformKernels: Backend {
    /// Transforms the heads of `x`, transposed for the gradient.
    fn transform(
        x: FloatTensor<Self>,
        transforms: FloatTensor<Self>,
        heads: Heads,
        is_gradient: bool,
    ) -> FloatTensor<Self> {
        composed::<Self>(&x, &transforms, &heads.kinds(is_gradient), heads.num_heads)
    }
}

impl Heads {
    fn kinds(self, is_gradient: bool) -> Vec<HeadTransform> {
        self.parts.iter().map(|kind| if is_gradient { kind.transposed() } else { *kind }).collect()
    }
}

fn composed<B: Backend>(
    x: &FloatTensor<B>,
    transforms: &FloatTensor<B>,
    parts: &[HeadTransform],
    num_heads: usize,
) -> FloatTensor<B> {
    let shape = x.shape();
    let [batch, count, width] = shape.dims();
    let tokens = batch * count;
    let part_width = width / parts.len();
    let head_width = part_width / num_heads;
    let (half, quarter) = (head_width / 2, head_width / 4);
    let x = B::float_reshape(x.clone(), Shape::new([tokens, parts.len() * num_heads, head_width]));
    let transforms = B::float_reshape(transforms.clone(), Shape::new([tokens, 1, transform_len(head_width)]));
    let outputs = parts.iter().enumerate().map(|(part, kind)| {
        let x = slice::<B>(&x, 1, part * num_heads, num_heads); // [BN, H, E]

        let first = if kind.is_inverse() { 16 } else { 0 };
        let matrix = B::float_reshape(slice::<B>(&transforms, 2, first, 16), Shape::new([tokens, 4, 4]));
        let matrix = if kind.is_transposed() { B::float_swap_dims(matrix, 1, 2) } else { matrix };
        let vectors = B::float_reshape(slice::<B>(&x, 2, 0, half), Shape::new([tokens, num_heads, 4, half / 4]));
        let vectors =
            B::float_reshape(B::float_permute(vectors, &[0, 2, 1, 3]), Shape::new([tokens, 4, num_heads * half / 4]));
        let vectors = B::float_matmul(matrix, vectors); // [BN, 4, H E / 8]
        let vectors = B::float_reshape(vectors, Shape::new([tokens, 4, num_heads, half / 4]));
        let vectors = B::float_reshape(B::float_permute(vectors, &[0, 2, 1, 3]), Shape::new([tokens, num_heads, half]));

        let cosine = slice::<B>(&transforms, 2, 32, quarter); // [BN, 1, E / 4]
        let sine = B::float_mul_scalar(slice::<B>(&transforms, 2, 32 + quarter, quarter), kind.sign().into());
        let (a, b) = (slice::<B>(&x, 2, half, quarter), slice::<B>(&x, 2, half + quarter, quarter));
        let product = |x: &FloatTensor<B>, factor: &FloatTensor<B>| B::float_mul(x.clone(), factor.clone());
        let first = B::float_sub(product(&a, &cosine), product(&b, &sine));
        let second = B::float_add(product(&a, &sine), product(&b, &cosine));
        B::float_cat(vec![vectors, first, second], 2)
    });
    B::float_reshape(B::float_cat(outputs.collect(), 1), shape)
}

/// Returns `len` entries of a dimension of `[a, b, c]`.
fn slice<B: Backend>(x: &FloatTensor<B>, dim: usize, start: usize, len: usize) -> FloatTensor<B> {
    let slices: Vec<Slice> =
        (0..3).map(|i| if i == dim { Slice::from(start..start + len) } else { Slice::from(0..x.shape()[i]) }).collect();
    B::float_slice(x.clone(), &slices)
}

impl HeadTransformKernels for Flex {
    fn transform(
        x: FloatTensor<Self>,
        transforms: FloatTensor<Self>,
        heads: Heads,
        is_gradient: bool,
    ) -> FloatTensor<Self> {
        let kinds = heads.kinds(is_gradient);
        if !is_native(&x) || !is_native(&transforms) {
            return composed::<Self>(&x, &transforms, &kinds, heads.num_heads);
        }
        let head_width = x.shape()[2] / kinds.len() / heads.num_heads;
        let mut x = contiguous(x);
        let transforms = contiguous(transforms);
        let sizes = [heads.num_heads, head_width];
        let set = InstructionSet::detected();
        clift_kernels::transform_heads(set, &kinds, sizes, values(&transforms), values_mut(&mut x));
        x
    }
}

#[cfg(feature = "ndarray")]
impl HeadTransformKernels for burn::backend::NdArray {}

#[cfg(feature = "wgpu")]
impl HeadTransformKernels for burn::backend::Cube {}

impl<B: HeadTransformKernels> HeadTransformOps for B {
    fn transform_heads(x: FloatTensor<Self>, transforms: FloatTensor<Self>, heads: Heads) -> FloatTensor<Self> {
        Self::transform(x, transforms, heads, false)
    }
}

impl<B: HeadTransformKernels, C: CheckpointStrategy> HeadTransformOps for Autodiff<B, C> {
    fn transform_heads(x: FloatTensor<Self>, transforms: FloatTensor<Self>, heads: Heads) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let (transforms, _) = transforms.into_parts();
        match TransformBackward.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let output = B::transform(x, transforms.clone(), heads, false);
                prep.finish((transforms, heads), output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::transform(x, transforms, heads, false)),
        }
    }
}

#[derive(Debug)]
struct TransformBackward;

impl<B: HeadTransformKernels> Backward<B, 1> for TransformBackward {
    type State = (FloatTensor<B>, Heads);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        register::<B, _, 1>(ops, grads, |(transforms, heads), grad_output, _| {
            [Some(B::transform(grad_output, transforms, heads, true))]
        });
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::testing::{check_gradients, check_native, cpu_devices, random};

    const CASES: [(&[HeadTransform], usize, usize); 4] =
        [(QUERY_KEY_VALUE, 2, 8), (QUERY, 1, 16), (KEY_VALUE, 3, 32), (OUTPUT, 2, 24)];

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in cpu_devices() {
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
