//! GPUs through `CubeCL`, by the kernels of `clift-cube` in f32 and, on adapters with cooperative matrices, f16.

use burn::backend::ops::FloatTensorOps;
use burn::backend::{Cube, TensorMetadata};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use clift_cube as native;
use clift_cube::{
    AdapterClass, AttentionGradients, AttentionSizes, Buffer, ClusterSizes, Matrices, NormHeads, PartTransform,
    Product, Values,
};
use clift_kernels::{HeadRows, HeadTransform};

use crate::ops::backends::cube_buffers::{MatrixBuffer, buffer, is_native, is_operand, tensor};
use crate::ops::composed::attention::parts;
use crate::ops::composed::cluster_attention::Clusters;
use crate::ops::composed::layers::EPSILON;
use crate::ops::composed::{attention, cluster_attention, layers, primitives};
use crate::ops::kernels::{AttentionResults, HeadConfig, Kernels, SavedTensor, matmul_in};
use crate::ops::precision::Precision;

/// Most channels of a head that the kernels of attention accept.
const MAX_HEAD_WIDTH: usize = 128;

/// All tensors are f32, and the inputs of GELU and attention also copies in f16 that `save` made.
impl Kernels for Cube {
    fn matmul(precision: Precision, lhs: CubeTensor, rhs: CubeTensor) -> CubeTensor {
        let (lhs_shape, rhs_shape) = (lhs.shape(), rhs.shape());
        let last = lhs_shape.num_dims() - 1;
        let is_same_batch = rhs_shape.num_dims() == last + 1 && (0..last - 1).all(|i| lhs_shape[i] == rhs_shape[i]);
        let is_read = |x| if precision == Precision::F16 { is_operand(x) } else { is_native(x) };
        if !is_read(&lhs) || !is_read(&rhs) || !is_same_batch {
            return Self::float_matmul(lhs, rhs);
        }
        let mut shape = lhs_shape.clone();
        shape[last] = rhs_shape[last];
        let like = lhs.clone();
        let [lhs, rhs] = [lhs, rhs].map(MatrixBuffer::new);
        let sizes = [lhs_shape[last - 1], rhs_shape[last], lhs_shape[last]];
        let batch = (0..last - 1).map(|i| lhs_shape[i]).product();
        let product = Product { batch, operands: operands(precision), ..Product::new(lhs.view(), rhs.view(), sizes) };
        tensor(&like, product.run(&like.client), shape)
    }

    /// Copies a tensor to f16 in f16, where kernels round their operands to it.
    fn save(precision: Precision, x: CubeTensor) -> SavedTensor<CubeTensor> {
        let has_matrices = |x: &CubeTensor| matches!(AdapterClass::of(&x.client), AdapterClass::Matrices(_));
        if precision != Precision::F16 || !is_native(&x) || !has_matrices(&x) {
            return SavedTensor::whole(x);
        }
        let half = native::cast(&x.client, &buffer(x.clone()), Values::F16);
        SavedTensor::whole(tensor(&x, half, x.shape()))
    }

    fn linear_forward(precision: Precision, [x, weight, bias]: [CubeTensor; 3]) -> CubeTensor {
        let [batch, count, width] = x.shape().dims();
        let [_, outputs] = weight.shape().dims();
        let like = x.clone();
        let x = primitives::rows::<Self>(x);
        let ([x, weight], bias) = ([x, weight].map(MatrixBuffer::new), buffer(bias));
        let product = Product::new(x.view(), weight.view(), [batch * count, outputs, width]);
        let product = Product { operands: operands(precision), bias: Some(&bias), ..product };
        tensor(&like, product.run(&like.client), [batch, count, outputs])
    }

    fn sum_rows(x: CubeTensor) -> CubeTensor {
        let [_, _, outputs] = x.shape().dims();
        let sums = native::sum_rows(&x.client, &buffer(x.clone()), outputs);
        tensor(&x, sums, [outputs])
    }

    /// The result has the type of `x`.
    fn exact_gelu_forward(x: CubeTensor) -> CubeTensor {
        let values = buffer(x.clone());
        let output = native::gelu_forward(&x.client, &values, values.values);
        tensor(&x, output, x.shape())
    }

