//! The numbers that matrix products are computed in: f32, or f16 where the device has it.
//!
//! Only the two operands of a product become f16: those of linear layers and of attention, in both directions. Weights,
//! results, sums, norms, softmax, GELU, loss, gradients and optimiser stay f32. The first layers, which take rays, and
//! the gates of the condenser stay f32 altogether.
//!
//! The precision holds for a scope of a thread, as autocasting does elsewhere: [`Precision::scope`] around a forward
//! pass is all that a caller writes. An operation asks once, when it is called, and its backward computes as its forward
//! did.
#![expect(deprecated, reason = "upstream retires ndarray in favour of flex; it stays as an independent check")]

use std::cell::Cell;
use std::marker::PhantomData;

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, Flex, NdArray, TensorMetadata};
use burn::tensor::{DType, Device, FloatDType};
use serde::{Deserialize, Serialize};

use crate::ModelError;

/// What the operands of matrix products are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 24 bits of fraction.
    #[default]
    F32,
    /// 11 bits of fraction, from 6e-8 to 65504: half the bytes, and on most GPUs a multiple of the speed.
    F16,
}

thread_local! {
    static CURRENT: Cell<Precision> = const { Cell::new(Precision::F32) };
}

impl Precision {
    /// That of this thread now.
    pub fn current() -> Self {
        CURRENT.get()
    }

    /// Sets that of this thread until the result is dropped.
    #[must_use = "it holds until this is dropped"]
    pub fn scope(self) -> PrecisionScope {
        PrecisionScope { former: CURRENT.replace(self), of_this_thread: PhantomData }
    }

    /// The name as it is typed.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
        }
    }

    /// Refuses f16 on a device without it.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] with what the device has.
    pub fn check(self, device: &Device) -> Result<(), ModelError> {
        if self == Self::F32 || device.supports_dtype(DType::F16) {
            return Ok(());
        }
        let fix =
            "the device has no f16 (on a GPU: no SHADER_F16; `clift doctor` lists what devices have): write \"f32\"";
        Err(ModelError::BadConfig { key: "precision", value: "f16".into(), fix: fix.into() })
    }
}

impl std::fmt::Display for Precision {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.as_str())
    }
}

impl std::str::FromStr for Precision {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        [Self::F32, Self::F16].into_iter().find(|one| one.as_str() == name).ok_or_else(|| "write f32 or f16".into())
    }
}

/// Sets the former precision of its thread when it is dropped.
#[derive(Debug)]
pub struct PrecisionScope {
    former: Precision,
    of_this_thread: PhantomData<*const ()>,
}

impl Drop for PrecisionScope {
    fn drop(&mut self) {
        CURRENT.set(self.former);
    }
}

/// Matrix products of f32 tensors on a device. The bodies here run on every one of them.
pub trait MatmulKernels: Backend {
    /// The product, in the type of its operands. Tensors of another type than f32 (f64, in tests) are left as they are.
    fn product(precision: Precision, lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        if precision == Precision::F32 || lhs.dtype() != DType::F32 {
            return Self::float_matmul(lhs, rhs);
        }
        Self::product_of_halves(Self::float_cast(lhs, FloatDType::F16), Self::float_cast(rhs, FloatDType::F16))
    }

    /// The product of two f16 tensors in f32. Here it is rounded to f16 between, as most backends give it.
    fn product_of_halves(lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        Self::float_cast(Self::float_matmul(lhs, rhs), FloatDType::F32)
    }
}

impl MatmulKernels for Flex {}
impl MatmulKernels for NdArray {}

#[cfg(feature = "wgpu")]
impl MatmulKernels for burn::backend::Cube {
    /// Sums are f32 in the kernels, and are written as such.
    fn product_of_halves(lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        use burn_cubecl::kernel::matmul::{MatmulStrategy, matmul};
        matmul(lhs, rhs, None, MatmulStrategy::default(), DType::F32).expect("a product that f32 operands have as well")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scope_ends_where_it_is_dropped_and_holds_for_one_thread() {
        assert_eq!(Precision::current(), Precision::F32);
        {
            let _half = Precision::F16.scope();
            assert_eq!(Precision::current(), Precision::F16);
            {
                let _single = Precision::F32.scope();
                assert_eq!(Precision::current(), Precision::F32);
            }
            assert_eq!(Precision::current(), Precision::F16);
            let other = std::thread::spawn(Precision::current).join().expect("no panic");
            assert_eq!(other, Precision::F32);
        }
        assert_eq!(Precision::current(), Precision::F32);
    }

    #[test]
    fn a_device_without_f16_is_refused() {
        let device = crate::device::DeviceName::Ndarray.open().expect("a CPU device");
        let message = Precision::F16.check(&device).unwrap_err().to_string();
        assert!(message.starts_with("`precision` = f16: the device has no f16"), "{message}");
        assert!(Precision::F32.check(&device).is_ok());
    }
}
