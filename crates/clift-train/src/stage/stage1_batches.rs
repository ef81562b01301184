//! Batches of stage 1: clips with random subsets of the tokens.

use std::sync::Arc;

use clift_data::{ClipReader, TrainingClips, derive_seed, item_rng, step_rng};
use rand::RngExt;
use rand::seq::index::sample;

use crate::config::config::Config;
use crate::distributed::parts::BatchParts;
use crate::error::TrainError;
use crate::step::batch::{BatchTokens, StageBatch};

/// Maker of the batches of stage 1, a pure function of (seed, step).
pub struct Stage1Batches {
    clips: TrainingClips,
    keep_tokens: [f64; 2],
    tokens_per_view: usize,
    parts: BatchParts,
    seed: u64,
}

impl Stage1Batches {
    /// Makes batches of the slots that `parts` gives to this rank.
    pub fn new(config: &Config, reader: &ClipReader, parts: BatchParts) -> Result<Self, TrainError> {
        let seed = derive_seed(config.seed, "stage1");
        let read = reader.clone();
        let clips = TrainingClips::new(
            reader.source.clone(),
            Arc::new(move |scene, views: &_| read.read(scene, views)),
            config.data.views.clone(),
            config.stage1.batch_size,
            seed,
        )?;
        let clips = clips.with_flip(config.data.flip);
        let tokens_per_view = config.model.num_patches(1, config.data.height, config.data.width)?;
        Ok(Self { clips, keep_tokens: config.stage1.keep_tokens, tokens_per_view, parts, seed })
    }

    /// Makes the batch of `step`, counted from 0.
    ///
    /// The share of tokens is sampled once per step; every target view gets its own random subset.
    pub fn batch(&self, step: u64) -> Result<StageBatch, TrainError> {
        let (mut clips, mut skipped) = (Vec::new(), Vec::new());
        for slot in self.parts.slots() {
            let mut of_slot = Vec::new();
            clips.push(self.clips.slot(step, slot, &mut of_slot)?);
            skipped.extend(of_slot.into_iter().map(|skip| (slot, skip)));
        }
        let num_context = clips.first().map_or(0, |clip| clip.context.num_views());
        let num_tokens = num_context * self.tokens_per_view;
        let [low, high] = self.keep_tokens;
        let share = low + (high - low) * step_rng(self.seed, step, "kept share").random::<f64>();
        let count = ((num_tokens as f64 * share) as usize).clamp(1, num_tokens.max(1));
        let tokens = if count == num_tokens {
            BatchTokens::All
        } else {
            let subsets = self.parts.slots().zip(&clips).map(|(slot, clip)| {
                let mut rng = item_rng(self.seed, step, slot as u32, 0, "kept tokens");
                let subset = |_| sample(&mut rng, num_tokens, count).into_iter().map(|token| token as u32).collect();
                (0..clip.target.num_views()).map(subset).collect()
            });
            BatchTokens::Subsets(subsets.collect())
        };
        Ok(StageBatch { clips, tokens, skipped })
    }
}
