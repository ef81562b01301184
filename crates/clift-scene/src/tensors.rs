//! Numbers of files as little-endian bytes, and the tensors of a safetensors file, which may be damaged or hostile.

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};

/// The tensors of a file, looked up by name, type and shape.
pub(crate) struct Tensors<'a>(pub SafeTensors<'a>);

impl Tensors<'_> {
    pub fn view(&self, name: &str) -> Result<TensorView<'_>, String> {
        self.0.tensor(name).map_err(|_| format!("no tensor `{name}`"))
    }

    pub fn length(&self, name: &str) -> Result<usize, String> {
        match self.view(name)?.shape() {
            &[length] => Ok(length),
            shape => Err(format!("`{name}` has the shape {shape:?}, expected one dimension")),
        }
    }

    pub fn data(&self, name: &str, dtype: Dtype, shape: &[usize]) -> Result<Vec<u8>, String> {
        let view = self.view(name)?;
        if view.dtype() != dtype || view.shape() != shape {
            return Err(format!("`{name}` is {:?} {:?}, expected {dtype:?} {shape:?}", view.dtype(), view.shape()));
        }
        Ok(view.data().to_vec())
    }

    pub fn f64s(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>, String> {
        Ok(numbers(&self.data(name, Dtype::F64, shape)?, f64::from_le_bytes))
    }

    pub fn f32s(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, String> {
        Ok(numbers(&self.data(name, Dtype::F32, shape)?, f32::from_le_bytes))
    }

    pub fn u32s(&self, name: &str, shape: &[usize]) -> Result<Vec<u32>, String> {
        Ok(numbers(&self.data(name, Dtype::U32, shape)?, u32::from_le_bytes))
    }
}

/// Converts the numbers of `N` bytes each, such as with `f32::from_le_bytes`.
pub(crate) fn numbers<const N: usize, T>(bytes: &[u8], from: fn([u8; N]) -> T) -> Vec<T> {
    bytes.as_chunks().0.iter().map(|bytes| from(*bytes)).collect()
}

pub(crate) fn f64_bytes(values: impl IntoIterator<Item = f64>) -> Vec<u8> {
    values.into_iter().flat_map(f64::to_le_bytes).collect()
}

pub(crate) fn f32_bytes(values: impl IntoIterator<Item = f32>) -> Vec<u8> {
    values.into_iter().flat_map(f32::to_le_bytes).collect()
}

pub(crate) fn u32_bytes(values: impl IntoIterator<Item = u32>) -> Vec<u8> {
    values.into_iter().flat_map(u32::to_le_bytes).collect()
}
