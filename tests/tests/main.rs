//! Whole runs through the command line: what a user types, and the files and exit codes that follow.

mod attack;
mod bad_input;
mod bench;
mod checkpoints;
mod convert;
#[cfg(unix)]
mod crash;
mod data_tools;
mod evaluation;
mod exact_resume;
mod extend;
#[cfg(unix)]
mod failing_disk;
mod hyperparameters;
mod layouts;
mod licences;
mod loss_curve;
mod patchwise;
mod pipeline;
mod report;
mod resume;
mod scene_files;
#[cfg(unix)]
mod signals;
mod support;
mod wrong_inputs;
