//! Reference fixtures and views for unit tests.

use std::path::{Path, PathBuf};

use burn::tensor::{DType, Device, Tensor, TensorData};
use clift_core::{Camera, ClipViews, Intrinsics, Pose};
use clift_model::TokenCoding;
use safetensors::{Dtype, SafeTensors};

use crate::config::method::Method;
use crate::statistics::view_metrics::EvalKey;

/// A key with half of the stored tokens rendered.
pub const CLIFT: EvalKey =
    EvalKey { method: Method::Clift, num_storage_tokens: 64, num_render_tokens: 32, tokens: Some(TokenCoding::F16) };

pub fn f32_key(method: Method, num_storage_tokens: usize, num_render_tokens: usize) -> EvalKey {
    EvalKey { method, num_storage_tokens, num_render_tokens, tokens: Some(TokenCoding::F32) }
}

/// Channels of the narrow networks in the fixtures.
pub const NARROW: [usize; 5] = [4, 6, 8, 8, 10];

pub fn reference_path(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(format!("../../data-fixtures/reference/{name}.safetensors"))
}

/// A fixture with inputs and expected outputs.
pub struct Reference(Vec<u8>);

impl Reference {
    pub fn open(name: &str) -> Self {
        Self::read(&reference_path(name))
    }

    pub fn read(path: &Path) -> Self {
        Self(std::fs::read(path).unwrap_or_else(|error| panic!("{error}: {}", path.display())))
    }

    /// Returns the tensor names that start with `prefix`, without `prefix`.
    pub fn names(&self, prefix: &str) -> Vec<String> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        file.names().into_iter().filter_map(|name| name.strip_prefix(prefix)).map(String::from).collect()
    }

    pub fn shape(&self, name: &str) -> Vec<usize> {
        SafeTensors::deserialize(&self.0).unwrap().tensor(name).unwrap().shape().to_vec()
    }

    pub fn f64s(&self, name: &str) -> Vec<f64> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let view = file.tensor(name).unwrap_or_else(|error| panic!("{name}: {error}"));
        match view.dtype() {
            Dtype::F32 => {
                view.data().as_chunks::<4>().0.iter().map(|bytes| f64::from(f32::from_le_bytes(*bytes))).collect()
            }
            Dtype::F64 => view.data().as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect(),
            other => panic!("{name} is {other:?}"),
        }
    }

    pub fn f32s(&self, name: &str) -> Vec<f32> {
        self.f64s(name).into_iter().map(|value| value as f32).collect()
    }

    pub fn tensor<const D: usize>(&self, name: &str, device: &Device, dtype: DType) -> Tensor<D> {
        Tensor::from_data(TensorData::new(self.f64s(name), self.shape(name)), (device, dtype))
    }
}

pub fn gray_views((width, height): (usize, usize), level: u8, c2w: Vec<Pose>, frame_index: Vec<usize>) -> ClipViews {
    let intrinsics = Intrinsics { fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0 };
    ClipViews {
        width,
        height,
        images: vec![level; frame_index.len() * height * width * 3],
        cameras: c2w.into_iter().map(|c2w| Camera { c2w, intrinsics }).collect(),
        frame_index,
    }
}
