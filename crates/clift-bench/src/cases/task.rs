//! One row's work, ready to be repeated.

use burn::tensor::{Device, Tensor};
use clift_train::TrainError;

use crate::cases::reference::relative_error;

/// One row's work with everything it needs.
pub trait BenchTask {
    /// Does the work once; what is queued on the device may go on.
    fn run(&mut self) -> Result<(), TrainError>;

    /// Largest relative error against the same computation in f64 on the reference device, where the result is
    /// numbers. Takes the task, so
    /// that what only the timing needs is gone by then.
    fn error(self: Box<Self>, reference: &Device) -> Result<Option<f64>, TrainError>;

    /// By what the seconds of a repetition are divided.
    fn num_views(&self) -> usize {
        1
    }

    /// Sum of squared distances to the cluster means, of a clustering that has run.
    fn inertia(&self) -> Option<f64> {
        None
    }
}

/// A computation without gradient whose result is compared as it is.
pub trait Forward {
    /// Computes the result as one row of numbers.
    fn forward(&self) -> Tensor<1>;

    /// The same computation on the same values in f64.
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
