//! Batches of stage 1: clips with random subsets of the tokens.

use clift_core::{ClipViews, derive_seed, item_rng, step_rng};
use clift_data::{ClipReader, TrainingClips, half_size_reader};
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
    /// Clips of the steps with half the resolution, where there are such steps.
    half_resolution_clips: Option<TrainingClips>,
    config: Config,
    parts: BatchParts,
    seed: u64,
}

impl Stage1Batches {
    /// Makes batches of the slots that `parts` gives to this rank.
    pub fn new(config: &Config, reader: &ClipReader, parts: BatchParts) -> Result<Self, TrainError> {
        let Config { data, stage1, .. } = config;
        let seed = derive_seed(config.seed, "stage1");
        let clips = |reader: ClipReader| {
            let clips = TrainingClips::new(reader, data.views.clone(), stage1.batch_size, seed);
            clips.map(|clips| clips.with_flip(data.flip))
        };
        let has_half = config.stage(Stage::Stage1).half_resolution_steps > 0;
        let half = has_half.then(|| clips(half_size_reader(data, reader)?)).transpose()?;
        Ok(Self { clips: clips(reader.clone())?, half_resolution_clips: half, config: config.clone(), parts, seed })
    }

    /// Makes the batch of `step`, counted from 0.
    ///
    /// The share of tokens is sampled once per step; every target view gets its own random subset.
    pub fn batch(&self, step: u64) -> Result<StageBatch, TrainError> {
        let (mut clips, mut skipped) = (Vec::new(), Vec::new());
        let is_half = self.config.stage(Stage::Stage1).is_half_resolution(step + 1);
        let source = self.half_resolution_clips.as_ref().filter(|_| is_half).unwrap_or(&self.clips);
        for slot in self.parts.slots() {
            let mut of_slot = Vec::new();
            clips.push(source.slot(step, slot, &mut of_slot)?);
            skipped.extend(of_slot.into_iter().map(|skip| (slot, skip)));
        }
        let num_tokens = clips.first().map(|clip| {
            let ClipViews { height, width, .. } = clip.context;
            self.config.model.num_patches(clip.context.num_views(), height, width)
        });
        let num_tokens = num_tokens.transpose()?.unwrap_or_default();
        let [low, high] = self.config.stage1.keep_tokens;
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
        Ok(StageBatch { step, clips, tokens, skipped })
    }
}
