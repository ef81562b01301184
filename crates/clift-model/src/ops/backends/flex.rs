//! Burn's CPU backend, by the kernels of `clift-kernels` in f32 and bf16. f64 (in tests) and f16 take the composed operations.

use burn::backend::flex::{FlexTensor, Layout};
use burn::backend::{Flex, TensorMetadata};
use burn::tensor::{Bytes, DType, Shape};
use clift_kernels as native;
use clift_kernels::{
    AttentionSizes, ClusterSegments, HeadRows, HeadTransform, InstructionSet, Matrix, OperandType, StridedRows,
};

use crate::ops::composed::attention::parts;
use crate::ops::composed::cluster_attention::Clusters;
use crate::ops::composed::layers::EPSILON;
use crate::ops::composed::{attention, cluster_attention, head_transform, layers, primitives};
use crate::ops::kernels::{AttentionResults, HeadConfig, Kernels, SavedTensor, matmul_in};
use crate::ops::precision::Precision;

/// Returns the instruction set of the kernels; unit tests choose one.
fn set() -> InstructionSet {
    #[cfg(test)]
    if let Some(set) = crate::testing::INSTRUCTION_SET.get() {
        return set;
    }
    InstructionSet::detected()
}

impl Kernels for Flex {
    fn matmul_bf16(lhs: FlexTensor, rhs: FlexTensor) -> FlexTensor {
        let ([rows, inner], [_, columns]) = (lhs.shape().dims(), rhs.shape().dims());
        // Copied unless rows or columns are contiguous.
        let [lhs, rhs] = [lhs, rhs].map(|x| if is_transposed(&x) { x } else { contiguous(x) });
        let mut output = vec![0.0; rows * columns];
        native::matmul_bf16(set(), [rows, inner, columns], [matrix(&lhs), matrix(&rhs)], None, &mut output);
        tensor(output, [rows, columns])
    }

    // Not by Burn's cast, which converts value by value in one thread.
    fn save(precision: Precision, x: FlexTensor) -> SavedTensor<FlexTensor> {
        if precision != Precision::Bf16 || !is_native(&x) {
            return SavedTensor::whole(x);
        }
        let shape = x.shape();
        let len = shape.num_elements().div_ceil(2);
        let mut packed = vec![0.0; len];
        native::pack_bf16(set(), values(&contiguous(x)), &mut packed);
        SavedTensor { values: tensor(packed, [len]), packed: Some(shape) }
    }

    fn restore(saved: SavedTensor<FlexTensor>) -> FlexTensor {
        let Some(shape) = saved.packed else { return saved.values };
        let mut unpacked = vec![0.0; shape.num_elements()];
        native::unpack_bf16(values(&saved.values), &mut unpacked);
        tensor(unpacked, shape)
    }

    fn linear_forward(precision: Precision, inputs: [FlexTensor; 3]) -> FlexTensor {
        let [x, weight, _bias] = &inputs;
        let Some(operands) = precision.native_operands().filter(|_| is_native(x)) else {
            return layers::linear::<Self>(inputs, matmul_in::<Self>(precision));
        };
        let [batch, count, width] = x.shape().dims();
        let [_, outputs] = weight.shape().dims();
        let inputs = inputs.map(contiguous);
        let mut output = vec![0.0; batch * count * outputs];
        let sizes = [batch * count, width, outputs];
        let [x, weight, bias] = inputs.each_ref().map(values);
        match operands {
            OperandType::F32 => native::linear_forward(sizes, [x, weight, bias], &mut output),
            OperandType::Bf16 => {
                let factors = [x, weight].map(|values| Matrix { values, transposed: false });
                native::matmul_bf16(set(), sizes, factors, Some(bias), &mut output);
            }
        }
        tensor(output, [batch, count, outputs])
    }