    fn exact_gelu_backward(x: CubeTensor, grad: CubeTensor) -> CubeTensor {
        let output = native::gelu_backward(&x.client, &buffer(x.clone()), &buffer(grad));
        tensor(&x, output, x.shape())
    }

    fn layer_norm_forward(inputs: [CubeTensor; 3]) -> (CubeTensor, Option<CubeTensor>) {
        let like = inputs[0].clone();
        let [batch, count, _] = like.shape().dims();
        let inputs = inputs.map(buffer);
        let results = native::layer_norm_forward(&like.client, inputs.each_ref(), EPSILON as f32, Values::F32);
        let [output, statistics] = results;
        (tensor(&like, output, like.shape()), Some(tensor(&like, statistics, [batch * count, 2])))
    }

    fn layer_norm_backward([x, gamma, grad]: [CubeTensor; 3], statistics: Option<CubeTensor>) -> [CubeTensor; 3] {
        let (like, dim) = (x.clone(), gamma.shape());
        let inputs = [x, gamma, statistics.expect("the forward pass has them")].map(buffer);
        let grads = native::layer_norm_backward(&like.client, inputs.each_ref(), &buffer(grad));
        let [grad_x, grad_gamma, grad_beta] = grads;
        [tensor(&like, grad_x, like.shape()), tensor(&like, grad_gamma, dim.clone()), tensor(&like, grad_beta, dim)]
    }

    fn rms_norm_forward([x, gammas]: [CubeTensor; 2], rows: HeadRows) -> CubeTensor {
        let like = x.clone();
        let inputs = [x, gammas].map(buffer);
        tensor(&like, native::rms_norm_forward(&like.client, inputs.each_ref(), norm_heads(rows)), like.shape())
    }

    fn rms_norm_backward([x, gammas, grad]: [CubeTensor; 3], rows: HeadRows) -> [CubeTensor; 2] {
        let (like, gammas_shape) = (x.clone(), gammas.shape());
        let inputs = [x, gammas].map(buffer);
        let grads = native::rms_norm_backward(&like.client, inputs.each_ref(), &buffer(grad), norm_heads(rows));
        let [grad_x, grad_gammas] = grads;
        [tensor(&like, grad_x, like.shape()), tensor(&like, grad_gammas, gammas_shape)]
    }

    fn attention_forward<const N: usize>(inputs: &[CubeTensor; N], heads: HeadConfig) -> AttentionResults<CubeTensor> {
        let Some(sizes) = native_sizes(inputs, heads) else {
            return (attention::forward::<Self, N>(inputs, heads.num_heads, matmul_in::<Self>(heads.precision)), None);
        };
        let like = &inputs[0];
        let AttentionSizes { batch, num_heads, num_queries, head_width, .. } = sizes;
        let buffers = inputs.clone().map(buffer);
        let [output, log_sum] = native::attention_forward(&like.client, sizes, rows(&buffers, num_heads * head_width));
        let output = tensor(like, output, [batch, num_queries, num_heads * head_width]);
        (output, Some(tensor(like, log_sum, [batch, num_heads, num_queries])))
    }

    /// Both passes read one copy of the inputs in f16.
    fn attention_forward_saving<const N: usize>(
        inputs: [CubeTensor; N],
        heads: HeadConfig,
    ) -> (AttentionResults<CubeTensor>, [SavedTensor<CubeTensor>; N]) {
        let precision = if native_sizes(&inputs, heads).is_some() { heads.precision } else { Precision::F32 };
        let saved = inputs.map(|x| Self::save(precision, x));
        (Self::attention_forward(&saved.clone().map(Self::restore), heads), saved)
    }

