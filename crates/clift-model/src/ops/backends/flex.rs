//! Burn's CPU backend, by the kernels of `clift-kernels` in f32 and bf16. f64 (in tests) and f16 take the composed operations.

use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Flex, TensorMetadata};
use burn::tensor::DType;
use clift_kernels as native;
use clift_kernels::{
    AttentionGradients, AttentionSizes, BackwardInputs, ClusterSegments, HeadRows, InstructionSet, Matrix, OperandType,
    StridedRows,
};

use crate::ops::backends::flex_slices::{contiguous, is_native, matrix, stored_matrix, tensor, values, values_mut};
use crate::ops::composed::attention::{AttentionOutput, Qkv};
use crate::ops::composed::cluster_attention::ClusterInputs;
use crate::ops::composed::head_transform::Heads;
use crate::ops::composed::norms::{EPSILON, LayerNormInputs};
use crate::ops::composed::{attention, cluster_attention, gelu, head_transform, linear, norms, primitives};
use crate::ops::kernels::{HeadConfig, Kernels, SavedTensor, matmul_in};
use crate::ops::precision::Precision;

impl Kernels for Flex {
    fn matmul_bf16(lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        let ([rows, inner], [_, columns]) = (lhs.shape().dims(), rhs.shape().dims());
        let [lhs, rhs] = [lhs, rhs].map(stored_matrix);
        let mut output = vec![0.0; rows * columns];
        let factors = [matrix(&lhs), matrix(&rhs)];
        native::matmul_bf16(InstructionSet::detected(), [rows, inner, columns], factors, None, &mut output);
        tensor(output, [rows, columns])
    }

    // Not by Burn's cast, which converts value by value in one thread.
    fn save(precision: Precision, x: FloatTensor<Self>) -> SavedTensor<FloatTensor<Self>> {
        if precision != Precision::Bf16 || !is_native(&x) {
            return SavedTensor::whole(x);
        }
        let shape = x.shape();
        let mut packed = vec![0.0; shape.num_elements().div_ceil(2)];
        native::pack_bf16(InstructionSet::detected(), values(&contiguous(x)), &mut packed);
        let len = packed.len();
        SavedTensor { values: tensor(packed, [len]), packed: Some(shape) }
    }

    fn restore(saved: SavedTensor<FloatTensor<Self>>) -> FloatTensor<Self> {
        let Some(shape) = saved.packed else { return saved.values };
        let mut unpacked = vec![0.0; shape.num_elements()];
        native::unpack_bf16(values(&saved.values), &mut unpacked);
        tensor(unpacked, shape)
    }