    fn sum_rows(x: FlexTensor) -> FlexTensor {
        if !is_native(&x) {
            return primitives::sum_rows::<Self>(x);
        }
        let [_, _, outputs] = x.shape().dims();
        let mut sum = vec![0.0; outputs];
        native::sum_rows(set(), values(&contiguous(x)), &mut sum);
        tensor(sum, [outputs])
    }

    fn exact_gelu_forward(x: FlexTensor) -> FlexTensor {
        if !is_native(&x) {
            return layers::gelu_forward::<Self>(x);
        }
        let shape = x.shape();
        let mut to = vec![0.0; shape.num_elements()];
        native::gelu_forward(set(), values(&contiguous(x)), &mut to);
        tensor(to, shape)
    }

    fn exact_gelu_backward(x: FlexTensor, grad: FlexTensor) -> FlexTensor {
        if !is_native(&x) {
            return layers::gelu_backward::<Self>(x, grad);
        }
        let mut grad = contiguous(grad);
        native::gelu_backward(set(), values(&contiguous(x)), values_mut(&mut grad));
        grad
    }

    fn layer_norm_forward(inputs: [FlexTensor; 3]) -> (FlexTensor, Option<FlexTensor>) {
        if !is_native(&inputs[0]) {
            return (layers::layer_norm_forward::<Self>(inputs), None);
        }
        let [batch, count, dim] = inputs[0].shape().dims();
        let inputs = inputs.map(contiguous);
        let mut output = vec![0.0; batch * count * dim];
        let mut statistics = vec![0.0; batch * count * 2];
        let (pairs, _) = statistics.as_chunks_mut();
        native::layer_norm_forward(set(), EPSILON as f32, inputs.each_ref().map(values), &mut output, pairs);
        (tensor(output, [batch, count, dim]), Some(tensor(statistics, [batch * count, 2])))
    }

    fn layer_norm_backward(inputs: [FlexTensor; 3], statistics: Option<FlexTensor>) -> [FlexTensor; 3] {
        let Some(statistics) = statistics else {
            return layers::layer_norm_backward::<Self>(inputs);
        };
        let [batch, count, dim] = inputs[0].shape().dims();
        let inputs = inputs.map(contiguous);
        let mut grads = [batch * count * dim, dim, dim].map(|len| vec![0.0; len]);
        let (pairs, _) = values(&statistics).as_chunks();
        let to = grads.each_mut().map(|grad| &mut grad[..]);
        native::layer_norm_backward(set(), inputs.each_ref().map(values), pairs, to);
        let [grad_x, grad_gamma, grad_beta] = grads;
        [tensor(grad_x, [batch, count, dim]), tensor(grad_gamma, [dim]), tensor(grad_beta, [dim])]
    }

    fn rms_norm_forward([x, gammas]: [FlexTensor; 2], rows: HeadRows) -> FlexTensor {
        if !is_native(&x) || !is_native(&gammas) {
            return layers::rms_norm_forward::<Self>([x, gammas], rows);
        }
        let (mut x, gammas) = (contiguous(x), contiguous(gammas));
        native::rms_norm_forward(set(), rows, values(&gammas), values_mut(&mut x));
        x
    }

    fn rms_norm_backward(inputs: [FlexTensor; 3], rows: HeadRows) -> [FlexTensor; 2] {
        if !inputs.iter().all(is_native) {
            return layers::rms_norm_backward::<Self>(inputs, rows);
        }
        let [x, gammas, mut grad] = inputs.map(contiguous);
        let len = values(&gammas).len();
        let mut grad_gammas = vec![0.0; len];
        let inputs = [values(&x), values(&gammas)];
        native::rms_norm_backward(set(), rows, inputs, values_mut(&mut grad), &mut grad_gammas);
        [grad, tensor(grad_gammas, [len])]
    }

