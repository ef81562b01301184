//! Two runs of the same update, and the error of one.

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::Tensor;
use clift_model::Clift;
use clift_train::{DeviceBatch, StageBatch, TrainError};

use crate::cases::reference::{ToF64, module_in_f64, values};
use crate::cases::step::gradients;
use crate::doctor::stability::case::CaseDevices;

/// Part of the largest gradient below which a parameter's own counts as that: a gradient that is zero in exact
/// arithmetic, as that of a query with one key, is noise in any other.
const LEAST_SHARE: f64 = 1e-3;

/// The largest error of an update's loss and of its gradients, each over its own largest entry.
pub fn update_error(place: &CaseDevices, model: &Clift, batch: &StageBatch) -> Result<f64, TrainError> {
    let shown = DeviceBatch::upload(batch, &place.device.clone().autodiff())?;
    let reference = place.reference.clone().autodiff();
    let ours = gradients(model, batch, DeviceBatch { ..shown })?;
    let copy = module_in_f64(model, &place.reference).train();
    let shown = DeviceBatch::upload(batch, &reference)?.in_f64(&reference);
    let theirs = gradients(&copy, batch, shown)?;
    Ok(largest(model, &ours, &theirs))
}

fn largest(model: &Clift, ours: &(f64, GradientsParams), theirs: &(f64, GradientsParams)) -> f64 {
    struct Pairs<'a> {
        ours: &'a GradientsParams,
        theirs: &'a GradientsParams,
        /// Largest difference and largest entry of every parameter.
        found: Vec<(f64, f64)>,
    }
    impl ModuleVisitor for Pairs<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            match (self.ours.get::<D>(param.id), self.theirs.get::<D>(param.id)) {
                (Some(ours), Some(theirs)) => {
                    let (ours, theirs) = (values(ours), values(theirs));
                    let difference = most(ours.iter().zip(&theirs).map(|(a, b)| a - b));
                    self.found.push((difference, most(theirs.into_iter())));
                }
                (None, None) => {}
                // A gradient that only one of them has is wrong altogether.
                _ => self.found.push((f64::INFINITY, 1.0)),
            }
        }
    }
    let mut pairs = Pairs { ours: &ours.1, theirs: &theirs.1, found: Vec::new() };
    model.visit(&mut pairs);
    let least = LEAST_SHARE * most(pairs.found.iter().map(|(_, entry)| *entry));
    let loss = (ours.0 - theirs.0).abs() / theirs.0.abs().max(f64::MIN_POSITIVE);
    let errors = pairs.found.iter().map(|(difference, entry)| match difference {
        0.0 => 0.0,
        difference => difference / entry.max(least),
    });
    most(errors.chain([loss]))
}

/// Largest absolute value; NaN where there is one, which `f64::max` would pass over.
pub fn most(values: impl Iterator<Item = f64>) -> f64 {
    values.map(f64::abs).fold(0.0, |most, value| if value > most || value.is_nan() { value } else { most })
}
