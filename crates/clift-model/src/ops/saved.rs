//! Tensors that an operation saves for its backward.

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, Flex, TensorMetadata};
use burn::tensor::Shape;
use clift_kernels::{InstructionSet, pack_bf16, unpack_bf16};

use crate::ops::flex::{contiguous, is_native, tensor, values};
use crate::ops::precision::Precision;

/// A saved tensor.
#[derive(Clone, Debug)]
pub struct Saved<T> {
    values: T,
    /// Shape of a tensor that is saved in bf16, two of its values in each of `values`.
    packed: Option<Shape>,
}

impl<T> Saved<T> {
    /// Saves a tensor as it is.
    pub(crate) fn whole(values: T) -> Self {
        Self { values, packed: None }
    }
}

/// Saving on a backend. The default implementations save tensors as they are.
pub trait SaveKernels: Backend {
    /// Saves a tensor, on `flex` with the precision bf16 in half of its memory: without loss for operands of products, which are
    /// rounded anyway; the input of GELU is rounded.
    fn save(_precision: Precision, x: FloatTensor<Self>) -> Saved<FloatTensor<Self>> {
        Saved::whole(x)
    }

    /// Returns a saved tensor.
    fn restore(saved: Saved<FloatTensor<Self>>) -> FloatTensor<Self> {
        saved.values
    }
}

impl SaveKernels for Flex {
    // Not by Burn's cast, which converts value by value in one thread.
    fn save(precision: Precision, x: FloatTensor<Self>) -> Saved<FloatTensor<Self>> {
        if precision != Precision::Bf16 || !is_native(&x) {
            return Saved::whole(x);
        }
        let shape = x.shape();
        let mut packed = vec![0.0; shape.num_elements().div_ceil(2)];
        pack_bf16(InstructionSet::detected(), values(&contiguous(x)), &mut packed);
        let len = packed.len();
        Saved { values: tensor(packed, [len]), packed: Some(shape) }
    }

    fn restore(saved: Saved<FloatTensor<Self>>) -> FloatTensor<Self> {
        let Some(shape) = saved.packed else { return saved.values };
        let mut unpacked = vec![0.0; shape.num_elements()];
        unpack_bf16(values(&saved.values), &mut unpacked);
        tensor(unpacked, shape)
    }
}
#[cfg(feature = "ndarray")]
impl SaveKernels for burn::backend::NdArray {}
#[cfg(feature = "wgpu")]
impl SaveKernels for burn::backend::Cube {}
