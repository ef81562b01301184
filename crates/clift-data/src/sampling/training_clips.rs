//! The training batch of a step: clips and skipped scenes.

use clift_core::{item_rng, uniform_01};

use crate::error::DataError;
use crate::sampling::clip::Clip;
use crate::sampling::clip_reader::ClipReader;
use crate::sampling::scene_order::SceneOrder;
use crate::sampling::slot_filler::{NoUsableScene, SlotFiller};
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
    flip: bool,
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
        Ok(Self { reader, sampler, order, seed, flip: false })
    }

    /// With `true`, mirrors each clip with probability 1/2 ([`Clip::flipped`]).
    #[must_use]
    pub fn with_flip(self, flip: bool) -> Self {
        Self { flip, ..self }
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
        let filler = SlotFiller {
            min_attempts: MIN_ATTEMPTS,
            min_scenes: source.num_scenes().min(MIN_SCENES_TRIED),
            max_attempts: MAX_STEPS_AHEAD,
        };
        let scene = |ahead: u32| self.order.scene(step.saturating_add(u64::from(ahead)), slot);
        let read = |scene: usize, ahead: u32| {
            let skip = |error: DataError| SkippedScene { key: source.key(scene).into(), reason: error.to_string() };
            self.read_scene(scene, step, slot, ahead, num_context).map_err(skip)
        };
        filler.fill(scene, read, skipped).map_err(|NoUsableScene { attempts, last: SkippedScene { key, reason } }| {
            DataError::NoUsableScene { step, slot, attempts, key, reason }
        })
    }

    fn read_scene(
        &self,
        scene: usize,
        step: u64,
        slot: usize,
        attempt: u32,
        num_context: usize,
    ) -> Result<Clip, DataError> {
        let mut rng = item_rng(self.seed, step, slot as u32, attempt, "views");
        let views = self.sampler.sample(self.reader.source.as_ref(), scene, step, num_context, &mut rng)?;
        let clip = self.reader.read(scene, &views)?;
        // A separate stream: the sampled views do not depend on `flip`.
        let is_flipped = self.flip && uniform_01(&mut item_rng(self.seed, step, slot as u32, attempt, "flip")) < 0.5;
        Ok(if is_flipped { clip.flipped() } else { clip })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::clip_reader::ClipOptions;
    use crate::testing::Lengths;
    use std::sync::Arc;

    fn clips(lengths: Vec<usize>, batch_size: usize, seed: u64) -> TrainingClips {
        let options = ClipOptions { width: 1, height: 1, ..ClipOptions::default() };
        let reader = ClipReader { source: Arc::new(Lengths::new(lengths)), options };
        TrainingClips::new(reader, ViewSampler::default(), batch_size, seed).unwrap()
    }

    fn batch(clips: &TrainingClips, step: u64) -> Result<(Vec<Clip>, Vec<SkippedScene>), DataError> {
        let mut skipped = Vec::new();
        let slots = 0..clips.order.batch_size();
        let read = slots.map(|slot| clips.slot(step, slot, &mut skipped)).collect::<Result<_, _>>()?;
        Ok((read, skipped))
    }

    fn mixed() -> TrainingClips {
        clips((0..40).map(|scene| if scene % 3 == 0 { 10 } else { 200 }).collect(), 4, 9)
    }

    /// Reference checksums of the batches.
    #[test]
    fn first_thousand_batches_are_reproducible() {
        let rare = (0..300).map(|scene| if scene % 23 == 5 { 90 } else { 10 + scene % 17 }).collect();
        for (clips, expected) in [(mixed().with_flip(true), 0xd652_d9cf), (clips(rare, 8, 12345), 0x1fc9_670d)] {
            let line = |step: u64, (clips, skipped): (Vec<Clip>, Vec<SkippedScene>)| {
                let clips = clips.iter().map(|Clip { key, context, target, .. }| {
                    (key, &context.frame_index, &target.frame_index, context.cameras[0].c2w.translation[0].signum())
                });
                let skips = skipped.iter().map(|skip| (&skip.key, &skip.reason));
                format!("{step} {:?} {:?}", clips.collect::<Vec<_>>(), skips.collect::<Vec<_>>())
            };
            let mut checksum = crc32fast::Hasher::new();
            for step in 0..1000 {
                let line = batch(&clips, step).map_or_else(|error| error.to_string(), |batch| line(step, batch));
                checksum.update(format!("{line}\n").as_bytes());
            }
            assert_eq!(checksum.finalize(), expected);
        }
    }

    #[test]
    fn replacements_do_not_change_other_slots() {
        let good = clips(vec![200; 40], 4, 9);
        let ((whole, _), (patched, skipped)) = (batch(&good, 3).unwrap(), batch(&mixed(), 3).unwrap());
        let mut same = 0;
        for (whole, patched) in whole.iter().zip(&patched) {
            if whole.key == patched.key {
                assert_eq!(whole, patched);
                same += 1;
            }
        }
        assert!(same >= 1 && !skipped.is_empty(), "{same} slots agree, {skipped:?}");
    }

    #[test]
    fn only_usable_scene_is_found_from_every_step() {
        // A slot of a batch as large as the source sees one position of each epoch: the worst case of the search.
        for (num_scenes, batch_size) in [(2, 1), (20, 4), (64, 1), (64, 64)] {
            let lengths = (0..num_scenes).map(|scene| if scene == 1 { 200 } else { 10 }).collect();
            let clips = clips(lengths, batch_size, 9);
            for step in 0..50 {
                let (clips, _) = batch(&clips, step).unwrap();
                assert!(clips.iter().all(|clip| clip.key == "scene-1"), "{num_scenes} scenes, step {step}");
            }
        }
    }

    #[test]
    fn slot_fails_after_64_scenes_or_16_attempts() {
        let attempts = |num_scenes| match batch(&clips(vec![10; num_scenes], 1, 9), 0) {
            Err(DataError::NoUsableScene { attempts, .. }) => attempts,
            other => panic!("{other:?}"),
        };
        assert_eq!([attempts(1), attempts(1000)], [16, 64]);
        assert!((40..=56).contains(&attempts(40)), "{} attempts for 40 scenes", attempts(40));
        let error = batch(&clips(vec![10; 40], 4, 9), 2).unwrap_err().to_string();
        assert!(error.starts_with("no usable scene for slot 0 of step 2 in "), "{error}");
        assert!(error.ends_with(": not enough frames: 26 needed, 10 in the scene"), "{error}");
    }
}
