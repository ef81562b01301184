//! The computation of a row, ready to be repeated.

use burn::tensor::{Device, Tensor};
use clift_train::TrainError;

use crate::cases::reference::relative_error;

/// A computation with its networks and inputs.
pub trait BenchTask {
    /// Runs the computation once. Work queued on the device may still run afterwards.
    fn run(&mut self) -> Result<(), TrainError>;

    /// Returns the largest relative error against the same computation in f64 on the reference device; `None` for a
    /// result that is not numeric. Consumes the task to free the tensors that only the timing needs.
    fn error(self: Box<Self>, reference: &Device) -> Result<Option<f64>, TrainError>;

    /// Returns the divisor of the seconds of a repetition.
    fn num_views(&self) -> usize {
        1
    }

    /// Returns the sum of squared distances to the cluster means of a finished clustering.
    fn inertia(&self) -> Option<f64> {
        None
    }
}

/// A computation without gradient, with a numeric result.
pub trait Forward {
    /// Computes the result, flattened.
    fn forward(&self) -> Tensor<1>;

    /// Returns the same computation on the same values in f64.
    #[must_use]
    fn in_f64(&self, reference: &Device) -> Self;

    /// See [`BenchTask::num_views`].
    fn num_views(&self) -> usize {
        1
    }
}

impl<T: Forward> BenchTask for T {
    fn run(&mut self) -> Result<(), TrainError> {
        self.forward();
        Ok(())
    }

    fn error(self: Box<Self>, reference: &Device) -> Result<Option<f64>, TrainError> {
        let result = self.forward();
        let copy = self.in_f64(reference);
        drop(self);
        Ok(Some(relative_error(result, copy.forward())))
    }

    fn num_views(&self) -> usize {
        Forward::num_views(self)
    }
}
