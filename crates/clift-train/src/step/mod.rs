//! One optimizer step.
//!
//! - `adamw`: `AdamW`, by one kernel a parameter on GPUs
//! - `batch`: host batch of one update
//! - `device_batch`: a batch on a device; its loss
//! - `gradient_sum`: gradients of all ranks
//! - `loss`: MSE and perceptual term
//! - `loss_scale`: loss scaling for f16
//! - `muon`: Muon, matrices side by side
//! - `optimizer`: `AdamW` or Muon for a stage, gradient norm and clipping
//! - `schedule`: warm-up and cosine
//! - `seeded_inputs`: batches and weights from a seed, for tests and benchmarks
//! - `train_state`: model, optimizer, one update
//! - `step_guard`: skip anomalous steps

pub(crate) mod adamw;
pub(crate) mod batch;
pub(crate) mod device_batch;
pub(crate) mod gradient_sum;
pub(crate) mod loss;
pub(crate) mod loss_scale;
pub(crate) mod muon;
pub(crate) mod optimizer;
pub(crate) mod schedule;
pub(crate) mod seeded_inputs;
pub(crate) mod step_guard;
pub(crate) mod train_state;
