//! Stage-specific settings and batches.
//!
//! - `settings`: steps, batch, optimizer per stage
//! - `stage1_batches`: random token subsets
//! - `stage2_batches`: cached clusters

pub(crate) mod settings;
pub(crate) mod stage1_batches;
pub(crate) mod stage2_batches;
