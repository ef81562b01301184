//! Precision of the operands of matrix products: f32, bf16 on processors with AVX-512 BF16, or f16 on devices with f16.
//!
//! Only the two operands of a product are rounded, in linear layers and attention, forward and backward. Weights, results,
//! sums, norms, softmax, GELU, loss, gradients and optimizer state stay f32, as do the first layers, whose inputs are
//! rays, and the attention inside clusters with its gates. Queries, keys, values and the input of GELU are also saved for the
//! backward in bf16, and in f16 on GPUs with cooperative matrices ([`Kernels::save`](crate::ops::kernels::Kernels::save)).
//!
//! The precision applies to a scope of a thread, like autocast in PyTorch: callers hold [`Precision::scope`] during the
//! forward pass. An operation reads the precision once; its backward uses that of its forward.

use std::cell::Cell;
use std::marker::PhantomData;

use burn::tensor::{DType, Device, Tensor};
use clift_kernels::{InstructionSet, OperandType};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use strum::{Display, IntoStaticStr, VariantArray};

use crate::error::ModelError;
use crate::names::{names, parse_variant};

/// Type of the operands of matrix products.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display, IntoStaticStr, VariantArray)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum Precision {
    /// 24 bits of significand.
    #[default]
    F32,
    /// 8 bits of significand and the range of f32, so that training needs no loss scaling. Native kernels of `flex`.
    Bf16,
    /// 11 bits of significand, from 6e-8 to 65504: half the bytes, and on most GPUs a multiple of the speed.
    F16,
}

thread_local! {
    static CURRENT: Cell<Precision> = const { Cell::new(Precision::F32) };
}

impl Precision {
    /// All precisions, in the order of help texts.
    pub const ALL: [Self; 3] = *Self::VARIANTS.as_array().expect("three variants");

    /// Returns the current precision of this thread.
    pub fn current() -> Self {
        CURRENT.get()
    }

    /// Sets the precision of this thread until the returned scope is dropped.
    #[must_use = "the precision applies until the scope is dropped"]
    pub fn scope(self) -> PrecisionScope {
        PrecisionScope { former: CURRENT.replace(self), not_send: PhantomData }
    }

    /// Returns the name in configs and on the command line.
    pub fn as_str(self) -> &'static str {
        self.into()
    }

    /// Checks that the device supports the precision, the value of `key`.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] for f16 on a device without f16 or whose f16 hides overflows, and for bf16 on a device
    /// other than `flex` or a processor without AVX-512 BF16.
    pub fn check(self, key: &'static str, device: &Device) -> Result<(), ModelError> {
        let device = device.clone().without_autodiff();
        let reason = match self {
            Self::F32 => None,
            Self::Bf16 => missing_bf16(&device),
            Self::F16 => missing_f16(&device),
        };
        let Some(reason) = reason else { return Ok(()) };
        let fix = format!("{reason}; write \"f32\" (`clift doctor` lists the features of devices)");
        Err(ModelError::BadConfig { key, value: self.to_string(), fix })
    }

    /// Returns the precision in which pictures are rendered where none is named: bf16 if the device computes in it, f32
    /// elsewhere.
    pub fn for_images(device: &Device) -> Self {
        if missing_bf16(&device.clone().without_autodiff()).is_none() { Self::Bf16 } else { Self::F32 }
    }

    /// Returns the operands of native kernels; `None` for f16, which has none.
    pub(crate) fn native_operands(self) -> Option<OperandType> {
        match self {
            Self::F32 => Some(OperandType::F32),
            Self::Bf16 => Some(OperandType::Bf16),
            Self::F16 => None,
        }
    }
}

impl std::str::FromStr for Precision {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        parse_variant(name).ok_or_else(|| format!("use one of {}", names::<Self>()))
    }
}

fn missing_bf16(device: &Device) -> Option<String> {
    let set = InstructionSet::detected();
    if *device != Device::flex() {
        Some("only the device `flex` computes in bf16".into())
    } else if set.has_bf16() {
        None
    } else {
        Some(format!("the kernels have no bf16 instructions ({}; AVX-512 BF16 is needed)", set.name()))
    }
}

fn missing_f16(device: &Device) -> Option<String> {
    if !device.supports_dtype(DType::F16) {
        return Some("the device has no f16 (on a GPU, the feature SHADER_F16)".into());
    }
    // Loss scaling detects overflows by infinities; WGSL leaves the result of an overflow to the driver.
    let large = Tensor::<1>::full([1], 1e6, device).cast(DType::F16).cast(DType::F32);
    let hides = large.into_scalar::<f32>().is_finite();
    hides.then(|| "the device rounds values above 65504 to finite values, which hides overflows".into())
}

/// Restores the former precision of the thread when dropped.
#[derive(Debug)]
pub struct PrecisionScope {
    former: Precision,
    not_send: PhantomData<*const ()>,
}

impl Drop for PrecisionScope {
    fn drop(&mut self) {
        CURRENT.set(self.former);
    }
}

/// Returns whether items of `num_patches` patches, images or scenes, are computed by one thread each: operations on few patches
/// are slower when each is divided among threads.
pub fn has_threads(is_flex: bool, num_patches: usize) -> bool {
    is_flex && num_patches <= 1 << 10
}

