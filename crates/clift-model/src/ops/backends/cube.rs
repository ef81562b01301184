//! GPUs through `CubeCL`, by the kernels of `clift-cube` in f32 and, on adapters with cooperative matrices, f16.

use burn::backend::tensor::FloatTensor;
use burn::backend::{Cube, TensorMetadata};
use burn::tensor::DType;
use clift_cube as native;
use clift_cube::{
    AdapterClass, AttentionInputs, AttentionResults, AttentionSizes, Buffer, ClusterSizes, NormHeads, PartTransform,
};
use clift_cube::{Matrices, Product, Values};
use clift_kernels::HeadRows;

use crate::ops::backends::cube_buffers::{MatrixBuffer, buffer, is_native, is_operand, tensor};
use crate::ops::composed::attention::{AttentionOutput, Qkv};
use crate::ops::composed::cluster_attention::ClusterInputs;
use crate::ops::composed::head_transform::Heads;
use crate::ops::composed::norms::{EPSILON, LayerNormInputs};
use crate::ops::composed::{
    attention, cluster_attention, convolution, gelu, head_transform, linear, norms, primitives,
};
use crate::ops::kernels::{HeadConfig, Kernels, SavedQkv, SavedTensor, matmul_in};
use crate::ops::precision::Precision;

/// Most channels of a head that the kernels of attention accept.
const MAX_HEAD_WIDTH: usize = 128;

