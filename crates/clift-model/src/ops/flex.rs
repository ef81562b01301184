//! Burn's CPU backend as the native kernels see it: slices of f32.

use burn::backend::flex::{FlexTensor, Layout};
use burn::tensor::{Bytes, DType, Shape};

/// Whether the kernels of `clift-kernels` take the tensor: f64 goes through the composed operations.
pub(crate) fn is_native(tensor: &FlexTensor) -> bool {
    tensor.dtype() == DType::F32
}

/// The tensor with rows one after the other and nothing between them, copied if it is not so.
pub(crate) fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.is_contiguous() { tensor } else { tensor.to_contiguous() }
}

/// The values of a contiguous tensor.
pub(crate) fn values(tensor: &FlexTensor) -> &[f32] {
    debug_assert!(tensor.is_contiguous(), "values of a contiguous tensor");
    let start = tensor.layout().start_offset();
    &tensor.storage::<f32>()[start..start + tensor.layout().num_elements()]
}

/// The values of a contiguous tensor to write in place: its own where nobody shares them, else a copy.
pub(crate) fn values_mut(tensor: &mut FlexTensor) -> &mut [f32] {
    debug_assert!(tensor.is_contiguous(), "values of a contiguous tensor");
    let (start, len) = (tensor.layout().start_offset(), tensor.layout().num_elements());
    &mut tensor.storage_mut::<f32>()[start..start + len]
}

/// A tensor of these values.
pub(crate) fn tensor(values: Vec<f32>, shape: impl Into<Shape>) -> FlexTensor {
    FlexTensor::new(Bytes::from_elems(values), Layout::contiguous(shape.into()), DType::F32)
}