    fn attention_backward<const N: usize>(
        inputs: [CubeTensor; N],
        (output, log_sum): AttentionResults<CubeTensor>,
        heads: HeadConfig,
        grad_output: CubeTensor,
    ) -> [CubeTensor; N] {
        let (Some(log_sum), Some(sizes)) = (log_sum, native_sizes(&inputs, heads)) else {
            let matmul = matmul_in::<Self>(heads.precision);
            return attention::backward::<Self, N>(&inputs, output, heads.num_heads, grad_output, matmul);
        };
        let like = inputs[0].clone();
        let dim = sizes.num_heads * sizes.head_width;
        let shapes = inputs.each_ref().map(TensorMetadata::shape);
        let inputs = inputs.map(buffer);
        let grads = inputs.each_ref().map(|x| Buffer::empty(&like.client, x.len, Values::F32));
        let [output, log_sum, grad_output] = [output, log_sum, grad_output].map(buffer);
        let (results, all) = ([&output, &log_sum, &grad_output], AttentionGradients::All);
        native::attention_backward(&like.client, sizes, rows(&inputs, dim), results, rows(&grads, dim), all);
        let mut grads = grads.into_iter();
        shapes.map(|shape| tensor(&like, grads.next().expect("a gradient per input"), shape))
    }

    fn cluster_attention_forward(inputs: [CubeTensor; 2], clusters: Clusters<CubeTensor>) -> [CubeTensor; 2] {
        let Some(sizes) = cluster_sizes(&inputs, &clusters) else {
            return cluster_attention::forward::<Self>(inputs, clusters);
        };
        let [query, key_value] = inputs;
        let like = query.clone();
        let rows = [query, key_value, clusters.segment].map(buffer);
        let [output, weights] = native::cluster_attention_forward(&like.client, sizes, rows.each_ref());
        let weights_shape = [sizes.batch * sizes.num_members, sizes.num_heads, 1];
        [tensor(&like, output, like.shape()), tensor(&like, weights, weights_shape)]
    }

    fn cluster_attention_backward(tensors: [CubeTensor; 5], clusters: Clusters<CubeTensor>) -> [CubeTensor; 2] {
        let [query, key_value, output, weights, grad_output] = tensors.clone();
        let like = [query.clone(), key_value.clone()];
        let Some(sizes) = cluster_sizes(&like, &clusters) else {
            return cluster_attention::backward::<Self>(tensors, clusters);
        };
        let rows = [query, key_value, clusters.segment].map(buffer);
        let (results, grad_output) = ([output, weights].map(buffer), buffer(grad_output));
        let client = &like[0].client;
        let [grad_query, grad_members] =
            native::cluster_attention_backward(client, sizes, rows.each_ref(), results.each_ref(), &grad_output);
        [tensor(&like[0], grad_query, like[0].shape()), tensor(&like[0], grad_members, like[1].shape())]
    }

    fn head_transform(x: CubeTensor, transforms: CubeTensor, parts: &[HeadTransform], num_heads: usize) -> CubeTensor {
        let part = |part: &HeadTransform| PartTransform {
            inverse: part.inverse,
            transposed: part.transposed,
            negative: part.sign() < 0.0,
        };
        let [_, _, width] = x.shape().dims();
        let sizes = [num_heads, width / parts.len() / num_heads];
        let parts: Vec<_> = parts.iter().map(part).collect();
        let output = native::transform_heads(&x.client, &parts, sizes, &buffer(transforms), &buffer(x.clone()));
        tensor(&x, output, x.shape())
    }

    fn convolution([x, weight, bias]: [CubeTensor; 3]) -> CubeTensor {
        match images_at_once(&x) {
            Some(images) => convolve(&x, images, Self::float_permute(weight, &[2, 3, 1, 0]), Some(bias)),
            None => layers::convolution::<Self>([x, weight, bias]),
        }
    }

    fn convolution_backward([x, weight, grad]: [CubeTensor; 3]) -> CubeTensor {
        let Some(images) = images_at_once(&grad) else {
            return layers::convolution_backward::<Self>([x, weight, grad]);
        };
        // `[3, 3, O, I]`: flipped along rows and columns, with inputs and outputs swapped.
        let weight = Self::float_permute(Self::float_flip(weight, &[2, 3]), &[2, 3, 0, 1]);
        convolve(&grad, images, weight, None)
    }
}

