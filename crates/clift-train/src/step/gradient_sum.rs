//! The sum of the gradients of all parts of a batch, on several ranks.
//!
//! Every rank adds up a range of the values, in the order of the parts, and sends its sums to the others: as
//! many bytes as a ring, and on any number of ranks the sum of one process, bit for bit. Values are in the order of the
//! module.

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};

use crate::distributed::ranks::Ranks;
use crate::error::TrainError;

#[derive(Debug, Default)]
pub(crate) struct GradientSum {
    has_gradient: Vec<bool>,
    len: usize,
    /// The ranges that this rank adds up.
    own: Vec<f32>,
}

impl GradientSum {
    /// Adds the gradients of a round, which the first `num_working` ranks have, and the others not.
    pub fn add<M: Module>(
        &mut self,
        module: &M,
        grads: GradientsParams,
        num_working: usize,
        ranks: &Ranks,
    ) -> Result<(), TrainError> {
        let mut flatten = Flatten { grads, has_gradient: Vec::new(), flat: Vec::new() };
        module.visit(&mut flatten);
        let Flatten { has_gradient, flat, .. } = flatten;
        let mut values = Vec::new();
        // A few at once: a device limits the size of a tensor.
        for some in flat.chunks(8) {
            let some = Tensor::cat(some.to_vec(), 0).try_into_vec_as::<f32>();
            values.extend(some.map_err(|error| TrainError::Device { reason: error.to_string() })?);
        }
        let all = ranks.gather((has_gradient, values.len()))?;
        if let Some(rank) = (0..num_working).find(|&rank| all[rank] != all[0]) {
            return Err(TrainError::RanksDiffer { what: "the trained parameters", rank });
        }
        // Every round has a part on rank 0.
        (self.has_gradient, self.len) = all.into_iter().next().expect("rank 0");
        ranks.add_ranges(&values, self.len, num_working, &mut self.own);
        Ok(())
    }

    /// Returns the sum as gradients on `device`, the same on every rank.
    pub fn finish<M: Module>(self, module: &M, device: &Device, ranks: &Ranks) -> GradientsParams {
        let values = ranks.join_ranges(&self.own, self.len);
        let mut restore = Restore {
            has_gradient: self.has_gradient.into_iter(),
            values: &values,
            device: device.clone().without_autodiff(),
            grads: GradientsParams::new(),
        };
        module.visit(&mut restore);
        restore.grads
    }
}

/// Collects gradients in the order of the module.
struct Flatten {
    grads: GradientsParams,
    has_gradient: Vec<bool>,
    flat: Vec<Tensor<1>>,
}

impl ModuleVisitor for Flatten {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let grad = self.grads.remove::<D>(param.id);
        self.has_gradient.push(grad.is_some());
        self.flat.extend(grad.map(|grad| grad.flatten(0, D - 1)));
    }
}

struct Restore<'a> {
    has_gradient: std::vec::IntoIter<bool>,
    values: &'a [f32],
    device: Device,
    grads: GradientsParams,
}

impl ModuleVisitor for Restore<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if self.has_gradient.next() == Some(true) {
            let shape = param.val().dims();
            let (own, rest) = self.values.split_at(shape.iter().product());
            self.values = rest;
            let grad = Tensor::<D>::from_data(TensorData::new(own.to_vec(), shape), &self.device);
            self.grads.register(param.id, grad);
        }
    }
}
