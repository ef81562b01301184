//! The CPU kernel on flex, in f32.

use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Flex, TensorMetadata};
use burn::tensor::DType;
use clift_kernels::{ClusterSegments, InstructionSet, cluster_attention_backward, cluster_attention_forward};

use crate::ops::cluster_attention::operation::{
    ClusterAttentionKernels, ClusterInputs, composed_backward, composed_forward,
};
use crate::ops::flex::{contiguous, is_native, tensor, values};

impl ClusterAttentionKernels for Flex {
    fn attend_clusters(inputs: &ClusterInputs<Self>) -> [FloatTensor<Self>; 2] {
        let Some(segments) = segments(inputs) else {
            return composed_forward::<Self>(inputs);
        };
        let shape = inputs.query.shape();
        let num_members = inputs.segment.shape()[0];
        let [query, key_value] = [&inputs.query, &inputs.key_value].map(|x| contiguous(x.clone()));
        let mut output = vec![0.0; shape.num_elements()];
        let mut weights = vec![0.0; num_members * inputs.num_heads];
        let rows = [values(&query), values(&key_value)];
        cluster_attention_forward(InstructionSet::detected(), &segments, rows, &mut output, &mut weights);
        [tensor(output, shape), tensor(weights, [num_members, inputs.num_heads, 1])]
    }

    fn attend_clusters_backward(
        inputs: ClusterInputs<Self>,
        results: [FloatTensor<Self>; 2],
        grad_output: FloatTensor<Self>,
    ) -> [FloatTensor<Self>; 2] {
        let Some(segments) = segments(&inputs) else {
            return composed_backward::<Self>(inputs, results, grad_output);
        };
        let (query_shape, member_shape) = (inputs.query.shape(), inputs.key_value.shape());
        let [_, weights] = results;
        let tensors = [inputs.query, inputs.key_value, weights, grad_output].map(contiguous);
        let mut grad_query = vec![0.0; query_shape.num_elements()];
        let mut grad_members = vec![0.0; member_shape.num_elements()];
        let to = [&mut grad_query[..], &mut grad_members[..]];
        cluster_attention_backward(InstructionSet::detected(), &segments, tensors.each_ref().map(values), to);
        [tensor(grad_query, query_shape), tensor(grad_members, member_shape)]
    }
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