    fn linear_forward(precision: Precision, inputs: [FloatTensor<Self>; 3]) -> FloatTensor<Self> {
        let [x, weight, _bias] = &inputs;
        let Some(operands) = precision.native_operands().filter(|_| is_native(x)) else {
            return linear::forward::<Self>(inputs, matmul_in::<Self>(precision));
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
                native::matmul_bf16(InstructionSet::detected(), sizes, factors, Some(bias), &mut output);
            }
        }
        tensor(output, [batch, count, outputs])
    }

    fn sum_rows(x: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return primitives::sum_rows::<Self>(x);
        }
        let [_, _, outputs] = x.shape().dims();
        let mut sum = vec![0.0; outputs];
        native::sum_rows(InstructionSet::detected(), values(&contiguous(x)), &mut sum);
        tensor(sum, [outputs])
    }

    fn exact_gelu_forward(x: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return gelu::forward::<Self>(x);
        }
        let mut to = vec![0.0; x.shape().num_elements()];
        let shape = x.shape();
        native::gelu_forward(InstructionSet::detected(), values(&contiguous(x)), &mut to);
        tensor(to, shape)
    }

    fn exact_gelu_backward(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return gelu::backward::<Self>(x, grad);
        }
        let mut grad = contiguous(grad);
        native::gelu_backward(InstructionSet::detected(), values(&contiguous(x)), values_mut(&mut grad));
        grad
    }

    fn layer_norm_forward(inputs: [FloatTensor<Self>; 3]) -> (FloatTensor<Self>, Option<FloatTensor<Self>>) {
        if !is_native(&inputs[0]) {
            return (norms::layer_norm_forward::<Self>(inputs), None);
        }
        let [batch, count, dim] = inputs[0].shape().dims();
        let inputs = inputs.map(contiguous);
        let mut output = vec![0.0; batch * count * dim];
        let mut statistics = vec![0.0; batch * count * 2];
        let (pairs, _) = statistics.as_chunks_mut();
        let slices = inputs.each_ref().map(values);
        native::layer_norm_forward(InstructionSet::detected(), EPSILON as f32, slices, &mut output, pairs);
        (tensor(output, [batch, count, dim]), Some(tensor(statistics, [batch * count, 2])))
    }

    fn layer_norm_backward(
        norm: LayerNormInputs<FloatTensor<Self>>,
        grad: FloatTensor<Self>,
    ) -> [FloatTensor<Self>; 3] {
        let Some(statistics) = &norm.statistics else {
            return norms::layer_norm_backward::<Self>(norm, grad);
        };
        let [batch, count, dim] = norm.x.shape().dims();
        let [x, gamma, grad] = [norm.x, norm.gamma, grad].map(contiguous);
        let mut grads = [batch * count * dim, dim, dim].map(|len| vec![0.0; len]);
        let inputs = [values(&x), values(&gamma), values(&grad)];
        let (pairs, _) = values(statistics).as_chunks();
        native::layer_norm_backward(
            InstructionSet::detected(),
            inputs,
            pairs,
            grads.each_mut().map(|grad| &mut grad[..]),
        );
        let [grad_x, grad_gamma, grad_beta] = grads;
        [tensor(grad_x, [batch, count, dim]), tensor(grad_gamma, [dim]), tensor(grad_beta, [dim])]
    }

    fn rms_norm_forward([x, gammas]: [FloatTensor<Self>; 2], rows: HeadRows) -> FloatTensor<Self> {
        if !is_native(&x) || !is_native(&gammas) {
            return norms::rms_norm_forward::<Self>([x, gammas], rows);
        }
        let (mut x, gammas) = (contiguous(x), contiguous(gammas));
        native::rms_norm_forward(InstructionSet::detected(), rows, values(&gammas), values_mut(&mut x));
        x
    }

    fn rms_norm_backward(
        [x, gammas]: [FloatTensor<Self>; 2],
        grad: FloatTensor<Self>,
        rows: HeadRows,
    ) -> [FloatTensor<Self>; 2] {
        if !is_native(&x) || !is_native(&gammas) {
            return norms::rms_norm_backward::<Self>([x, gammas], grad, rows);
        }
        let ([x, gammas], mut grad) = ([x, gammas].map(contiguous), contiguous(grad));
        let mut grad_gammas = vec![0.0; values(&gammas).len()];
        let inputs = [values(&x), values(&gammas)];
        native::rms_norm_backward(InstructionSet::detected(), rows, inputs, values_mut(&mut grad), &mut grad_gammas);
        let len = grad_gammas.len();
        [grad, tensor(grad_gammas, [len])]
    }

    fn attention_forward(inputs: &Qkv<FloatTensor<Self>>, heads: HeadConfig) -> AttentionOutput<FloatTensor<Self>> {
        let HeadConfig { num_heads, precision } = heads;
        let Some(operands) = precision.native_operands().filter(|_| inputs.is_native()) else {
            return attention::forward::<Self>(inputs, num_heads, matmul_in::<Self>(precision));
        };
        let inputs = inputs.clone().map(contiguous);
        let sizes = inputs.sizes(num_heads);
        let AttentionSizes { batch, num_queries, head_width, .. } = sizes;
        let dim = num_heads * head_width;
        let mut output = vec![0.0; batch * num_queries * dim];
        let mut log_sum = vec![0.0; batch * num_heads * num_queries];
        let set = InstructionSet::detected();
        native::attention_forward(set, operands, sizes, inputs.rows(dim), &mut output, &mut log_sum);
        let log_sum = tensor(log_sum, [batch, num_heads, num_queries]);
        AttentionOutput { output: tensor(output, [batch, num_queries, dim]), log_sum: Some(log_sum) }
    }

    fn attention_backward(
        inputs: Qkv<FloatTensor<Self>>,
        results: AttentionOutput<FloatTensor<Self>>,
        heads: HeadConfig,
        grad_output: FloatTensor<Self>,
    ) -> Qkv<FloatTensor<Self>> {
        let HeadConfig { num_heads, precision } = heads;
        let (Some(log_sum), Some(operands)) = (results.log_sum, precision.native_operands()) else {
            return attention::backward::<Self>(
                &inputs,
                results.output,
                num_heads,
                grad_output,
                matmul_in::<Self>(precision),
            );
        };
        let inputs = inputs.map(contiguous);
        let sizes = inputs.sizes(num_heads);
        let AttentionSizes { batch, num_queries, num_keys, head_width, .. } = sizes;
        let dim = num_heads * head_width;
        let [output, grad_output] = [results.output, grad_output].map(contiguous);
        let [query, key, value] = inputs.rows(dim);
        let [output, grad_output] = [&output, &grad_output].map(|x| columns(x, 0));
        let saved = BackwardInputs { query, key, value, output, log_sum: values(&log_sum), grad_output };
        let set = InstructionSet::detected();
        match inputs {
            Qkv::Packed(_) => {
                let mut grad = vec![0.0; batch * num_queries * 3 * dim];
                native::attention_backward(set, operands, sizes, saved, AttentionGradients::Packed(&mut grad));
                Qkv::Packed(tensor(grad, [batch, num_queries, 3 * dim]))
            }
            Qkv::Separate { .. } => {
                let mut query = vec![0.0; batch * num_queries * dim];
                let mut key_value = vec![0.0; batch * num_keys * 2 * dim];
                let to = AttentionGradients::Separate { query: &mut query, key_value: &mut key_value };
                native::attention_backward(set, operands, sizes, saved, to);
                let query = tensor(query, [batch, num_queries, dim]);
                Qkv::Separate { query, key_value: tensor(key_value, [batch, num_keys, 2 * dim]) }
            }
        }
    }

    fn cluster_attention_forward(inputs: &ClusterInputs<Self>) -> [FloatTensor<Self>; 2] {
        let Some(segments) = segments(inputs) else {
            return cluster_attention::forward::<Self>(inputs);
        };
        let shape = inputs.query.shape();
        let num_members = inputs.segment.shape()[0];
        let [query, key_value] = [&inputs.query, &inputs.key_value].map(|x| contiguous(x.clone()));
        let mut output = vec![0.0; shape.num_elements()];
        let mut weights = vec![0.0; num_members * inputs.num_heads];
        let rows = [values(&query), values(&key_value)];
        native::cluster_attention_forward(InstructionSet::detected(), &segments, rows, &mut output, &mut weights);
        [tensor(output, shape), tensor(weights, [num_members, inputs.num_heads, 1])]
    }

    fn cluster_attention_backward(
        inputs: ClusterInputs<Self>,
        results: [FloatTensor<Self>; 2],
        grad_output: FloatTensor<Self>,
    ) -> [FloatTensor<Self>; 2] {
        let Some(segments) = segments(&inputs) else {
            return cluster_attention::backward::<Self>(inputs, results, grad_output);
        };
        let (query_shape, member_shape) = (inputs.query.shape(), inputs.key_value.shape());
        let [_, weights] = results;
        let tensors = [inputs.query, inputs.key_value, weights, grad_output].map(contiguous);
        let mut grad_query = vec![0.0; query_shape.num_elements()];
        let mut grad_members = vec![0.0; member_shape.num_elements()];
        let to = [&mut grad_query[..], &mut grad_members[..]];
        native::cluster_attention_backward(InstructionSet::detected(), &segments, tensors.each_ref().map(values), to);
        [tensor(grad_query, query_shape), tensor(grad_members, member_shape)]
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
        let kinds = heads.kinds(is_gradient);
        let head_width = x.shape()[2] / kinds.len() / heads.num_heads;
        let mut x = contiguous(x);
        let transforms = contiguous(transforms);
        let sizes = [heads.num_heads, head_width];
        let set = InstructionSet::detected();
        native::transform_heads(set, &kinds, sizes, values(&transforms), values_mut(&mut x));
        x
    }
}

