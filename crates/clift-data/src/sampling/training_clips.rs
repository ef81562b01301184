//! The training batch of a step: clips and skipped scenes.

use std::collections::BTreeSet;

use clift_core::item_rng;

use crate::error::DataError;
use crate::sampling::clip::Clip;
use crate::sampling::clip_reader::ClipReader;
use crate::sampling::scene_order::SceneOrder;
use crate::sampling::view_sampler::ViewSampler;
use crate::skip_report::SkippedScene;

/// Smallest number of attempts of one slot before the batch fails, repeated scenes included.
const MIN_ATTEMPTS: u32 = 16;
/// Smallest number of different scenes that one slot tries before the batch fails; all scenes of a smaller source.
const MIN_SCENES_TRIED: usize = 64;
/// Bounds the search in a scene order that never reaches some scenes; 64 different scenes take about 300 steps.
const MAX_STEPS_AHEAD: u32 = 4096;

/// Reads the batch of any step as a pure function of (seed, step): scenes, views, and replacements of unusable scenes.
///
/// A [`Prefetcher`](crate::sampling::prefetcher::Prefetcher) around it reads batches ahead.
pub struct TrainingClips {
    reader: ClipReader,
    sampler: ViewSampler,
    order: SceneOrder,
    seed: u64,
}

impl TrainingClips {
    /// Prepares batches of `batch_size` clips of the scenes of `reader`.
    ///
    /// `seed` determines all random values. Each stage of a run needs its own seed
    /// ([`derive_seed`](clift_core::derive_seed)).
    ///
    /// # Errors
    /// [`DataError::BadConfig`] for an invalid sampler, a source without scenes and a `batch_size` of 0.
    pub fn new(reader: ClipReader, sampler: ViewSampler, batch_size: usize, seed: u64) -> Result<Self, DataError> {
        sampler.validate()?;
        let order = SceneOrder::new(seed, reader.source.num_scenes(), batch_size)?;
        Ok(Self { reader, sampler, order, seed })
    }

    /// Reads one slot of the batch of `step`. All clips of a batch have the same numbers of context and target views.
    ///
    /// A scene that is too short or unreadable is appended to `skipped` and replaced by the scene of the same slot one step
    /// later, then two, and so on. Replacements have random streams of their own, so other slots do not change.
    ///
    /// # Errors
    /// [`DataError::NoUsableScene`] after 16 attempts and 64 different scenes (all scenes of a smaller source).
    pub fn slot(&self, step: u64, slot: usize, skipped: &mut Vec<SkippedScene>) -> Result<Clip, DataError> {
        let num_context = self.sampler.num_context(self.seed, step);
        let source = &self.reader.source;
        let min_scenes = source.num_scenes().min(MIN_SCENES_TRIED);
        let (mut tried, mut attempts) = (BTreeSet::new(), 0);
        for ahead in 0..MAX_STEPS_AHEAD {
            if attempts >= MIN_ATTEMPTS && tried.len() >= min_scenes {
                break;
            }
            let scene = self.order.scene(step.saturating_add(u64::from(ahead)), slot);
            // Among the first attempts a scene may be tried again, with other views.
            if !tried.insert(scene) && ahead >= MIN_ATTEMPTS {
                continue;
            }
            attempts += 1;
            let mut rng = item_rng(self.seed, step, slot as u32, ahead, "views");
            let views = self.sampler.sample(source.as_ref(), scene, step, num_context, &mut rng);
            match views.and_then(|views| self.reader.read(scene, &views)) {
                Ok(clip) => return Ok(clip),
                Err(error) => {
                    skipped.push(SkippedScene { key: source.key(scene).into(), reason: error.to_string() });
                }
            }
        }
        let last = skipped.last().map(|SkippedScene { key, reason }| (key.clone(), reason.clone()));
        let (key, reason) = last.unwrap_or_default();
        Err(DataError::NoUsableScene { step, slot, attempts, key, reason })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::clip_reader::ClipOptions;
    use crate::testing::scenes_of_lengths;
    use std::sync::Arc;

    fn clips(lengths: Vec<usize>, batch_size: usize, seed: u64) -> TrainingClips {
        let options = ClipOptions { width: 1, height: 1, ..ClipOptions::default() };
        let reader = ClipReader { source: Arc::new(scenes_of_lengths(lengths)), options };
        TrainingClips::new(reader, ViewSampler::default(), batch_size, seed).unwrap()
    }

    fn batch(clips: &TrainingClips, size: usize, step: u64) -> Result<(Vec<Clip>, Vec<SkippedScene>), DataError> {
        let mut skipped = Vec::new();
        let read = (0..size).map(|slot| clips.slot(step, slot, &mut skipped)).collect::<Result<_, _>>()?;
        Ok((read, skipped))
    }

    /// A reference checksum of the batches.
    #[test]
    fn first_thousand_batches_are_reproducible() {
        let rare = (0..300).map(|scene| if scene % 23 == 5 { 90 } else { 10 + scene % 17 }).collect();
        let clips = clips(rare, 8, 12345);
        let name = |key: &str| format!("scene-{}", key[key.len() - 5..].parse::<usize>().unwrap());
        let line = |step: u64, (clips, skipped): (Vec<Clip>, Vec<SkippedScene>)| {
            let clips = clips.iter().map(|Clip { key, context, target, .. }| {
                (name(key), &context.frame_index, &target.frame_index, context.cameras[0].c2w.translation[0].signum())
            });
            let skips = skipped.iter().map(|skip| (name(&skip.key), &skip.reason));
            format!("{step} {:?} {:?}", clips.collect::<Vec<_>>(), skips.collect::<Vec<_>>())
        };
        let mut checksum = crc32fast::Hasher::new();
        for step in 0..1000 {
            let line = batch(&clips, 8, step).map_or_else(|error| error.to_string(), |batch| line(step, batch));
            checksum.update(format!("{line}\n").as_bytes());
        }
        assert_eq!(checksum.finalize(), 0x931e_f689);
    }

    #[test]
    fn slot_fails_after_64_scenes_or_16_attempts() {
        let attempts = |num_scenes| match batch(&clips(vec![10; num_scenes], 1, 9), 1, 0) {
            Err(DataError::NoUsableScene { attempts, .. }) => attempts,
            other => panic!("{other:?}"),
        };
        assert_eq!([attempts(1), attempts(1000)], [16, 64]);
        assert!((40..=56).contains(&attempts(40)), "{} attempts for 40 scenes", attempts(40));
        let error = batch(&clips(vec![10; 40], 4, 9), 4, 2).unwrap_err().to_string();
        assert!(error.starts_with("no usable scene for slot 0 of step 2 in "), "{error}");
        assert!(error.ends_with(": not enough frames: 26 needed, 10 in the scene"), "{error}");
    }
}
