//! Training runs: what a run writes (`pipeline`, `loss_curve`, `hyperparameters`), and runs that stop and resume.
//!
//! `exact_resume` and `resume` kill a run at chosen steps; `signals` sends signals and starts second processes;
//! `failing_disk` fills the disk or removes the data.

mod exact_resume;
#[cfg(unix)]
mod failing_disk;
mod hyperparameters;
mod loss_curve;
mod pipeline;
mod resume;
#[cfg(unix)]
mod signals;