impl Qkv<FlexTensor> {
    fn is_native(&self) -> bool {
        match self {
            Self::Packed(packed) => is_native(packed),
            Self::Separate { query, key_value } => is_native(query) && is_native(key_value),
        }
    }

    fn sizes(&self, num_heads: usize) -> AttentionSizes {
        let (query, key_value, parts) = match self {
            Self::Packed(packed) => (packed, packed, 3),
            Self::Separate { query, key_value } => (query, key_value, 1),
        };
        let [batch, num_queries, width] = query.shape().dims();
        let [_, num_keys, _] = key_value.shape().dims();
        AttentionSizes { batch, num_queries, num_keys, num_heads, head_width: width / parts / num_heads }
    }

    /// Returns the rows of queries, keys and values.
    fn rows(&self, dim: usize) -> [StridedRows<'_>; 3] {
        match self {
            Self::Packed(packed) => [0, 1, 2].map(|part| columns(packed, part * dim)),
            Self::Separate { query, key_value } => [columns(query, 0), columns(key_value, 0), columns(key_value, dim)],
        }
    }
}

/// Returns the rows of a contiguous tensor, starting with column `first`.
fn columns(x: &FlexTensor, first: usize) -> StridedRows<'_> {
    let [_, count, width] = x.shape().dims();
    StridedRows { values: values(x).get(first..).unwrap_or_default(), batch_stride: count * width, row_stride: width }
}

/// Groups members by segment; `None` for tensors that the kernel does not accept.
fn segments(inputs: &ClusterInputs<Flex>) -> Option<ClusterSegments> {
    if !is_native(&inputs.query) || !is_native(&inputs.key_value) {
        return None;
    }
    let [batch, num_segments, dim] = inputs.query.shape().dims();
    let sizes = [batch * num_segments, inputs.num_heads, dim / inputs.num_heads];
    let segment: FlexTensor = contiguous(inputs.segment.clone());
    let start = segment.layout().start_offset();
    let range = start..start + segment.layout().num_elements();
    match segment.dtype() {
        DType::I64 => Some(ClusterSegments::new(sizes, segment.storage::<i64>()[range].iter().map(|&s| s as usize))),
        DType::I32 => Some(ClusterSegments::new(sizes, segment.storage::<i32>()[range].iter().map(|&s| s as usize))),
        _ => None,
    }
}