    fn attention_forward<const N: usize>(inputs: &[FlexTensor; N], heads: HeadConfig) -> AttentionResults<FlexTensor> {
        let HeadConfig { num_heads, precision } = heads;
        let Some(operands) = precision.native_operands().filter(|_| inputs.iter().all(is_native)) else {
            return (attention::forward::<Self, N>(inputs, num_heads, matmul_in::<Self>(precision)), None);
        };
        let inputs = inputs.clone().map(contiguous);
        let sizes = attention_sizes(&inputs, num_heads);
        let AttentionSizes { batch, num_queries, head_width, .. } = sizes;
        let dim = num_heads * head_width;
        let mut output = vec![0.0; batch * num_queries * dim];
        let mut log_sum = vec![0.0; batch * num_heads * num_queries];
        native::attention_forward(set(), operands, sizes, attention_rows(&inputs, dim), &mut output, &mut log_sum);
        let log_sum = tensor(log_sum, [batch, num_heads, num_queries]);
        (tensor(output, [batch, num_queries, dim]), Some(log_sum))
    }

    fn attention_backward<const N: usize>(
        inputs: [FlexTensor; N],
        (output, log_sum): AttentionResults<FlexTensor>,
        heads: HeadConfig,
        grad_output: FlexTensor,
    ) -> [FlexTensor; N] {
        let HeadConfig { num_heads, precision } = heads;
        let (Some(log_sum), Some(operands)) = (log_sum, precision.native_operands()) else {
            let matmul = matmul_in::<Self>(precision);
            return attention::backward::<Self, N>(&inputs, output, num_heads, grad_output, matmul);
        };
        let inputs = inputs.map(contiguous);
        let sizes = attention_sizes(&inputs, num_heads);
        let [query, key, value] = attention_rows(&inputs, num_heads * sizes.head_width);
        let [output, grad_output] = [output, grad_output].map(contiguous);
        let [output, grad_output] = [&output, &grad_output].map(|x| columns(x, 0));
        let rows = [query, key, value, output, grad_output];
        let mut grads = inputs.each_ref().map(|x| vec![0.0; x.shape().num_elements()]);
        let to = &mut grads.each_mut().map(|grad| &mut grad[..]);
        native::attention_backward(set(), operands, sizes, rows, values(&log_sum), to);
        let mut grads = grads.into_iter();
        inputs.each_ref().map(|x| tensor(grads.next().expect("a gradient per input"), x.shape()))
    }

    fn cluster_attention_forward(inputs: [FlexTensor; 2], clusters: Clusters<FlexTensor>) -> [FlexTensor; 2] {
        let Some(segments) = segments(&inputs[0], &clusters) else {
            return cluster_attention::forward::<Self>(inputs, clusters);
        };
        let shape = inputs[0].shape();
        let num_members = clusters.segment.shape()[0];
        let inputs = inputs.map(contiguous);
        let mut output = vec![0.0; shape.num_elements()];
        let mut weights = vec![0.0; num_members * clusters.num_heads];
        let rows = inputs.each_ref().map(values);
        native::cluster_attention_forward(set(), &segments, rows, &mut output, &mut weights);
        [tensor(output, shape), tensor(weights, [num_members, clusters.num_heads, 1])]
    }

    fn cluster_attention_backward(tensors: [FlexTensor; 5], clusters: Clusters<FlexTensor>) -> [FlexTensor; 2] {
        let Some(segments) = segments(&tensors[0], &clusters) else {
            return cluster_attention::backward::<Self>(tensors, clusters);
        };
        let [query, key_value, _output, weights, grad_output] = tensors;
        let tensors = [query, key_value, weights, grad_output].map(contiguous);
        let shapes = [tensors[0].shape(), tensors[1].shape()];
        let [mut grad_query, mut grad_members] = shapes.each_ref().map(|shape| vec![0.0; shape.num_elements()]);
        let to = [&mut grad_query[..], &mut grad_members[..]];
        native::cluster_attention_backward(set(), &segments, tensors.each_ref().map(values), to);
        let [query_shape, member_shape] = shapes;
        [tensor(grad_query, query_shape), tensor(grad_members, member_shape)]
    }

