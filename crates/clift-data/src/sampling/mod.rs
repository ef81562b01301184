//! Clips and batches as pure functions of (seed, step, slot).
//!
//! Training: `scene_order` selects the scene of a slot, `view_sampler` the frames, `clip_reader` reads them,
//! `training_clips` joins them to batches. Evaluation: `evaluation_index` lists scenes and frames.
//!
//! - `clip`: view indices; clips, whole and halved
//! - `clip_reader`: reads frames of a scene as a clip
//! - `scene_order`: seeded permutation per epoch
//! - `view_sampler`: context and target frames of an item
//! - `training_clips`: the batch of a step, with other scenes in place of unusable ones
//! - `prefetcher`: items computed ahead by threads
//! - `evaluation_index`: published evaluation indices

pub(crate) mod clip;
pub(crate) mod clip_reader;
pub(crate) mod evaluation_index;
pub(crate) mod prefetcher;
pub(crate) mod scene_order;
pub(crate) mod training_clips;
pub(crate) mod view_sampler;
