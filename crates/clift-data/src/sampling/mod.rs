//! Clips and batches as pure functions of (seed, step, slot).
//!
//! Training: `scene_order` selects the scene of a slot, `view_sampler` the frames, `clip_reader` reads them,
//! `training_clips` joins them to batches. Evaluation: `evaluation_index` lists scenes and frames.
//!
//! - `clip`: view indices, views, clips
//! - `clip_reader`: reads frames of a scene as a clip
//! - `flip`: mirrored clips
//! - `half_resolution`: clips with half the columns and rows
//! - `scene_order`: seeded permutation per epoch
//! - `inner_views`: contexts between two ends
//! - `view_sampler`: context and target frames of an item
//! - `slot_filler`: retry loop of a batch slot
//! - `training_clips`: the batch of a step
//! - `prefetcher`: items computed ahead by threads
//! - `evaluation_index`: published evaluation indices

pub(crate) mod clip;
pub(crate) mod clip_reader;
pub(crate) mod evaluation_index;
pub(crate) mod flip;
pub(crate) mod half_resolution;
pub(crate) mod inner_views;
pub(crate) mod prefetcher;
pub(crate) mod scene_order;
pub(crate) mod slot_filler;
pub(crate) mod training_clips;
pub(crate) mod view_sampler;
