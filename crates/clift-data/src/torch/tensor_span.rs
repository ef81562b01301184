//! Byte ranges of tensors in an archive, and the order of their elements.

use crate::torch::archive::{Archive, ByteSpan};
use crate::torch::values::{ElementType, Tensor, Value};

/// Returns the byte range of a tensor, after checks of type, shape (`None` is any size), layout and bounds.
pub(crate) fn tensor_span(
    value: &Value,
    shape: &[Option<u64>],
    element_types: &[ElementType],
    archive: &Archive,
) -> Result<(ByteSpan, ElementType), String> {
    let Value::Tensor(tensor) = value else { return Err("no tensor".into()) };
    let Tensor { storage, offset, .. } = &**tensor;
    let element_type = storage.element_type;
    if !element_types.contains(&element_type) {
        return Err(format!("elements are {element_type:?}, expected one of {element_types:?}"));
    }
    let matches = tensor.shape.len() == shape.len()
        && tensor.shape.iter().zip(shape).all(|(got, expected)| expected.is_none_or(|expected| *got == expected));
    if !matches {
        let expected: Vec<_> = shape.iter().map(|size| size.map_or("any".into(), |size| size.to_string())).collect();
        return Err(format!("shape is {:?}, expected [{}]", tensor.shape, expected.join(", ")));
    }
    if !tensor.is_contiguous() {
        return Err(format!("stride is {:?}, expected a contiguous tensor", tensor.stride));
    }
    let member = archive
        .member(&format!("data/{}", storage.key))
        .ok_or_else(|| format!("its storage data/{} is not in the archive", storage.key))?;
    let size = element_type.num_bytes();
    let span = tensor
        .shape
        .iter()
        .try_fold(size, |product, size| product.checked_mul(*size))
        .zip(offset.checked_mul(size))
        .and_then(|(length, start)| member.part(start, length))
        .ok_or_else(|| {
            format!("shape {:?} at offset {offset} exceeds its storage of {} bytes", tensor.shape, member.len())
        })?;
    Ok((span, element_type))
}

/// Returns the stretch of storage that a strided tensor lies in, as a tensor of one dimension.
pub(crate) fn storage_stretch(tensor: &Tensor) -> Result<Tensor, String> {
    let Tensor { shape, stride, .. } = tensor;
    let length = shape
        .iter()
        .zip(stride)
        .try_fold(1_u64, |length, (&size, &stride)| length.checked_add(size.saturating_sub(1).checked_mul(stride)?));
    let count = shape.iter().try_fold(1_u64, |count, &size| count.checked_mul(size));
    // Overlapping elements are refused: a small file could claim any number of them.
    let is_held = length.zip(count).is_some_and(|(length, count)| count <= length);
    let (Some(length), true) = (length, is_held) else {
        return Err(format!("stride is {stride:?}: an expanded tensor; save it as tensor.contiguous()"));
    };
    Ok(Tensor { shape: vec![length], stride: vec![1], ..tensor.clone() })
}

/// Reorders the elements of a strided tensor to row-major order.
pub(crate) fn in_row_major_order(stored: &[f32], shape: &[u64], stride: &[u64]) -> Vec<f32> {
    let mut positions = vec![0_usize];
    for (&size, &stride) in shape.iter().zip(stride) {
        let next = |&start: &usize| (0..size as usize).map(move |i| start + i * stride as usize);
        positions = positions.iter().flat_map(next).collect();
    }
    positions.into_iter().map(|position| stored[position]).collect()
}