impl Kernels for Cube {
    fn matmul(precision: Precision, lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        let (lhs_shape, rhs_shape) = (lhs.shape(), rhs.shape());
        let last = lhs_shape.num_dims() - 1;
        let is_same_batch = rhs_shape.num_dims() == last + 1 && (0..last - 1).all(|i| lhs_shape[i] == rhs_shape[i]);
        let is_read = |x| if precision == Precision::F16 { is_operand(x) } else { is_native(x) };
        if !is_read(&lhs) || !is_read(&rhs) || !is_same_batch {
            return primitives::matmul::<Self>(lhs, rhs);
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
    fn save(precision: Precision, x: FloatTensor<Self>) -> SavedTensor<FloatTensor<Self>> {
        if precision != Precision::F16 || !is_native(&x) || !has_matrices(&x) {
            return SavedTensor::whole(x);
        }
        let half = native::cast(&x.client, &buffer(x.clone()), Values::F16);
        SavedTensor::whole(tensor(&x, half, x.shape()))
    }

    fn linear_forward(precision: Precision, inputs: [FloatTensor<Self>; 3]) -> FloatTensor<Self> {
        if !inputs.iter().all(is_native) {
            return linear::forward::<Self>(inputs, matmul_in::<Self>(precision));
        }
        let [x, weight, bias] = inputs;
        let [batch, count, width] = x.shape().dims();
        let [_, outputs] = weight.shape().dims();
        let like = x.clone();
        let x = primitives::rows::<Self>(x);
        let ([x, weight], bias) = ([x, weight].map(MatrixBuffer::new), buffer(bias));
        let sizes = [batch * count, outputs, width];
        let product = Product::new(x.view(), weight.view(), sizes);
        let product = Product { operands: operands(precision), bias: Some(&bias), ..product };
        tensor(&like, product.run(&like.client), [batch, count, outputs])
    }

    fn sum_rows(x: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return primitives::sum_rows::<Self>(x);
        }
        let [_, _, outputs] = x.shape().dims();
        let sums = native::sum_rows(&x.client, &buffer(x.clone()), outputs);
        tensor(&x, sums, [outputs])
    }

    /// The result has the type of `x`.
    fn exact_gelu_forward(x: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_operand(&x) {
            return gelu::forward::<Self>(x);
        }
        let values = buffer(x.clone());
        let output = native::gelu_forward(&x.client, &values, values.values);
        tensor(&x, output, x.shape())
    }

    fn exact_gelu_backward(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_operand(&x) || !is_native(&grad) {
            return gelu::backward::<Self>(x, grad);
        }
        let output = native::gelu_backward(&x.client, &buffer(x.clone()), &buffer(grad));
        tensor(&x, output, x.shape())
    }

    fn layer_norm_forward(inputs: [FloatTensor<Self>; 3]) -> (FloatTensor<Self>, Option<FloatTensor<Self>>) {
        if !inputs.iter().all(is_native) {
            return (norms::layer_norm_forward::<Self>(inputs), None);
        }
        let like = inputs[0].clone();
        let [batch, count, _] = like.shape().dims();
        let inputs = inputs.map(buffer);
        let results = native::layer_norm_forward(&like.client, inputs.each_ref(), EPSILON as f32, Values::F32);
        let [output, statistics] = results;
        (tensor(&like, output, like.shape()), Some(tensor(&like, statistics, [batch * count, 2])))
    }

    fn layer_norm_backward(
        norm: LayerNormInputs<FloatTensor<Self>>,
        grad: FloatTensor<Self>,
    ) -> [FloatTensor<Self>; 3] {
        let Some(statistics) = norm.statistics.clone().filter(|_| is_native(&grad)) else {
            return norms::layer_norm_backward::<Self>(norm, grad);
        };
        let like = norm.x.clone();
        let dim = norm.gamma.shape();
        let inputs = [norm.x, norm.gamma, statistics].map(buffer);
        let grads = native::layer_norm_backward(&like.client, inputs.each_ref(), &buffer(grad));
        let [grad_x, grad_gamma, grad_beta] = grads;
        [tensor(&like, grad_x, like.shape()), tensor(&like, grad_gamma, dim.clone()), tensor(&like, grad_beta, dim)]
    }

    fn rms_norm_forward([x, gammas]: [FloatTensor<Self>; 2], rows: HeadRows) -> FloatTensor<Self> {
        if !is_native(&x) || !is_native(&gammas) {
            return norms::rms_norm_forward::<Self>([x, gammas], rows);
        }
        let like = x.clone();
        let inputs = [x, gammas].map(buffer);
        tensor(&like, native::rms_norm_forward(&like.client, inputs.each_ref(), norm_heads(rows)), like.shape())
    }

    fn rms_norm_backward(
        [x, gammas]: [FloatTensor<Self>; 2],
        grad: FloatTensor<Self>,
        rows: HeadRows,
    ) -> [FloatTensor<Self>; 2] {
        if !is_native(&x) || !is_native(&gammas) || !is_native(&grad) {
            return norms::rms_norm_backward::<Self>([x, gammas], grad, rows);
        }
        let (like, gammas_shape) = (x.clone(), gammas.shape());
        let inputs = [x, gammas].map(buffer);
        let grads = native::rms_norm_backward(&like.client, inputs.each_ref(), &buffer(grad), norm_heads(rows));
        let [grad_x, grad_gammas] = grads;
        [tensor(&like, grad_x, like.shape()), tensor(&like, grad_gammas, gammas_shape)]
    }

    fn attention_forward(inputs: &Qkv<FloatTensor<Self>>, heads: HeadConfig) -> AttentionOutput<FloatTensor<Self>> {
        let Some(sizes) = native_sizes(inputs, heads) else {
            return attention::forward::<Self>(inputs, heads.num_heads, matmul_in::<Self>(heads.precision));
        };
        let like = like(inputs);
        let AttentionSizes { batch, num_heads, num_queries, head_width, .. } = sizes;
        let inputs = inputs.clone().map(buffer);
        let [output, log_sum] = native::attention_forward(&like.client, sizes, &rows(&inputs, num_heads * head_width));
        let output = tensor(&like, output, [batch, num_queries, num_heads * head_width]);
        AttentionOutput { output, log_sum: Some(tensor(&like, log_sum, [batch, num_heads, num_queries])) }
    }

    /// Both passes read one copy of the inputs in f16.
    fn attention_forward_saving(
        inputs: Qkv<FloatTensor<Self>>,
        heads: HeadConfig,
    ) -> (AttentionOutput<FloatTensor<Self>>, SavedQkv<FloatTensor<Self>>) {
        let precision = if native_sizes(&inputs, heads).is_some() { heads.precision } else { Precision::F32 };
        let saved = inputs.map(|x| Self::save(precision, x));
        (Self::attention_forward(&saved.clone().map(Self::restore), heads), saved)
    }

    fn attention_backward(
        inputs: Qkv<FloatTensor<Self>>,
        results: AttentionOutput<FloatTensor<Self>>,
        heads: HeadConfig,
        grad_output: FloatTensor<Self>,
    ) -> Qkv<FloatTensor<Self>> {
        let sizes = native_sizes(&inputs, heads).filter(|_| is_native(&grad_output));
        let (Some(log_sum), Some(sizes)) = (results.log_sum, sizes) else {
            let matmul = matmul_in::<Self>(heads.precision);
            return attention::backward::<Self>(&inputs, results.output, heads.num_heads, grad_output, matmul);
        };
        let like = like(&inputs);
        let shapes = inputs.clone().map(|x| x.shape());
        let dim = sizes.num_heads * sizes.head_width;
        let inputs = inputs.map(buffer);
        let grads = shapes.clone().map(|shape| Buffer::empty(&like.client, shape.num_elements(), Values::F32));
        let [output, log_sum, grad_output] = [results.output, log_sum, grad_output].map(buffer);
        let results = AttentionResults { output: &output, log_sum: &log_sum, grad_output: &grad_output };
        native::attention_backward(&like.client, sizes, &rows(&inputs, dim), results, &rows(&grads, dim));
        match (grads, shapes) {
            (Qkv::Packed(grad), Qkv::Packed(shape)) => Qkv::Packed(tensor(&like, grad, shape)),
            (Qkv::Separate { query, key_value }, Qkv::Separate { query: query_shape, key_value: shape }) => {
                let query = tensor(&like, query, query_shape);
                Qkv::Separate { query, key_value: tensor(&like, key_value, shape) }
            }
            _ => unreachable!("gradients have the layout of the inputs"),
        }
    }

    fn cluster_attention_forward(inputs: &ClusterInputs<Self>) -> [FloatTensor<Self>; 2] {
        let Some(sizes) = cluster_sizes(inputs) else {
            return cluster_attention::forward::<Self>(inputs);
        };
        let like = inputs.query.clone();
        let rows = [&inputs.query, &inputs.key_value, &inputs.segment].map(|x| buffer(x.clone()));
        let [output, weights] = native::cluster_attention_forward(&like.client, sizes, rows.each_ref());
        let weights_shape = [sizes.batch * sizes.num_members, sizes.num_heads, 1];
        [tensor(&like, output, like.shape()), tensor(&like, weights, weights_shape)]
    }

    fn cluster_attention_backward(
        inputs: ClusterInputs<Self>,
        results: [FloatTensor<Self>; 2],
        grad_output: FloatTensor<Self>,
    ) -> [FloatTensor<Self>; 2] {
        let Some(sizes) = cluster_sizes(&inputs).filter(|_| is_native(&grad_output)) else {
            return cluster_attention::backward::<Self>(inputs, results, grad_output);
        };
        let (query, key_value) = (inputs.query.clone(), inputs.key_value.clone());
        let rows = [inputs.query, inputs.key_value, inputs.segment].map(buffer);
        let (results, grad_output) = (results.map(buffer), buffer(grad_output));
        let [grad_query, grad_members] =
            native::cluster_attention_backward(&query.client, sizes, rows.each_ref(), results.each_ref(), &grad_output);
        [tensor(&query, grad_query, query.shape()), tensor(&query, grad_members, key_value.shape())]
    }

    fn head_transform(
        x: FloatTensor<Self>,
        transforms: FloatTensor<Self>,
        heads: Heads,
        is_gradient: bool,
    ) -> FloatTensor<Self> {
        if !is_native(&x) || !is_native(&transforms) {
            return head_transform::transform::<Self>(&x, &transforms, heads, is_gradient);
        }
        let part = |kind: &clift_kernels::HeadTransform| PartTransform {
            inverse: kind.is_inverse(),
            transposed: kind.is_transposed(),
            negative: kind.sign() < 0.0,
        };
        let parts: Vec<_> = heads.kinds(is_gradient).iter().map(part).collect();
        let [_, _, width] = x.shape().dims();
        let sizes = [heads.num_heads, width / parts.len() / heads.num_heads];
        let output = native::transform_heads(&x.client, &parts, sizes, &buffer(transforms), &buffer(x.clone()));
        tensor(&x, output, x.shape())
    }

    fn convolution(x: FloatTensor<Self>, weight: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self> {
        match images_at_once(&x).filter(|_| is_native(&weight) && is_native(&bias)) {
            Some(images) => convolve(&x, images, primitives::permute::<Self>(weight, [2, 3, 1, 0]), Some(bias)),
            None => convolution::forward::<Self>(x, weight, bias),
        }
    }

    fn convolution_backward(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        grad: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        match images_at_once(&grad).filter(|_| is_native(&weight)) {
            Some(images) => convolve(&grad, images, convolution::weight_of_gradient::<Self>(weight), None),
            None => convolution::backward::<Self>(x, weight, grad),
        }
    }
}

/// Most bytes of the windows of im2col.
const MAX_WINDOWS: u64 = 1 << 30;

/// Returns how many of the images `[B, C, H, W]` fit in [`MAX_WINDOWS`]; `None` if none does or the kernel does not accept
/// them.
fn images_at_once(x: &FloatTensor<Cube>) -> Option<usize> {
    let limit = MAX_WINDOWS.min(x.client.properties().memory.max_page_size);
    let [batch, channels, height, width] = x.shape().dims();
    let images = limit as usize / (4 * native::KERNEL_LEN * channels * height * width).max(1);
    (is_native(x) && images > 0).then_some(images.min(batch))
}

/// Convolves images `[B, I, H, W]` by `weight: [3, 3, I, O]`, some images at a time. The values of a pixel lie side by side in
/// the result.
fn convolve(
    x: &FloatTensor<Cube>,
    images: usize,
    weight: FloatTensor<Cube>,
    bias: Option<FloatTensor<Cube>>,
) -> FloatTensor<Cube> {
    let [batch, inputs, height, width] = x.shape().dims();
    let [_, _, _, outputs] = weight.shape().dims();
    let (weight, bias) = (buffer(weight), bias.map(buffer));
    let x = primitives::permute::<Cube>(x.clone(), [0, 2, 3, 1]);
    let parts = (0..batch).step_by(images).map(|first| {
        let count = images.min(batch - first);
        let part = primitives::narrow::<Cube>(&x, 0, first..first + count);
        let sizes = [count, height, width, inputs];
        let weight = Matrices::contiguous(&weight, outputs);
        let output = native::convolve(&part.client, &buffer(part.clone()), sizes, weight, outputs, bias.as_ref());
        tensor(&part, output, [count, height, width, outputs])
    });
    let mut parts: Vec<_> = parts.collect();
    let output = if parts.len() == 1 { parts.remove(0) } else { primitives::cat::<Cube>(parts) };
    primitives::permute::<Cube>(output, [0, 3, 1, 2])
}

fn has_matrices(x: &FloatTensor<Cube>) -> bool {
    matches!(AdapterClass::of(&x.client), AdapterClass::Matrices(_))
}

/// Returns the type of operands. Adapters do not have bf16.
fn operands(precision: Precision) -> Values {
    if precision == Precision::F16 { Values::F16 } else { Values::F32 }
}

fn norm_heads(HeadRows { num_parts, num_heads, head_width, epsilon }: HeadRows) -> NormHeads {
    NormHeads { num_parts, num_heads, head_width, epsilon: epsilon as f32 }
}

fn like(inputs: &Qkv<FloatTensor<Cube>>) -> FloatTensor<Cube> {
    match inputs {
        Qkv::Packed(x) | Qkv::Separate { query: x, .. } => x.clone(),
    }
}

/// Returns the sizes of an attention that the kernels accept.
fn native_sizes(inputs: &Qkv<FloatTensor<Cube>>, heads: HeadConfig) -> Option<AttentionSizes> {
    let (query, key_value, parts) = match inputs {
        Qkv::Packed(packed) => (packed, packed, 3),
        Qkv::Separate { query, key_value } => (query, key_value, 1),
    };
    let [batch, num_queries, width] = query.shape().dims();
    let [_, num_keys, _] = key_value.shape().dims();
    let head_width = width / parts / heads.num_heads;
    let operands = operands(heads.precision);
    let is_accepted = is_operand(query) && is_operand(key_value) && head_width <= MAX_HEAD_WIDTH;
    let num_heads = heads.num_heads;
    is_accepted.then_some(AttentionSizes { batch, num_heads, num_queries, num_keys, head_width, operands })
}

/// Returns the rows of queries, keys and values.
fn rows(inputs: &Qkv<Buffer>, dim: usize) -> AttentionInputs<'_> {
    let columns =
        |buffer, part: usize, parts: usize| native::HeadRows { buffer, column: part * dim, stride: parts * dim };
    match inputs {
        Qkv::Packed(x) => AttentionInputs { query: columns(x, 0, 3), key: columns(x, 1, 3), value: columns(x, 2, 3) },
        Qkv::Separate { query, key_value } => AttentionInputs {
            query: columns(query, 0, 1),
            key: columns(key_value, 0, 2),
            value: columns(key_value, 1, 2),
        },
    }
}

/// Returns the sizes of an attention inside clusters that the kernels accept.
fn cluster_sizes(inputs: &ClusterInputs<Cube>) -> Option<ClusterSizes> {
    let [batch, num_segments, dim] = inputs.query.shape().dims();
    let [_, num_members, _] = inputs.key_value.shape().dims();
    let (num_heads, head_width) = (inputs.num_heads, dim / inputs.num_heads);
    let is_accepted = is_native(&inputs.query)
        && is_native(&inputs.key_value)
        && inputs.segment.dtype == DType::I32
        && head_width <= MAX_HEAD_WIDTH;
    is_accepted.then_some(ClusterSizes { batch, num_segments, num_members, num_heads, head_width })
}
