//! The two-stage trainer: stage 1, cluster cache, stage 2, checkpoints and resume.
//!
//! [`Run`] is an experiment in its directory. The training loop is [`trainer::StagePlan::train`], the
//! same for both stages; they differ in the batches they build.

mod checkpoint;
mod cluster_cache;
mod config;
mod error;
mod events;
mod footprint;
mod interchange;
mod run;
mod stage;
mod step;

pub use checkpoint::checkpoints::Checkpoints;
pub use cluster_cache::cache::ClusterCache;
pub use config::config::{CheckpointConfig, Config, OptimizerConfig, Stage1Config};
pub use config::overrides::Override;
pub use config::parse::{ConfigError, parse_config, read_checked_config, read_config};
pub use error::TrainError;
pub use events::{Event, Sink, Stage, StepEvent};
pub use footprint::largest_tensor::{LargestTensor, largest_tensor};
pub use footprint::machine::available_bytes;
pub use footprint::memory::{memory_warning, peak_bytes};
pub use footprint::scene_sizes::{
    PARTS, TypicalStep, batch_sizes, cluster_counts, eval_sizes, measures_lpips, num_tokens, possible_sizes, scene,
    stored, trained_parts, typical_sizes,
};
pub use interchange::export::{ExportFormat, export};
pub use interchange::import::import;
pub use interchange::model_dir::require_absent;
pub use interchange::record::{ImportOptions, ImportRecord};
pub use run::evaluate_model::evaluate_model;
pub use run::run::{Run, RunOptions};
pub use run::stage_plan::freeze;
pub use stage::settings::StageSettings;
pub use step::batch::{StageBatch, TokenSelection};
pub use step::device_batch::{DeviceBatch, render_loss};
pub use step::loss::{Loss, mse, psnr_of};
pub use step::loss_scale::LossScale;
pub use step::optimizer::{adamw, clip_global_norm, global_norm};
pub use step::schedule::warm_up_cosine;
pub use step::seeded_inputs::{Shape, seeded_batch, seeded_clip, seeded_clusters, seeded_model, seeded_uniform};
pub use step::step_guard::StepAnomaly;
pub use step::train_state::{TrainState, Update};
