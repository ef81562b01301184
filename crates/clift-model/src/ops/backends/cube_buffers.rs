//! Tensors of `CubeCL` as buffers of `clift-cube`.

use burn::backend::{BackendTensor, DispatchAutodiffContext, DispatchTensor, DispatchTensorKind, TensorMetadata};
use burn::tensor::{DType, Shape, Tensor};
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use clift_cube::{Buffer, Matrices, Values};

/// Returns the tensor of `CubeCL` behind a tensor without autodiff, if the kernels accept it.
pub(crate) fn cube_tensor<const D: usize>(x: &Tensor<D>) -> Option<CubeTensor> {
    match x.clone().into_dispatch().kind {
        DispatchTensorKind::Cube(BackendTensor::Float(x)) if is_native(&x) => Some(x),
        _ => None,
    }
}

pub(crate) fn float_tensor<const D: usize>(x: CubeTensor) -> Tensor<D> {
    let kind = DispatchTensorKind::Cube(BackendTensor::Float(x));
    Tensor::from_dispatch(DispatchTensor { kind, autodiff: DispatchAutodiffContext::default() })
}

pub(crate) fn is_native(x: &CubeTensor) -> bool {
    x.dtype == DType::F32 && x.qparams.is_none()
}

/// Returns whether the kernels read the tensor as an operand of products: f32, or a copy in f16 that [`Kernels::save`] made.
///
/// [`Kernels::save`]: crate::ops::kernels::Kernels::save
pub(crate) fn is_operand(x: &CubeTensor) -> bool {
    is_native(x) || x.dtype == DType::F16 && x.qparams.is_none()
}

/// Returns the type of values; indices are words of 32 bits, too.
fn values(x: &CubeTensor) -> Values {
    match x.dtype {
        DType::F16 => Values::F16,
        DType::F32 | DType::I32 => Values::F32,
        other => panic!("the GPU kernels have no {other:?}"),
    }
}

/// Returns the values of a tensor in row-major order, copied if they lie otherwise.
///
/// # Panics
/// For types other than f32, f16 and i32.
pub(crate) fn buffer(x: CubeTensor) -> Buffer {
    let x = into_contiguous(x);
    Buffer { len: x.shape().num_elements(), values: values(&x), handle: x.handle }
}

pub(crate) fn tensor(like: &CubeTensor, x: Buffer, shape: impl Into<Shape>) -> CubeTensor {
    let dtype = if x.values == Values::F16 { DType::F16 } else { DType::F32 };
    CubeTensor::new_contiguous(like.client.clone(), like.device.clone(), shape.into(), x.handle, dtype)
}

/// The matrices of the last two dimensions of a tensor.
pub(crate) struct MatrixBuffer {
    buffer: Buffer,
    batch_stride: usize,
    stride: usize,
    transposed: bool,
}

impl MatrixBuffer {
    /// Reads a tensor in place if its rows or its columns are contiguous, and a contiguous copy otherwise.
    pub(crate) fn new(x: CubeTensor) -> Self {
        Self::in_place(&x).unwrap_or_else(|| {
            let contiguous = into_contiguous(x);
            Self::in_place(&contiguous).expect("a contiguous tensor has rows")
        })
    }

    fn in_place(x: &CubeTensor) -> Option<Self> {
        if x.meta.is_tiled() {
            return None;
        }
        let (shape, strides) = (x.meta.shape(), x.meta.strides());
        let last = shape.num_dims() - 1;
        let [rows, columns] = [shape[last - 1], shape[last]];
        let (stride, transposed) = if strides[last] == 1 && strides[last - 1] >= columns {
            (strides[last - 1], false)
        } else if strides[last - 1] == 1 && strides[last] >= rows {
            (strides[last], true)
        } else {
            return None;
        };
        let is_batched = (1..last - 1).all(|i| strides[i - 1] == strides[i] * shape[i]);
        let batch_stride = if last > 1 { strides[last - 2] } else { 0 };
        let buffer = Buffer { handle: x.handle.clone(), len: shape.num_elements(), values: values(x) };
        is_batched.then_some(Self { buffer, batch_stride, stride, transposed })
    }

    pub(crate) fn view(&self) -> Matrices<'_> {
        let &Self { ref buffer, batch_stride, stride, transposed } = self;
        Matrices { buffer, start: 0, batch_stride, stride, transposed }
    }
}
