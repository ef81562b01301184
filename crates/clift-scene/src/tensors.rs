//! Reads the tensors of a safetensors file, which may be damaged or hostile.

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
        let data = self.data(name, Dtype::F64, shape)?;
        Ok(data.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect())
    }

    pub fn f32s(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, String> {
        let data = self.data(name, Dtype::F32, shape)?;
        Ok(data.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
    }

    pub fn u32s(&self, name: &str, shape: &[usize]) -> Result<Vec<u32>, String> {
        let data = self.data(name, Dtype::U32, shape)?;
        Ok(data.as_chunks::<4>().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect())
    }
}
