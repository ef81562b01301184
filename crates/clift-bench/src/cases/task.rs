//! The computation of a row, ready to be repeated.

use burn::tensor::Device;
use clift_train::TrainError;

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
