//! Clips and batches, from (seed, step, slot).
//!
//! - `clip`: view indices, views, clips
//! - `clip_reader`: frames of a scene to a clip
//! - `flip`: mirrored clips
//! - `scene_order`: seeded permutation per epoch
//! - `inner_views`: contexts between two ends
//! - `view_sampler`: context and target frames of an item
//! - `slot_filler`: ONE retry loop for batch slots
//! - `training_clips`: the batch of a step
//! - `prefetcher`: batches made ahead by threads
//! - `evaluation_index`: published evaluation indices

pub(crate) mod clip;
pub(crate) mod clip_reader;
pub(crate) mod evaluation_index;
pub(crate) mod flip;
pub(crate) mod inner_views;
pub(crate) mod prefetcher;
pub(crate) mod scene_order;
pub(crate) mod slot_filler;
pub(crate) mod training_clips;
pub(crate) mod view_sampler;
