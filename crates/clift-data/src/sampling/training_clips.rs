//! The training batch of a step: which scenes, which views, and what was left out.

use std::fmt;
use std::sync::Arc;

use crate::error::DataError;
use crate::random::{item_rng, unit};
use crate::sampling::clip::{Clip, ViewIndices};
use crate::sampling::scene_order::SceneOrder;
use crate::sampling::slot_filler::{NoUsableScene, SlotFiller};
use crate::sampling::view_sampler::ViewSampler;
use crate::scene_source::SceneSource;
use crate::skip_report::SkippedScene;

/// Tries of one slot, a scene that comes up again included, before the batch may fail.
const MIN_ATTEMPTS: u32 = 16;
/// Distinct scenes that one slot tries, or all where there are fewer, before the batch fails.
const MAX_SCENES_TRIED: usize = 64;
/// Ends the walk over a permutation that never brings up some scene; 64 come up in 300 steps or so.
const MAX_STEPS_AHEAD: u32 = 4096;

/// Reads the given frames of a scene as a clip.
pub type ReadClip = dyn Fn(usize, &ViewIndices) -> Result<Clip, DataError> + Send + Sync;

/// The clips of one training step, all with the same numbers of context and target views.
#[derive(Clone, Debug, PartialEq)]
pub struct ClipBatch {
    /// Step the batch is for.
    pub step: u64,
    /// One clip per slot.
    pub clips: Vec<Clip>,
    /// Scenes left out on the way, with the reason.
    pub skipped: Vec<SkippedScene>,
}

/// Makes the batch of any step, as a pure function of (seed, step): scene order, views and replacements for scenes
/// that cannot be used. Wrapped in a [`Prefetcher`](crate::sampling::prefetcher::Prefetcher) it is the training loader.
pub struct TrainingClips {
    source: Arc<dyn SceneSource>,
    read: Arc<ReadClip>,
    sampler: ViewSampler,
    order: SceneOrder,
    seed: u64,
    flip: bool,
}

impl TrainingClips {
    /// Prepares batches of `batch_size` clips from `source`, whose frames `read` turns into clips.
    ///
    /// `seed` decides everything random; give each stage of a run its own
    /// ([`derive_seed`](crate::random::derive_seed)).
    ///
    /// # Errors
    /// [`DataError::BadConfig`] when the sampler does not validate, there is no scene or `batch_size` is 0.
    pub fn new(
        source: Arc<dyn SceneSource>,
        read: Arc<ReadClip>,
        sampler: ViewSampler,
        batch_size: usize,
        seed: u64,
    ) -> Result<Self, DataError> {
        sampler.validate()?;
        let order = SceneOrder::new(seed, source.num_scenes(), batch_size)?;
        Ok(Self { source, read, sampler, order, seed, flip: false })
    }

    /// Flips half of the clips left to right, drawn by chance, as a whole ([`Clip::flipped`]); `false` flips none.
    #[must_use]
    pub fn with_flip(self, flip: bool) -> Self {
        Self { flip, ..self }
    }

    /// Makes the batch of `step`.
    ///
    /// A scene that is too short or cannot be read is listed in [`ClipBatch::skipped`], and its slot takes the
    /// scene it would have had one step later, then two, and so on. The replacement is drawn with its own
    /// randomness, so the other slots do not notice.
    ///
    /// # Errors
    /// [`DataError::NoUsableScene`] when 16 tries and 64 different scenes (all, where there are fewer) have failed.
    pub fn batch(&self, step: u64) -> Result<ClipBatch, DataError> {
        let num_context = self.sampler.num_context(self.seed, step);
        let mut batch = ClipBatch { step, clips: Vec::new(), skipped: Vec::new() };
        for slot in 0..self.order.batch_size() {
            let clip = self.fill_slot(step, slot, num_context, &mut batch.skipped)?;
            batch.clips.push(clip);
        }
        Ok(batch)
    }