    fn head_transform(x: FlexTensor, transforms: FlexTensor, parts: &[HeadTransform], num_heads: usize) -> FlexTensor {
        if !is_native(&x) || !is_native(&transforms) {
            return head_transform::transform::<Self>(&x, &transforms, parts, num_heads);
        }
        let sizes = [num_heads, x.shape()[2] / parts.len() / num_heads];
        let (mut x, transforms) = (contiguous(x), contiguous(transforms));
        native::transform_heads(set(), parts, sizes, values(&transforms), values_mut(&mut x));
        x
    }
}

fn attention_sizes<const N: usize>(inputs: &[FlexTensor; N], num_heads: usize) -> AttentionSizes {
    let [batch, num_queries, width] = inputs[0].shape().dims();
    let [_, num_keys, _] = inputs[N - 1].shape().dims();
    let [[_, _, parts], ..] = parts::<N>();
    AttentionSizes { batch, num_queries, num_keys, num_heads, head_width: width / parts / num_heads }
}

/// Returns the rows of queries, keys and values.
fn attention_rows<const N: usize>(inputs: &[FlexTensor; N], dim: usize) -> [StridedRows<'_>; 3] {
    parts::<N>().map(|[input, part, _]| columns(&inputs[input], part * dim))
}

/// Returns the rows of a contiguous tensor, starting with column `first`.
fn columns(x: &FlexTensor, first: usize) -> StridedRows<'_> {
    let [_, count, width] = x.shape().dims();
    StridedRows { values: values(x).get(first..).unwrap_or_default(), batch_stride: count * width, row_stride: width }
}

/// Groups members by segment; `None` for tensors that the kernel does not accept.
fn segments(query: &FlexTensor, clusters: &Clusters<FlexTensor>) -> Option<ClusterSegments> {
    let [batch, num_segments, dim] = query.shape().dims();
    let sizes = [batch * num_segments, clusters.num_heads, dim / clusters.num_heads];
    let segment: FlexTensor = contiguous(clusters.segment.clone());
    let start = segment.layout().start_offset();
    let range = start..start + segment.layout().num_elements();
    match segment.dtype() {
        _ if !is_native(query) => None,
        DType::I64 => Some(ClusterSegments::new(sizes, segment.storage::<i64>()[range].iter().map(|&s| s as usize))),
        DType::I32 => Some(ClusterSegments::new(sizes, segment.storage::<i32>()[range].iter().map(|&s| s as usize))),
        _ => None,
    }
}

fn is_native(tensor: &FlexTensor) -> bool {
    tensor.dtype() == DType::F32
}

fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.is_contiguous() { tensor } else { tensor.to_contiguous() }
}

fn values(tensor: &FlexTensor) -> &[f32] {
    debug_assert!(tensor.is_contiguous(), "values of a contiguous tensor");
    let start = tensor.layout().start_offset();
    &tensor.storage::<f32>()[start..start + tensor.layout().num_elements()]
}

fn matrix(tensor: &FlexTensor) -> Matrix<'_> {
    let start = tensor.layout().start_offset();
    let values = &tensor.storage::<f32>()[start..start + tensor.layout().num_elements()];
    Matrix { values, transposed: is_transposed(tensor) }
}

fn is_transposed(tensor: &FlexTensor) -> bool {
    let [rows, _columns] = tensor.shape().dims();
    !tensor.is_contiguous() && *tensor.layout().strides() == [1, rows as isize]
}

/// Returns the values of a contiguous tensor for writing in place, copied if they are shared.
fn values_mut(tensor: &mut FlexTensor) -> &mut [f32] {
    debug_assert!(tensor.is_contiguous(), "values of a contiguous tensor");
    let (start, len) = (tensor.layout().start_offset(), tensor.layout().num_elements());
    &mut tensor.storage_mut::<f32>()[start..start + len]
}

fn tensor(values: Vec<f32>, shape: impl Into<Shape>) -> FlexTensor {
    FlexTensor::new(Bytes::from_elems(values), Layout::contiguous(shape.into()), DType::F32)
}
