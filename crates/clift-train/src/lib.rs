//! The two-stage trainer: stage 1, cluster cache, stage 2, checkpoints and resume.
//!
//! [`Run`] is an experiment in its directory. The training loop is [`trainer::StagePlan::train`], the
//! same for both stages; they differ in the batches they build.

pub mod bad_steps;
pub mod batch;
pub mod bench;
pub mod checkpoint;
pub mod cluster_builder;
pub mod cluster_entry;
mod cluster_journal;
pub mod clusters;
pub mod config;
mod device_batch;
mod diagnostic;
pub mod document;
pub mod error;
pub mod evaluate_model;
pub mod events;
pub mod export;
mod extend;
pub mod footprint;
mod former_names;
pub mod import;
mod import_record;
mod init_from;
mod keys;
pub mod lock;
pub mod loss;
pub mod loss_scale;
mod mistakes;
pub mod model_dir;
pub mod optim;
mod overrides;
pub mod plan;
pub mod progress;
mod recompute;
pub mod run;
mod run_settings;
pub mod schedule;
pub mod sinks;
pub mod stability;
pub mod stage1;
pub mod stage2;
pub mod stage_settings;
pub mod step;
mod sweep;
mod train_stage;
pub mod trainer;
mod training;
pub mod validation;

pub use config::Config;
pub use document::{ConfigError, Override, read_checked_config, read_config};
pub use error::TrainError;
pub use events::{Event, Sink, Stage};
pub use run::{Run, RunOptions};
