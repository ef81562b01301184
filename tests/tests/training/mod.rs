//! Training runs: what a run writes (`pipeline`, `loss_curve`, `hyperparameters`), and runs that stop and resume.
//!
//! `exact_resume` and `resume` kill a run at chosen steps, `crash` at random ones; `signals` sends signals and starts second
//! processes; `extend` adds steps to a finished stage; `failing_disk` fills the disk or removes the data.

#[cfg(unix)]
mod crash;
mod exact_resume;
mod extend;
#[cfg(unix)]
mod failing_disk;
mod hyperparameters;
mod loss_curve;
mod pipeline;
mod resume;
#[cfg(unix)]
mod signals;
