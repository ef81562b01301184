//! The transform of heads by the camera and the patch of every token, on any backend.
// B scenes, N tokens, P parts of a row, H heads, E width of a head

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::Shape;
use clift_kernels::{HeadTransform, transform_len};

use crate::ops::composed::primitives::narrow;

/// Transforms the heads of `x: [B, N, P H E]` by `transforms: [B, N, transform_len(E)]`.
pub(crate) fn transform<B: Backend>(
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
        let x = narrow::<B>(&x, 1, part * num_heads..(part + 1) * num_heads); // [BN, H, E]

        let first = if kind.inverse { 16 } else { 0 };
        let matrix = B::float_reshape(narrow::<B>(&transforms, 2, first..first + 16), Shape::new([tokens, 4, 4]));
        let matrix = if kind.transposed { B::float_swap_dims(matrix, 1, 2) } else { matrix };
        let vectors = B::float_reshape(narrow::<B>(&x, 2, 0..half), Shape::new([tokens, num_heads, 4, half / 4]));
        let vectors =
            B::float_reshape(B::float_permute(vectors, &[0, 2, 1, 3]), Shape::new([tokens, 4, num_heads * half / 4]));
        let vectors = B::float_matmul(matrix, vectors); // [BN, 4, H E / 8]
        let vectors = B::float_reshape(vectors, Shape::new([tokens, 4, num_heads, half / 4]));
        let vectors = B::float_reshape(B::float_permute(vectors, &[0, 2, 1, 3]), Shape::new([tokens, num_heads, half]));

        let cosine = narrow::<B>(&transforms, 2, 32..32 + quarter); // [BN, 1, E / 4]
        let sine = B::float_mul_scalar(narrow::<B>(&transforms, 2, 32 + quarter..32 + 2 * quarter), kind.sign().into());
        let (a, b) = (narrow::<B>(&x, 2, half..half + quarter), narrow::<B>(&x, 2, half + quarter..head_width));
        let product = |x: &FloatTensor<B>, factor: &FloatTensor<B>| B::float_mul(x.clone(), factor.clone());
        let first = B::float_sub(product(&a, &cosine), product(&b, &sine));
        let second = B::float_add(product(&a, &sine), product(&b, &cosine));
        B::float_cat(vec![vectors, first, second], 2)
    });
    B::float_reshape(B::float_cat(outputs.collect(), 1), shape)
}
