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
use burn::tensor::{DType, Device, FloatDType, Tensor};
use serde::{Deserialize, Serialize};
use strum::{Display, IntoStaticStr, VariantArray};

use crate::error::ModelError;
use crate::names::parse;

/// What the operands of matrix products are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display, IntoStaticStr, VariantArray)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
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

    /// Returns the name as it is typed.
    pub fn as_str(self) -> &'static str {
        self.into()
    }

    /// Refuses f16, which `key` asks for, on a device without it.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] with what the device lacks.
    pub fn check(self, key: &'static str, device: &Device) -> Result<(), ModelError> {
        if self == Self::F32 {
            return Ok(());
        }
        let refused = |why: &str| {
            let fix = format!("{why} (`clift doctor` lists what devices have): write \"f32\"");
            Err(ModelError::BadConfig { key, value: "f16".into(), fix })
        };
        let device = device.clone().without_autodiff();
        if !device.supports_dtype(DType::F16) {
            return refused("the device has no f16; of a GPU it takes the feature SHADER_F16");
        }
        // A product that is too large must be seen to be: loss scaling looks for it. WGSL leaves this to the driver.
        let large = Tensor::<1>::full([1], 1e6, &device).cast(DType::F16).cast(DType::F32);
        if large.into_scalar::<f32>().is_finite() {
            return refused("the device rounds numbers beyond 65504 to finite ones, which hides overflows");
        }
        Ok(())
    }
}

impl std::str::FromStr for Precision {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        parse(name).ok_or_else(|| "write f32 or f16".into())
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
    use crate::testing::{devices, random, to_vec};

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
        let device = crate::device::name::DeviceName::Ndarray.open().expect("a CPU device");
        let message = Precision::F16.check("precision", &device).unwrap_err().to_string();
        assert!(message.starts_with("`precision` = f16: the device has no f16"), "{message}");
        assert!(Precision::F32.check("precision", &device).is_ok());
        assert!(Precision::F16.check("precision", &Device::flex()).is_ok());
    }

    /// Output and gradients of a chain that has every operation.
    fn results(device: &Device, precision: Precision, dtype: DType) -> Vec<Vec<f64>> {
        use burn::module::Param;
        use burn::nn::{LayerNorm, LayerNormConfig, Linear};

        use crate::ops::attention::sdpa::{cross_sdpa, self_sdpa};
        use crate::ops::linear::{gelu_linear, linear, norm_linear};

        let device = device.clone().autodiff();
        // On a device with f64 as well: the same numbers on all.
        let draw = |shape: [usize; 3], seed: u64| random(shape, seed, &device).cast(dtype).detach();
        let layer = |weight: &Tensor<3>| {
            let [_, inputs, outputs] = weight.dims();
            let bias = Tensor::zeros([outputs], (&device, dtype));
            Linear {
                weight: Param::from_tensor(weight.clone().reshape([inputs, outputs]).detach()),
                bias: Some(Param::from_tensor(bias)),
            }
        };
        let x = draw([2, 9, 16], 1).require_grad();
        let weights = [[1, 16, 48], [1, 16, 16], [1, 16, 32], [1, 16, 16]];
        let weights: Vec<_> = weights.into_iter().zip(2..).map(|(shape, seed)| draw(shape, seed)).collect();
        let layers: Vec<_> = weights.iter().map(layer).collect();
        let mut norm: LayerNorm = LayerNormConfig::new(16).init(&device);
        norm.gamma = Param::from_tensor(norm.gamma.val().cast(dtype).detach());
        norm.beta = norm.beta.map(|beta| Param::from_tensor(beta.val().cast(dtype).detach()));
        let output = {
            let _scope = precision.scope();
            let mixed = self_sdpa(norm_linear(&norm, &layers[0], x.clone()), 2);
            let query = gelu_linear(&layers[1], mixed.clone());
            linear(&layers[3], cross_sdpa(query, linear(&layers[2], mixed), 4))
        };
        assert_eq!(output.dtype(), dtype, "results are no halves");
        let cotangent = random([2, 9, 16], 9, &device).cast(dtype);
        // Outside of the scope: a backward computes as its forward did.
        let grads = (output.clone() * cotangent).sum().backward();
        let gradient = |grad: Option<Tensor<2>>| {
            let grad = grad.expect("tracked");
            assert_eq!(grad.dtype(), dtype, "gradients are no halves");
            to_vec(grad)
        };
        let mut all = vec![to_vec(output.inner())];
        all.push(gradient(x.grad(&grads).map(|grad| grad.flatten(0, 1))));
        all.extend(layers.iter().map(|layer| gradient(layer.weight.val().grad(&grads))));
        all
    }

    #[test]
    fn outputs_and_gradients_are_off_as_halves_are_off() {
        let expected = results(&Device::flex(), Precision::F16, DType::F64);
        let exact = results(&Device::flex(), Precision::F32, DType::F64);
        assert_eq!(expected, exact, "f64 is never narrowed");
        let errors = |found: &[Vec<f64>]| -> Vec<f64> {
            let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>().sqrt();
            let error = |(found, expected): (&Vec<f64>, &Vec<f64>)| {
                norm(&mut found.iter().zip(expected).map(|(a, b)| a - b)) / norm(&mut expected.iter().copied())
            };
            found.iter().zip(&expected).map(error).collect()
        };
        for device in devices().into_iter().filter(|device| Precision::F16.check("precision", device).is_ok()) {
            let single = errors(&results(&device, Precision::F32, DType::F32));
            let half = errors(&results(&device, Precision::F16, DType::F32));
            for (i, (half, single)) in half.iter().zip(&single).enumerate() {
                // A half has 13 bits less. Errors of a few numbers are a matter of luck.
                let ratio = half / single;
                assert!((200.0..40_000.0).contains(&ratio), "{i}: {half:.1e} and {single:.1e}");
                assert!(*half < 3e-2, "{i}: {half:.1e}");
            }
        }
    }

    #[test]
    fn large_scores_stay_finite() {
        for device in devices().into_iter().filter(|device| Precision::F16.check("precision", device).is_ok()) {
            let _scope = Precision::F16.scope();
            // Scores of 50 x 100 x 4.
            let query = Tensor::<3>::full([1, 2, 4], 100.0, &device);
            let keys = query.clone().slice([0..1, 0..1, 0..4]);
            let output =
                crate::ops::attention::sdpa::cross_sdpa(query, Tensor::cat(vec![keys.clone(), keys.ones_like()], 2), 1);
            assert!(to_vec(output).iter().all(|value| (value - 1.0).abs() < 1e-3));
        }
    }
}
