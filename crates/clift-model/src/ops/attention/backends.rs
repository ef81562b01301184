//! The implementation of every backend: on flex, in f32 and bf16, the native kernels, which read packed projections and write
//! packed gradients; elsewhere attention in chunks of queries.

use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Flex, TensorMetadata};
use clift_kernels::{
    AttentionGradients, AttentionSizes, BackwardInputs, InstructionSet, StridedRows, attention_backward,
    attention_forward,
};

use crate::ops::attention::composed::{AttentionOutput, HeadConfig, Qkv, composed_backward, composed_forward};
use crate::ops::flex::{contiguous, is_native, tensor, values};
use crate::ops::precision::MatmulKernels;
use crate::ops::saved::SaveKernels;

impl AttentionKernels for Flex {
    fn attend(inputs: &Qkv<FloatTensor<Self>>, heads: HeadConfig) -> AttentionOutput<FloatTensor<Self>> {
        let HeadConfig { num_heads, precision } = heads;
        let Some(operands) = precision.native_operands().filter(|_| inputs.is_native()) else {
            return composed_forward::<Self>(inputs, heads);
        };
        let inputs = inputs.clone().map(contiguous);
        let sizes = inputs.sizes(num_heads);
        let AttentionSizes { batch, num_queries, head_width, .. } = sizes;
        let dim = num_heads * head_width;
        let mut output = vec![0.0; batch * num_queries * dim];
        let mut log_sum = vec![0.0; batch * num_heads * num_queries];
        let set = InstructionSet::detected();
        attention_forward(set, operands, sizes, inputs.rows(dim), &mut output, &mut log_sum);
        let log_sum = tensor(log_sum, [batch, num_heads, num_queries]);
        AttentionOutput { output: tensor(output, [batch, num_queries, dim]), log_sum: Some(log_sum) }
    }

    fn attend_backward(
        inputs: Qkv<FloatTensor<Self>>,
        attended: AttentionOutput<FloatTensor<Self>>,
        heads: HeadConfig,
        grad_output: FloatTensor<Self>,
    ) -> Qkv<FloatTensor<Self>> {
        let HeadConfig { num_heads, precision } = heads;
        let (Some(log_sum), Some(operands)) = (attended.log_sum, precision.native_operands()) else {
            return composed_backward::<Self>(&inputs, attended.output, heads, grad_output);
        };
        let inputs = inputs.map(contiguous);
        let sizes = inputs.sizes(num_heads);
        let AttentionSizes { batch, num_queries, num_keys, head_width, .. } = sizes;
        let dim = num_heads * head_width;
        let [output, grad_output] = [attended.output, grad_output].map(contiguous);
        let [query, key, value] = inputs.rows(dim);
        let [output, grad_output] = [&output, &grad_output].map(|x| columns(x, 0));
        let saved = BackwardInputs { query, key, value, output, log_sum: values(&log_sum), grad_output };
        let set = InstructionSet::detected();
        match inputs {
            Qkv::Packed(_) => {
                let mut grad = vec![0.0; batch * num_queries * 3 * dim];
                attention_backward(set, operands, sizes, saved, AttentionGradients::Packed(&mut grad));
                Qkv::Packed(tensor(grad, [batch, num_queries, 3 * dim]))
            }
            Qkv::Separate { .. } => {
                let mut query = vec![0.0; batch * num_queries * dim];
                let mut key_value = vec![0.0; batch * num_keys * 2 * dim];
                let to = AttentionGradients::Separate { query: &mut query, key_value: &mut key_value };
                attention_backward(set, operands, sizes, saved, to);
                let query = tensor(query, [batch, num_queries, dim]);
                Qkv::Separate { query, key_value: tensor(key_value, [batch, num_keys, 2 * dim]) }
            }
        }
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

/// Attention and its gradients on a backend. The default implementations run on every backend.
pub trait AttentionKernels: MatmulKernels + SaveKernels {
    /// Computes the output, and the log sums if the native kernel runs.
    fn attend(inputs: &Qkv<FloatTensor<Self>>, heads: HeadConfig) -> AttentionOutput<FloatTensor<Self>> {
        composed_forward::<Self>(inputs, heads)
    }

    fn attend_backward(
        inputs: Qkv<FloatTensor<Self>>,
        attended: AttentionOutput<FloatTensor<Self>>,
        heads: HeadConfig,
        grad_output: FloatTensor<Self>,
    ) -> Qkv<FloatTensor<Self>> {
        composed_backward::<Self>(&inputs, attended.output, heads, grad_output)
    }
}

#[cfg(feature = "ndarray")]
impl AttentionKernels for burn::backend::NdArray {}
#[cfg(feature = "wgpu")]
impl AttentionKernels for burn::backend::Cube {}