    fn fill_slot(
        &self,
        step: u64,
        slot: usize,
        num_context: usize,
        skipped: &mut Vec<SkippedScene>,
    ) -> Result<Clip, DataError> {
        let filler = SlotFiller {
            min_attempts: MIN_ATTEMPTS,
            min_scenes: self.source.num_scenes().min(MAX_SCENES_TRIED),
            max_attempts: MAX_STEPS_AHEAD,
        };
        let scene = |ahead: u32| self.order.scene(step.saturating_add(u64::from(ahead)), slot);
        let read = |scene: usize, ahead: u32| {
            let skip =
                |error: DataError| SkippedScene { key: self.source.key(scene).into(), reason: error.to_string() };
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
        let views = self.sampler.sample(self.source.as_ref(), scene, step, num_context, &mut rng)?;
        let clip = (self.read)(scene, &views)?;
        // A stream of its own, so that the views drawn are the same with and without it.
        let is_flipped = self.flip && unit(&mut item_rng(self.seed, step, slot as u32, attempt, "flip")) < 0.5;
        Ok(if is_flipped { clip.flipped() } else { clip })
    }
}

impl fmt::Debug for TrainingClips {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TrainingClips")
            .field("sampler", &self.sampler)
            .field("order", &self.order)
            .field("seed", &self.seed)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::geometry::pose::Pose;
    use crate::sampling::clip::ClipViews;
    use crate::sampling::prefetcher::Prefetcher;
    use crate::testing::Lengths;

    fn clips(lengths: Vec<usize>, batch_size: usize, seed: u64) -> TrainingClips {
        let source = Arc::new(Lengths::new(lengths));
        let keys = source.keys.clone();
        let read = move |scene: usize, views: &ViewIndices| {
            let only = |frame_index: &[usize]| ClipViews {
                width: 0,
                height: 0,
                images: Vec::new(),
                c2w: vec![Pose { translation: [1.0, 0.0, 0.0].into(), ..Pose::IDENTITY }; frame_index.len()],
                intrinsics: Vec::new(),
                frame_index: frame_index.to_vec(),
            };
            Ok(Clip { key: keys[scene].clone(), context: only(&views.context), target: only(&views.target) })
        };
        TrainingClips::new(source, Arc::new(read), ViewSampler::default(), batch_size, seed).unwrap()
    }

    fn mixed() -> TrainingClips {
        clips((0..40).map(|scene| if scene % 3 == 0 { 10 } else { 200 }).collect(), 4, 9)
    }

    /// Checksums of the batches of the version before `SlotFiller`.
    #[test]
    fn a_thousand_batches_are_those_of_earlier_versions() {
        let rare = (0..300).map(|scene| if scene % 23 == 5 { 90 } else { 10 + scene % 17 }).collect();
        for (clips, expected) in [(mixed().with_flip(true), 0xd652_d9cf), (clips(rare, 8, 12345), 0x1fc9_670d)] {
            let line = |batch: ClipBatch| {
                let clips = batch.clips.iter().map(|Clip { key, context, target }| {
                    (key, &context.frame_index, &target.frame_index, context.c2w[0].translation[0])
                });
                let skips = batch.skipped.iter().map(|skip| (&skip.key, &skip.reason));
                format!("{} {:?} {:?}", batch.step, clips.collect::<Vec<_>>(), skips.collect::<Vec<_>>())
            };
            let mut checksum = crc32fast::Hasher::new();
            for step in 0..1000 {
                let line = clips.batch(step).map_or_else(|error| error.to_string(), line);
                checksum.update(format!("{line}\n").as_bytes());
            }
            assert_eq!(checksum.finalize(), expected);
        }
    }

    #[test]
    fn batches_are_the_same_with_any_number_of_threads_and_from_any_start() {
        let expected: Vec<ClipBatch> = (0..30).map(|step| mixed().batch(step).unwrap()).collect();
        for threads in [0, 1, 3] {
            for start in [0, 11] {
                let clips = mixed();
                let loader = Prefetcher::new(move |step| clips.batch(step), start, 30, threads, 4);
                let batches: Vec<ClipBatch> = loader.map(|batch| batch.unwrap()).collect();
                assert_eq!(batches, expected[start as usize..], "{threads} threads from step {start}");
            }
        }
    }

    #[test]
    fn a_batch_has_the_same_number_of_views_in_every_clip_and_batches_differ() {
        let clips = clips(vec![200; 40], 5, 9);
        let batches: Vec<ClipBatch> = (0..40).map(|step| clips.batch(step).unwrap()).collect();
        for batch in &batches {
            let counts: BTreeSet<_> =
                batch.clips.iter().map(|clip| (clip.context.num_views(), clip.target.num_views())).collect();
            assert_eq!(counts.len(), 1);
        }
        let counts: BTreeSet<_> = batches.iter().map(|batch| batch.clips[0].context.num_views()).collect();
        assert_eq!(counts, [4, 5, 6].into());
        assert_ne!(batches[0].clips, batches[8].clips);
    }

    #[test]
    fn an_epoch_of_good_scenes_reads_each_once() {
        let clips = clips(vec![200; 40], 5, 9);
        let keys: BTreeSet<String> =
            (0..8).flat_map(|step| clips.batch(step).unwrap().clips).map(|clip| clip.key).collect();
        assert_eq!(keys.len(), 40);
    }

