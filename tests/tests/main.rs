//! Whole runs through the command line: what a user types, and the files and exit codes that follow.

mod bad_input;
mod bench;
mod hyperparameters;
mod loss_curve;
mod patchwise;
mod pipeline;
mod report;
mod resume;
mod scene_files;
mod support;
