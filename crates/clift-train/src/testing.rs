//! Tensors of reference files for unit tests.

use std::path::PathBuf;

use burn::tensor::{DType, Device, Tensor, TensorData};
use safetensors::{Dtype, SafeTensors};

pub fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures").join(name)
}

/// A safetensors file with inputs and outputs of PyTorch.
pub struct Reference(Vec<u8>);

impl Reference {
    pub fn open(name: &str) -> Self {
        Self(std::fs::read(fixture(&format!("{name}.safetensors"))).unwrap())
    }

    pub fn data(&self, name: &str) -> Option<TensorData> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let view = file.tensor(name).ok()?;
        let dtype = match view.dtype() {
            Dtype::F32 => DType::F32,
            Dtype::F64 => DType::F64,
            Dtype::I64 => DType::I64,
            other => panic!("{name} is {other:?}"),
        };
        Some(TensorData::from_bytes_vec(view.data().to_vec(), view.shape(), dtype))
    }

    pub fn values(&self, name: &str) -> Vec<f64> {
        self.data(name).unwrap_or_else(|| panic!("{name} is missing")).try_into_vec_as().unwrap()
    }

    pub fn tensor<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        Tensor::from_data(self.data(name).unwrap_or_else(|| panic!("{name} is missing")), (device, DType::F32))
    }
}