    #[test]
    fn short_scenes_are_replaced_and_listed_with_their_reason() {
        let batches: Vec<ClipBatch> = (0..10).map(|step| mixed().batch(step).unwrap()).collect();
        let skipped: Vec<_> = batches.iter().flat_map(|batch| &batch.skipped).collect();
        let short: BTreeSet<&str> = skipped.iter().map(|scene| scene.key.as_str()).collect();
        assert_eq!(short.len(), 14, "every third of 40 scenes is too short");
        assert!(skipped.iter().all(|scene| scene.reason == "not enough frames: 26 needed, 10 in the scene"));
        for batch in &batches {
            assert_eq!(batch.clips.len(), 4);
            assert!(batch.clips.iter().all(|clip| !short.contains(clip.key.as_str())));
        }
    }

    #[test]
    fn a_replacement_does_not_change_the_other_slots() {
        let good = clips(vec![200; 40], 4, 9);
        let (whole, patched) = (good.batch(3).unwrap(), mixed().batch(3).unwrap());
        let mut same = 0;
        for (whole, patched) in whole.clips.iter().zip(&patched.clips) {
            if whole.key == patched.key {
                assert_eq!(whole, patched);
                same += 1;
            }
        }
        assert!(same >= 1 && !patched.skipped.is_empty(), "{same} slots agree, {:?}", patched.skipped);
    }

    #[test]
    fn the_one_good_scene_among_many_bad_ones_is_found_from_every_step() {
        // Batches of as many slots as there are scenes see one place of each epoch: the worst case of a walk.
        for (num_scenes, batch_size) in [(2, 1), (20, 4), (64, 1), (64, 64)] {
            let lengths = (0..num_scenes).map(|scene| if scene == 1 { 200 } else { 10 }).collect();
            let clips = clips(lengths, batch_size, 9);
            for step in 0..50 {
                let batch = clips.batch(step).unwrap();
                assert!(batch.clips.iter().all(|clip| clip.key == "scene-1"), "{num_scenes} scenes, step {step}");
            }
        }
    }

    #[test]
    fn a_slot_gives_up_after_64_scenes_and_tries_a_single_one_16_times() {
        let tries = |num_scenes| match clips(vec![10; num_scenes], 1, 9).batch(0) {
            Err(DataError::NoUsableScene { attempts, .. }) => attempts,
            other => panic!("{other:?}"),
        };
        assert_eq!([tries(1), tries(1000)], [16, 64]);
        assert!((40..=56).contains(&tries(40)), "{} tries for 40 scenes", tries(40));
    }

    #[test]
    fn a_source_of_short_scenes_fails_naming_the_last_reason() {
        let error = clips(vec![10; 40], 4, 9).batch(2).unwrap_err().to_string();
        assert!(error.starts_with("no usable scene for slot 0 of step 2 in "), "{error}");
        assert!(error.ends_with("failed with: not enough frames: 26 needed, 10 in the scene"), "{error}");
    }

    #[test]
    fn a_sampler_that_cannot_hold_is_refused_at_the_start() {
        let sampler = ViewSampler { num_targets: 0, ..Default::default() };
        let read = |_: usize, _: &ViewIndices| unreachable!("nothing is read");
        let made = TrainingClips::new(Arc::new(Lengths::new(vec![9])), Arc::new(read), sampler, 1, 0);
        assert!(made.unwrap_err().to_string().starts_with("num_targets is 0"));
    }

    #[test]
    fn about_half_of_the_clips_are_flipped_and_the_views_drawn_stay_the_same() {
        let plain: Vec<ClipBatch> = (0..100).map(|step| mixed().batch(step).unwrap()).collect();
        assert_eq!(plain, (0..100).map(|step| mixed().with_flip(false).batch(step).unwrap()).collect::<Vec<_>>());
        let flipped: Vec<ClipBatch> = (0..100).map(|step| mixed().with_flip(true).batch(step).unwrap()).collect();
        assert_eq!(flipped, (0..100).map(|step| mixed().with_flip(true).batch(step).unwrap()).collect::<Vec<_>>());
        let mut num_flipped = 0;
        for (plain, flipped) in plain.iter().zip(&flipped).flat_map(|(a, b)| a.clips.iter().zip(&b.clips)) {
            assert!(*flipped == *plain || *flipped == plain.flipped());
            num_flipped += usize::from(*flipped != *plain);
        }
        assert!((160..240).contains(&num_flipped), "{num_flipped} of 400"); // the deviation is 10
    }
}
