//! The two-stage trainer: stage 1, cluster cache, stage 2, checkpoints and resume.
//!
//! [`Run`] is an experiment in its directory. It trains both stages and evaluates; a second call resumes it.
//!
//! ```no_run
//! use std::path::Path;
//! use std::sync::atomic::AtomicBool;
//!
//! use clift_train::{Config, Event, Run, RunOptions, read_config};
//!
//! let overrides = ["stage1.steps=1000".to_owned()];
//! let (config, _) = read_config::<Config>(Path::new("configs/tiny.toml"), &overrides)?;
//! let mut print = |event: &Event| println!("{event:?}");
//! let run = Run::open(config, &RunOptions::default(), &mut print)?;
//! let summary = run.train(None, &AtomicBool::new(false), &mut print)?;
//! println!("{:?}", summary.map(|summary| summary.points));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod checkpoint;
mod cluster_cache;
mod config;
mod distributed;
mod error;
mod events;
mod fit_token_codec;
mod footprint;
mod interchange;
mod run;
mod stage;
mod step;
#[cfg(test)]
mod testing;
mod version;

// Configuration
pub use config::config::{
    Algorithm, CheckpointConfig, ClustersConfig, Config, LossConfig, OptimizerConfig, Schedule, Stage1Config,
    Stage2Config,
};
pub use config::parse::{ConfigError, parse_config, read_checked_config, read_config};
// Ranks of a run
pub use distributed::launch::Launched;
pub use distributed::machine::RankPlace;
pub use distributed::parts::BatchParts;
pub use distributed::ranks::Ranks;
// A run, its events and errors
pub use error::TrainError;
pub use events::{Event, RunStep, Sink, Stage, StepEvent};
pub use fit_token_codec::fit_token_codec;
pub use run::eval_folder::EvalFolder;
pub use run::evaluate_model::evaluate_model;
pub use run::lock::RunLock;
pub use run::run::Run;
pub use run::run_file::{RunOptions, lock_run};
pub use stage::settings::{StageSettings, freeze};
// One update
pub use step::batch::{BatchTokens, StageBatch};
pub use step::device_batch::{DeviceBatch, render_loss};
pub use step::loss::{Loss, LossParts, Rendering};
pub use step::loss_scale::LossScale;
pub use step::optimizer::StageOptimizer;
pub use step::schedule::learning_rate;
pub use step::step_guard::StepAnomaly;
pub use step::train_state::{TrainState, Update};
// Results of the stages
pub use checkpoint::checkpoints::Checkpoints;
pub use checkpoint::newest::NewestCheckpoint;
pub use checkpoint::progress::TrainingPosition;
pub use cluster_cache::cache::ClusterCache;
// Published checkpoints
pub use interchange::export::export_f16;
pub use interchange::import::{ImportRecord, import};
pub use interchange::model_dir::require_absent;
// Memory, sizes and speed of a run
pub use footprint::estimate::{RunEstimate, estimate_run};
pub use footprint::largest_tensor::largest_tensor;
pub use footprint::memory::memory_warning;
pub use footprint::plan::{PartPlan, Plan, check_plan, plan};
// Seeded inputs for tests and benchmarks
pub use step::seeded_inputs::{ClipShape, seeded_batch, seeded_clip, seeded_clusters, seeded_model, seeded_uniform};