/// Maps items in the precision of this thread: in parallel if `is_threaded`, else one after the other.
///
/// # Errors
/// The first error in the order of the items.
pub fn map_in_threads<T: Sync, R: Send, E: Send>(
    is_threaded: bool,
    items: &[T],
    map: impl Fn(&T) -> Result<R, E> + Sync,
) -> Result<Vec<R>, E> {
    let precision = Precision::current();
    let map = |item: &T| {
        let _precision = precision.scope();
        map(item)
    };
    if !is_threaded {
        return items.iter().map(map).collect();
    }
    items.par_iter().map(map).collect::<Vec<_>>().into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::name::DeviceName;
    use crate::ops::attention::{cross_sdpa, self_sdpa};
    use crate::ops::linear::tests::LAYERS;
    use crate::testing::{devices, error_norms, output_and_gradients, random, to_vec};

    /// Devices with f16, and flex in bf16, which processors without the instructions emulate.
    fn reduced_precisions() -> impl Iterator<Item = (Device, Precision)> {
        let f16 = devices().into_iter().map(|device| (device, Precision::F16));
        let f16 = f16.filter(|(device, precision)| precision.check("precision", device).is_ok());
        f16.chain([(Device::flex(), Precision::Bf16)])
    }

    #[test]
    fn a_scope_applies_to_one_thread_until_dropped() {
        let f16 = Precision::F16.scope();
        {
            let _bf16 = Precision::Bf16.scope();
            assert_eq!(Precision::current(), Precision::Bf16);
        }
        assert_eq!(Precision::current(), Precision::F16);
        assert_eq!(std::thread::spawn(Precision::current).join().expect("no panic"), Precision::F32);
        drop(f16);
        assert_eq!(Precision::current(), Precision::F32);
    }

    #[test]
    fn devices_without_a_precision_are_refused() {
        let ndarray = DeviceName::Ndarray.open().expect("a CPU device");
        let message = |precision: Precision| precision.check("precision", &ndarray).unwrap_err().to_string();
        assert!(message(Precision::F16).starts_with("`precision` = f16: the device has no f16"));
        assert!(message(Precision::Bf16).starts_with("`precision` = bf16: only the device `flex`"));
        assert!(Precision::F32.check("precision", &ndarray).is_ok());
        assert!(Precision::F16.check("precision", &Device::flex()).is_ok());
        match Precision::Bf16.check("precision", &Device::flex().autodiff()) {
            Ok(()) => assert!(InstructionSet::detected().has_bf16()),
            Err(refused) => assert!(refused.to_string().contains("AVX-512 BF16 is needed"), "{refused}"),
        }
    }

    fn results(device: &Device, precision: Precision, dtype: DType) -> Vec<Tensor<1>> {
        let sample = |shape: [usize; 3], seed: u64| random(shape, seed, device).cast(dtype);
        let inputs = [([2, 9, 16], 1), ([1, 16, 48], 2), ([1, 16, 16], 3), ([1, 16, 32], 4), ([1, 16, 16], 5)];
        let [linear, gelu_linear, norm_linear] = LAYERS.map(|layer| {
            move |x: Tensor<3>, weight: Tensor<3>| {
                let beta = x.zeros_like().slice([0..1, 0..1, 0..16]);
                let bias = weight.zeros_like().slice([0..1, 0..1]);
                layer([x, beta.ones_like(), beta, weight, bias])
            }
        });
        let chain = |[x, packed, query, key_value, out]: [Tensor<3>; 5]| {
            let _scope = precision.scope();
            let mixed = self_sdpa(norm_linear(x, packed), 2);
            linear(cross_sdpa(gelu_linear(mixed.clone(), query), linear(mixed, key_value), 4), out)
        };
        // Outside the scope: a backward has the precision of its forward.
        let inputs = inputs.map(|(shape, seed)| sample(shape, seed));
        let (output, grads) = output_and_gradients(inputs, sample([2, 9, 16], 9), chain);
        assert!(grads.iter().chain([&output]).all(|result| result.dtype() == dtype), "results have the type of inputs");
        [output].into_iter().chain(grads).map(|result| result.flatten(0, 2)).collect()
    }

    #[test]
    fn errors_of_outputs_and_gradients_match_the_bits_of_the_operands() {
        let expected = results(&Device::flex(), Precision::F32, DType::F64);
        for precision in [Precision::Bf16, Precision::F16] {
            let values = results(&Device::flex(), precision, DType::F64).into_iter().map(to_vec);
            assert!(values.eq(expected.iter().cloned().map(to_vec)), "f64 is not rounded");
        }
        let errors = |found: Vec<Tensor<1>>| -> Vec<f64> {
            let pairs = found.into_iter().zip(expected.clone()).map(|(found, expected)| [found, expected]);
            pairs.map(|pair| error_norms(&[pair])).map(|[difference, norm]| difference / norm).collect()
        };
        for (device, precision) in reduced_precisions() {
            let f32 = errors(results(&device, Precision::F32, DType::F32));
            let reduced = errors(results(&device, precision, DType::F32));
            // f16 has 13 bits less than f32, bf16 16; the error of few values varies widely. The weights are large: rounded
            // scores move the softmax.
            let (step, most) = if precision == Precision::F16 { (1.0, 3e-2) } else { (8.0, 4e-1) };
            for (i, (reduced, f32)) in reduced.iter().zip(&f32).enumerate() {
                let ratio = reduced / f32 / step;
                assert!((200.0..40_000.0).contains(&ratio), "{precision}, {i}: {reduced:.1e} and {f32:.1e}");
                assert!(*reduced < most, "{precision}, {i}: {reduced:.1e}");
            }
        }
    }

    #[test]
    fn large_scores_stay_finite() {
        for (device, precision) in reduced_precisions() {
            let _scope = precision.scope();
            // Scores of 50 x 100 x 4.
            let query = Tensor::<3>::full([1, 2, 4], 100.0, &device);
            let keys = query.clone().slice([0..1, 0..1, 0..4]);
            let output = cross_sdpa(query, Tensor::cat(vec![keys.clone(), keys.ones_like()], 2), 1);
            assert!(to_vec(output).iter().all(|value| (value - 1.0).abs() < 1e-3));
        }
    }
}
