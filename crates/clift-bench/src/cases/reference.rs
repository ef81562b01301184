//! The same computation with weights and inputs in f64, and the error of a result against that reference.

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{DType, Device, Tensor};
use clift_model::{Cameras, Tokens, Views};

pub trait ToF64 {
    /// Returns the same values in f64 on the reference device.
    #[must_use]
    fn in_f64(&self, reference: &Device) -> Self;

    /// Returns the same values, in f64 on the reference device if one is given.
    #[must_use]
    fn on(&self, reference: Option<&Device>) -> Self
    where
        Self: Clone,
    {
        reference.map_or_else(|| self.clone(), |reference| self.in_f64(reference))
    }
}

impl<const D: usize> ToF64 for Tensor<D> {
    fn in_f64(&self, reference: &Device) -> Self {
        self.clone().to_device(reference).cast(DType::F64)
    }
}

impl ToF64 for Tokens {
    fn in_f64(&self, reference: &Device) -> Self {
        let transforms = self.transforms.as_ref().map(|transforms| transforms.in_f64(reference));
        Self { values: self.values.in_f64(reference), transforms }
    }
}

impl ToF64 for Cameras {
    fn in_f64(&self, reference: &Device) -> Self {
        Self { c2w: self.c2w.in_f64(reference), intrinsics: self.intrinsics.in_f64(reference), ..*self }
    }
}

impl ToF64 for Views {
    fn in_f64(&self, reference: &Device) -> Self {
        Self { images: self.images.in_f64(reference), cameras: self.cameras.in_f64(reference) }
    }
}

/// Returns a module without autodiff, with every parameter in f64. Parameters keep their ids and gradient flags.
pub fn module_in_f64<M: Module>(module: &M, reference: &Device) -> M {
    struct Cast<'a>(&'a Device);
    impl ModuleMapper for Cast<'_> {
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            param.map(|tensor| tensor.in_f64(self.0))
        }
    }
    module.valid().map(&mut Cast(reference))
}

/// Returns a module, with every parameter in f64 on the reference device if one is given.
pub fn module_on<M: Module>(module: &M, reference: Option<&Device>) -> M {
    reference.map_or_else(|| module.clone(), |reference| module_in_f64(module, reference))
}

pub fn flat_gradient<M: Module>(model: &M, grads: &GradientsParams) -> Vec<f64> {
    struct Collect<'a>(&'a GradientsParams, Vec<f64>);
    impl ModuleVisitor for Collect<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            self.1.extend(self.0.get::<D>(param.id).map(values).unwrap_or_default());
        }
    }
    let mut collect = Collect(grads, Vec::new());
    model.visit(&mut collect);
    collect.1
}

/// Returns the largest difference over the largest absolute value of `reference`: 0 for two tensors of zeros, NaN or
/// infinite if a value is not finite.
pub fn relative_error<const D: usize>(result: Tensor<D>, reference: Tensor<D>) -> f64 {
    let (result, reference) = (values(result), values(reference));
    assert_eq!(result.len(), reference.len(), "a result and its reference");
    let difference = largest_magnitude(result.iter().zip(&reference).map(|(a, b)| a - b));
    if difference == 0.0 { 0.0 } else { difference / largest_magnitude(reference.into_iter()) }
}

/// Returns the largest absolute value, NaN if one is NaN, which `f64::max` would ignore.
pub fn largest_magnitude(values: impl Iterator<Item = f64>) -> f64 {
    values.map(f64::abs).fold(0.0, |most, value| if value > most || value.is_nan() { value } else { most })
}

/// Reads the values of a tensor as f64, row-major.
pub fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.into_data().convert::<f64>().try_to_vec::<f64>().expect("f64 after conversion")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn error_is_relative_to_largest_value_and_keeps_nan() {
        let error = |a: [f32; 3], b: [f32; 3]| {
            let device = Device::flex();
            relative_error(Tensor::<1>::from_floats(a, &device), Tensor::<1>::from_floats(b, &device))
        };
        assert_eq!(error([1.0, -4.0, 0.0], [1.0, -4.0, 1.0]), 0.25);
        assert_eq!(error([0.0; 3], [0.0; 3]), 0.0);
        assert_eq!(error([1.0, 0.0, 0.0], [0.0; 3]), f64::INFINITY);
        assert!(error([1.0, f32::NAN, 2.0], [1.0; 3]).is_nan());
    }
}
