//! Tensors of Burn's CPU backend as f32 slices, the inputs of native kernels.

use burn::backend::flex::{FlexTensor, Layout};
use burn::tensor::{Bytes, DType, Shape};

/// Whether the native kernels accept the tensor: f64 takes the composed operations.
pub(crate) fn is_native(tensor: &FlexTensor) -> bool {
    tensor.dtype() == DType::F32
}

pub(crate) fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.is_contiguous() { tensor } else { tensor.to_contiguous() }
}

pub(crate) fn values(tensor: &FlexTensor) -> &[f32] {
    debug_assert!(tensor.is_contiguous(), "values of a contiguous tensor");
    let start = tensor.layout().start_offset();
    &tensor.storage::<f32>()[start..start + tensor.layout().num_elements()]
}

/// Returns the values of a contiguous tensor for writing in place, copied if they are shared.
pub(crate) fn values_mut(tensor: &mut FlexTensor) -> &mut [f32] {
    debug_assert!(tensor.is_contiguous(), "values of a contiguous tensor");
    let (start, len) = (tensor.layout().start_offset(), tensor.layout().num_elements());
    &mut tensor.storage_mut::<f32>()[start..start + len]
}

pub(crate) fn tensor(values: Vec<f32>, shape: impl Into<Shape>) -> FlexTensor {
    FlexTensor::new(Bytes::from_elems(values), Layout::contiguous(shape.into()), DType::F32)
}
