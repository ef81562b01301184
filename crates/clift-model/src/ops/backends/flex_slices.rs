//! Tensors of Burn's CPU backend as f32 slices, the inputs of native kernels.

use burn::backend::TensorMetadata;
use burn::backend::flex::{FlexTensor, Layout};
use burn::tensor::{Bytes, DType, Shape};
use clift_kernels::Matrix;

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

/// Copies a matrix unless its rows or its columns are contiguous.
pub(crate) fn stored_matrix(tensor: FlexTensor) -> FlexTensor {
    if is_transposed(&tensor) { tensor } else { contiguous(tensor) }
}

/// Returns the values of a [`stored_matrix`].
pub(crate) fn matrix(tensor: &FlexTensor) -> Matrix<'_> {
    let start = tensor.layout().start_offset();
    let values = &tensor.storage::<f32>()[start..start + tensor.layout().num_elements()];
    Matrix { values, transposed: is_transposed(tensor) }
}

fn is_transposed(tensor: &FlexTensor) -> bool {
    let [rows, _columns] = tensor.shape().dims();
    !tensor.is_contiguous() && *tensor.layout().strides() == [1, rows as isize]
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
