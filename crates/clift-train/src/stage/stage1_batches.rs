//! Batches of stage 1: clips with random subsets of the tokens.

use clift_core::{ClipViews, derive_seed, item_rng, step_rng, uniform_below};
use clift_data::{ClipReader, DataConfig, DataError, TrainingClips, half_size_reader, resized_reader};
use rand::RngExt;
use rand::seq::index::sample;

use crate::config::config::Config;
use crate::distributed::parts::BatchParts;
use crate::error::TrainError;
use crate::events::Stage;
use crate::step::batch::{BatchTokens, StageBatch};

/// Maker of the batches of stage 1, a pure function of (seed, step).
pub struct Stage1Batches {
    /// Clips of every image size, and those of the steps with half the resolution, where there are such steps.
    sizes: Vec<(TrainingClips, Option<TrainingClips>)>,
    config: Config,
    parts: BatchParts,
    seed: u64,
}

impl Stage1Batches {
    /// Makes batches of the slots that `parts` gives to this rank.
    pub fn new(config: &Config, reader: &ClipReader, parts: BatchParts) -> Result<Self, TrainError> {
        let Config { data, stage1, .. } = config;
        let seed = derive_seed(config.seed, "stage1");
        let clips = |reader: ClipReader| TrainingClips::new(reader, data.views.clone(), stage1.batch_size, seed);
        let has_half = config.stage(Stage::Stage1).half_resolution_steps > 0;
        let sized = |(data, reader): (DataConfig, ClipReader)| {
            let half = has_half.then(|| clips(half_size_reader(&data, &reader)?)).transpose()?;
            Ok((clips(reader)?, half))
        };
        let further = stage1.further_sizes.iter().map(|&size| resized_reader(data, reader, size));
        let readers = std::iter::once(Ok((data.clone(), reader.clone()))).chain(further);
        let sizes = readers.map(|reader| sized(reader?)).collect::<Result<_, DataError>>()?;
        Ok(Self { sizes, config: config.clone(), parts, seed })
    }

    /// Makes the batch of `step`, counted from 0.
    ///
    /// Image size and share of tokens are sampled once per step; every target view gets its own random subset.
    pub fn batch(&self, step: u64) -> Result<StageBatch, TrainError> {
        let (mut clips, mut skipped) = (Vec::new(), Vec::new());
        let is_half = step < self.config.stage(Stage::Stage1).half_resolution_steps;
        let (whole, half) = &self.sizes[uniform_below(&mut step_rng(self.seed, step, "image size"), self.sizes.len())];
        let source = half.as_ref().filter(|_| is_half).unwrap_or(whole);
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
