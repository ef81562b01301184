//! The computation of a row, ready to be repeated.

use burn::tensor::Device;
use clift_train::TrainError;

pub trait BenchTask {
    /// Runs the computation once. Work queued on the device may still run afterwards.
    fn run(&mut self) -> Result<(), TrainError>;

    /// Returns the largest relative error against the same computation in f64 on the reference device.
    /// Consumes the task to free the tensors that only the timing needs.
    fn error(self: Box<Self>, reference: &Device) -> Result<f64, TrainError>;

    fn num_views(&self) -> usize {
        1
    }
}