/// Most bytes of the windows of im2col.
const MAX_WINDOWS: u64 = 1 << 30;

/// Returns how many of the images `[B, C, H, W]` fit in [`MAX_WINDOWS`]; `None` if none does or the kernel does not accept
/// them.
fn images_at_once(x: &CubeTensor) -> Option<usize> {
    let limit = MAX_WINDOWS.min(x.client.properties().memory.max_page_size);
    let [batch, channels, height, width] = x.shape().dims();
    let images = limit as usize / (4 * native::KERNEL_LEN * channels * height * width).max(1);
    (is_native(x) && images > 0).then_some(images.min(batch))
}

/// Convolves images `[B, I, H, W]` by `weight: [3, 3, I, O]`, some images at a time. The values of a pixel lie side by side in
/// the result.
fn convolve(x: &CubeTensor, images: usize, weight: CubeTensor, bias: Option<CubeTensor>) -> CubeTensor {
    let [batch, inputs, height, width] = x.shape().dims();
    let [_, _, _, outputs] = weight.shape().dims();
    let (weight, bias) = (buffer(weight), bias.map(buffer));
    let x = Cube::float_permute(x.clone(), &[0, 2, 3, 1]);
    let parts = (0..batch).step_by(images).map(|first| {
        let count = images.min(batch - first);
        let part = primitives::narrow::<Cube>(&x, 0, first..first + count);
        let sizes = [count, height, width, inputs];
        let weight = Matrices::contiguous(&weight, outputs);
        let output = native::convolve(&part.client, &buffer(part.clone()), sizes, weight, outputs, bias.as_ref());
        tensor(&part, output, [count, height, width, outputs])
    });
    let mut parts: Vec<_> = parts.collect();
    let output = if parts.len() == 1 { parts.remove(0) } else { Cube::float_cat(parts, 0) };
    Cube::float_permute(output, &[0, 3, 1, 2])
}

/// Returns the type of operands. Adapters do not have bf16.
fn operands(precision: Precision) -> Values {
    if precision == Precision::F16 { Values::F16 } else { Values::F32 }
}

fn norm_heads(HeadRows { num_parts, num_heads, head_width, epsilon }: HeadRows) -> NormHeads {
    NormHeads { num_parts, num_heads, head_width, epsilon: epsilon as f32 }
}

/// Returns the sizes of an attention that the kernels accept.
fn native_sizes<const N: usize>(inputs: &[CubeTensor; N], heads: HeadConfig) -> Option<AttentionSizes> {
    let [batch, num_queries, width] = inputs[0].shape().dims();
    let [_, num_keys, _] = inputs[N - 1].shape().dims();
    let [[_, _, parts], ..] = parts::<N>();
    let HeadConfig { num_heads, precision } = heads;
    let head_width = width / parts / num_heads;
    let tiles = native::attention_tiles(&inputs[0].client, operands(precision), head_width);
    let is_accepted = inputs.iter().all(is_operand) && head_width <= MAX_HEAD_WIDTH;
    is_accepted.then_some(AttentionSizes { batch, num_heads, num_queries, num_keys, head_width, tiles })
}

fn rows<const N: usize>(inputs: &[Buffer; N], dim: usize) -> [native::HeadRows<'_>; 3] {
    parts::<N>().map(|[input, part, parts]| native::HeadRows {
        buffer: &inputs[input],
        column: part * dim,
        stride: parts * dim,
    })
}

/// Returns the sizes of an attention inside clusters that the kernels accept.
fn cluster_sizes([query, key_value]: &[CubeTensor; 2], clusters: &Clusters<CubeTensor>) -> Option<ClusterSizes> {
    let [batch, num_segments, dim] = query.shape().dims();
    let [_, num_members, _] = key_value.shape().dims();
    let (num_heads, head_width) = (clusters.num_heads, dim / clusters.num_heads);
    let is_accepted = clusters.segment.dtype == DType::I32 && head_width <= MAX_HEAD_WIDTH;
    is_accepted.then_some(ClusterSizes { batch, num_segments, num_members, num_heads, head_width })
}
