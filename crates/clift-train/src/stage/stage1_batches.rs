//! Batches of stage 1: clips with random subsets of the tokens.

use std::sync::Arc;

use clift_data::{ClipReader, ClipViews, TrainingClips, derive_seed, half_resolution, item_rng, step_rng};
use clift_model::ModelConfig;
use rand::RngExt;
use rand::seq::index::sample;

use crate::config::config::Config;
use crate::distributed::parts::BatchParts;
use crate::error::TrainError;
use crate::events::Stage;
use crate::step::batch::{BatchTokens, StageBatch};

/// Maker of the batches of stage 1, a pure function of (seed, step).
pub struct Stage1Batches {
    clips: TrainingClips,
    /// Clips of the first steps, and the number of these steps.
    half_resolution: Option<(TrainingClips, u64)>,
    keep_tokens: [f64; 2],
    model: ModelConfig,
    parts: BatchParts,
    seed: u64,
}

impl Stage1Batches {
    /// Makes batches of the slots that `parts` gives to this rank.
    pub fn new(config: &Config, reader: &ClipReader, parts: BatchParts) -> Result<Self, TrainError> {
        let Config { data, stage1, .. } = config;
        let seed = derive_seed(config.seed, "stage1");
        let clips = |reader: &ClipReader| {
            let read = reader.clone();
            let read = Arc::new(move |scene, views: &_| read.read(scene, views));
            let clips = TrainingClips::new(reader.source.clone(), read, data.views.clone(), stage1.batch_size, seed);
            clips.map(|clips| clips.with_flip(data.flip))
        };
        let half_resolution = match config.stage(Stage::Stage1).half_resolution_steps {
            0 => None,
            num_steps => Some((clips(&half_resolution(data, reader)?)?, num_steps)),
        };
        Ok(Self {
            clips: clips(reader)?,
            half_resolution,
            keep_tokens: stage1.keep_tokens,
            model: config.model.clone(),
            parts,
            seed,
        })
    }

    /// Makes the batch of `step`, counted from 0.
    ///
    /// The share of tokens is sampled once per step; every target view gets its own random subset.
    pub fn batch(&self, step: u64) -> Result<StageBatch, TrainError> {
        let (mut clips, mut skipped) = (Vec::new(), Vec::new());
        let source = match &self.half_resolution {
            Some((half, num_steps)) if step < *num_steps => half,
            _ => &self.clips,
        };
        for slot in self.parts.slots() {
            let mut of_slot = Vec::new();
            clips.push(source.slot(step, slot, &mut of_slot)?);
            skipped.extend(of_slot.into_iter().map(|skip| (slot, skip)));
        }
        let num_tokens = clips.first().map(|clip| {
            let ClipViews { height, width, .. } = clip.context;
            self.model.num_patches(clip.context.num_views(), height, width)
        });
        let num_tokens = num_tokens.transpose()?.unwrap_or_default();
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
