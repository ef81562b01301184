//! Evaluation indices of own data, sampled like pixelSplat's: pairs of frames that overlap.

use std::collections::HashSet;
use std::path::Path;

use clift_core::{
    BadConfig, Camera, IntrinsicsNorm, check_config, derive_seed, sample_distinct, sample_from, step_rng,
    uniform_between,
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::error::DataError;
use crate::geometry::overlap::overlap;
use crate::sampling::clip::ViewIndices;
use crate::scene_source::SceneSource;
use crate::skip_report::SkipReport;
use crate::tools::export::write_index;

/// Options of an overlap index. The defaults are those of the published RealEstate10K index with four contexts, except
/// that no target is a context.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OverlapOptions {
    /// Number of context frames per scene, at least 2.
    pub num_context: usize,
    /// Number of target frames per scene, at least 1.
    pub num_targets: usize,
    /// Smallest and largest gap between the first and the last context frame.
    pub distance: [usize; 2],
    /// Smallest [`overlap`] of the first and the last context, in both directions.
    pub min_overlap: f64,
    /// Whether a target may also be a context, as in the published index. The input holds the image of such a target.
    pub context_targets: bool,
    /// Seed of the selection among the possible frames.
    pub seed: u64,
}

impl Default for OverlapOptions {
    fn default() -> Self {
        Self {
            num_context: 4,
            num_targets: 3,
            distance: [45, 135],
            min_overlap: 0.6,
            context_targets: false,
            seed: 123,
        }
    }
}

impl OverlapOptions {
    /// Checks every field.
    pub fn validate(&self) -> Result<(), BadConfig> {
        let Self { num_context, num_targets, distance: [near, far], min_overlap, .. } = *self;
        check_config((2..=10_000).contains(&num_context), "num_context", num_context, || "use 2 or more".into())?;
        let least = num_context - usize::from(self.context_targets);
        let distance = format!("{near} to {far}");
        check_config(far >= near, "distance", &distance, || "write the smaller number first".into())?;
        check_config(near >= least, "distance", distance, || {
            format!("{num_context} contexts and a target need a gap of {least} or more")
        })?;
        let (most, frames) = if self.context_targets {
            (near + 1, "the frames of the smallest gap")
        } else {
            (near + 1 - num_context, "the frames of the smallest gap that are not context views")
        };
        check_config((1..=most).contains(&num_targets), "num_targets", num_targets, || {
            format!("use 1 to {most}, {frames}")
        })?;
        check_config((0.0..=1.0).contains(&min_overlap), "min_overlap", min_overlap, || "use 0 to 1".into())
    }

    /// Samples the views of a scene, or returns the reason for the skip report.
    ///
    /// Frames are visited in random order. The partner of a frame is uniform among the frames at increasing distance, in
    /// both directions, up to the first without enough overlap. The first frame with a partner is used. Targets are
    /// distinct and sorted; inner contexts are distinct and uniform.
    fn sample_views(&self, key: &str, cameras: &[Camera<IntrinsicsNorm>]) -> Result<ViewIndices, String> {
        let num_frames = cameras.len();
        let [near, far] = self.distance;
        if num_frames <= near {
            return Err(format!("shorter than {} frames", near + 1));
        }
        let far = far.min(num_frames);
        let mut rng = step_rng(derive_seed(self.seed, key), 0, "evaluation index");
        for frame in sample_from(&mut rng, (0..num_frames).collect(), num_frames) {
            let overlaps = |partner: &usize| {
                let (a, b) = (&cameras[frame], &cameras[*partner]);
                overlap(a, b).min(overlap(b, a)) >= self.min_overlap
            };
            let after = (frame + near..num_frames.min(frame + far + 1)).take_while(overlaps);
            let before = (near..=far.min(frame)).map(|distance| frame - distance).take_while(overlaps);
            let partners: Vec<usize> = after.chain(before).collect();
            if partners.is_empty() {
                continue;
            }
            let partner = partners[uniform_between(&mut rng, 0, partners.len() - 1)];
            let (left, right) = (frame.min(partner), frame.max(partner));
            let inner = sample_distinct(&mut rng, right - left - 1, self.num_context - 2);
            let inner = inner.into_iter().map(|offset| left + 1 + offset);
            let context: Vec<usize> = [left].into_iter().chain(inner).chain([right]).collect();
            let candidates = (left..=right).filter(|frame| self.context_targets || !context.contains(frame));
            let mut target = sample_from(&mut rng, candidates.collect(), self.num_targets);
            target.sort_unstable();
            return Ok(ViewIndices { context, target });
        }
        Err(format!("without two frames {near} to {far} apart that overlap by {}", self.min_overlap))
    }
}

/// Writes an evaluation index of every scene of `sources`, `null` for scenes without overlapping frames.
///
/// No file is written if no scene has views. The report lists the scenes without views and the reasons. The views of a
/// scene depend only on the cameras, the key and the seed.
///
/// # Errors
/// [`DataError::BadConfig`] for invalid options, [`DataError::BadIndex`] for a key that two sources have, and
/// [`DataError::Io`]. Scenes with unreadable cameras are skipped.
pub fn write_overlap_index(
    path: &Path,
    sources: &[&dyn SceneSource],
    options: &OverlapOptions,
) -> Result<SkipReport, DataError> {
    options.validate()?;
    let scenes = sources.iter().flat_map(|source| (0..source.num_scenes()).map(|scene| (*source, scene)));
    let scenes: Vec<(&dyn SceneSource, usize)> = scenes.collect();
    let mut keys = HashSet::new();
    if let Some((source, scene)) = scenes.iter().find(|(source, scene)| !keys.insert(source.key(*scene))) {
        let what = format!("scene {} is in both splits; make one index per split", source.key(*scene));
        return Err(DataError::BadIndex { what, path: path.to_owned() });
    }
    let sample = |(source, scene): &(&dyn SceneSource, usize)| {
        let cameras = source.cameras(*scene).map_err(|error| error.to_string())?;
        options.sample_views(source.key(*scene), &cameras)
    };
    let sampled: Vec<_> = scenes.par_iter().map(sample).collect();
    let mut report = SkipReport::new(sampled.len());
    let mut entries = Vec::with_capacity(sampled.len());
    for ((source, scene), views) in scenes.into_iter().zip(sampled) {
        let key = source.key(scene);
        let views = views.map_err(|reason| report.skip(key, reason)).ok();
        entries.push((key, views));
    }
    if report.num_used() > 0 {
        write_index(path, entries)?;
    }
    Ok(report)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::evaluation_index::EvaluationIndex;
    use crate::synthetic::source::SyntheticSource;
    use crate::testing::{self, TestSource};
    use clift_core::Pose;
    use glam::DMat3;

    fn rooms(num_scenes: usize) -> SyntheticSource {
        testing::rooms(|c| (c.num_scenes, c.num_frames, c.path_length) = (num_scenes, 60, 3.0))
    }

    fn index(source: &dyn SceneSource, options: &OverlapOptions) -> (EvaluationIndex, SkipReport) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index.json");
        let report = write_overlap_index(&path, &[source], options).unwrap();
        (EvaluationIndex::read(&path).unwrap(), report)
    }

    #[test]
    fn every_pair_overlaps_at_an_allowed_distance() {
        let source = rooms(20);
        let options = OverlapOptions { distance: [8, 30], ..OverlapOptions::default() };
        let (written, report) = index(&source, &options);
        let (items, _) = written.select(&source, 0);
        assert!(items.len() > 10 && items.len() == report.num_used(), "{report}");
        let mut spans = Vec::new();
        for item in &items {
            let ViewIndices { context, target } = &item.views;
            let cameras = source.cameras(item.scene).unwrap();
            assert_eq!((context.len(), target.len()), (4, 3));
            assert!(context.is_sorted_by(|a, b| a < b) && target.is_sorted_by(|a, b| a < b));
            let (left, right) = (context[0], context[3]);
            assert!((8..=30).contains(&(right - left)) && target.iter().all(|frame| (left..=right).contains(frame)));
            assert_eq!(item.views.num_context_targets(), 0);
            let (a, b) = (&cameras[left], &cameras[right]);
            assert!(overlap(a, b) >= 0.6 && overlap(b, a) >= 0.6);
            spans.push(right - left);
        }
        let published = index(&source, &OverlapOptions { context_targets: true, ..options }).0;
        assert!(published.usable().any(|(_, views)| views.num_context_targets() > 0));
        spans.sort_unstable();
        assert!(spans[0] < spans[spans.len() - 1], "not always the nearest: {spans:?}");
    }

    #[test]
    fn scenes_without_views_are_null_and_reported() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index.json");
        let short = testing::rooms(|c| (c.num_scenes, c.num_frames) = (20, 40));
        let report = write_overlap_index(&path, &[&short], &OverlapOptions::default()).unwrap();
        assert_eq!(report.to_string(), "0 of 20 scenes used; 20 shorter than 46 frames");
        assert!(!path.exists(), "an index without views");
        let (written, report) = index(&first_is_short(rooms(20)), &OverlapOptions::default());
        assert_eq!((written.num_keys(), written.usable().count()), (20, 19));
        assert_eq!(report.to_string(), "19 of 20 scenes used; 1 shorter than 46 frames");
    }

    fn first_is_short(rooms: SyntheticSource) -> TestSource {
        TestSource::new(rooms).with_cameras(|scene, mut cameras| {
            cameras.truncate(if scene == 0 { 10 } else { usize::MAX });
            Ok(cameras)
        })
    }

    #[test]
    fn turning_camera_has_only_pairs_with_overlap() {
        // 75 degrees wide, three degrees per frame: half of the view is left after some 12 frames, nothing after 25.
        let intrinsics_norm = IntrinsicsNorm { fx: 0.65, fy: 0.65, cx: 0.5, cy: 0.5 };
        let camera = |frame: usize| {
            let rotation = DMat3::from_rotation_y((3.0 * frame as f64).to_radians());
            Camera { intrinsics: intrinsics_norm, c2w: Pose { rotation, ..Pose::IDENTITY } }
        };
        let cameras: Vec<Camera<IntrinsicsNorm>> = (0..60).map(camera).collect();
        let options = |near, far| OverlapOptions { num_targets: 1, distance: [near, far], ..OverlapOptions::default() };
        for key in ["a", "b", "c", "d", "e", "f"] {
            let ViewIndices { context, .. } = options(4, 50).sample_views(key, &cameras).unwrap();
            assert!((4..=12).contains(&(context[3] - context[0])), "{context:?}");
        }
        let reason = options(20, 50).sample_views("a", &cameras).unwrap_err();
        assert_eq!(reason, "without two frames 20 to 50 apart that overlap by 0.6");
    }

    #[test]
    fn views_do_not_depend_on_other_scenes() {
        let options = OverlapOptions { distance: [8, 30], ..OverlapOptions::default() };
        let views = |source: &SyntheticSource, options: &OverlapOptions| {
            index(source, options).0.usable().map(|(key, views)| (key.to_owned(), views.clone())).collect::<Vec<_>>()
        };
        let all = views(&rooms(20), &options);
        assert_eq!(all, views(&rooms(20), &options));
        let fewer = views(&rooms(5), &options);
        assert_eq!(fewer[..], all[..fewer.len()]);
        assert_ne!(all, views(&rooms(20), &OverlapOptions { seed: 5, ..options }));
    }

    #[test]
    fn index_of_two_splits_has_all_scenes_and_refuses_shared_ones() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index.json");
        let options = OverlapOptions { distance: [8, 30], ..OverlapOptions::default() };
        let other = testing::rooms(|c| (c.seed, c.num_scenes, c.num_frames, c.path_length) = (1, 3, 60, 3.0));
        let report = write_overlap_index(&path, &[&rooms(20), &other], &options).unwrap();
        let written = EvaluationIndex::read(&path).unwrap();
        assert_eq!((report.num_scenes, written.num_keys()), (23, 23));
        let alone = index(&other, &options).0;
        let of_other = written.usable().filter(|(key, _)| other.find(key).is_some());
        assert!(of_other.eq(alone.usable()));
        let message = write_overlap_index(&path, &[&other, &other], &options).unwrap_err().to_string();
        assert!(message.contains("-00000 is in both splits; make one index per split"), "{message}");
    }

    #[test]
    fn invalid_option_is_named() {
        let valid = OverlapOptions::default;
        for (options, expected) in [
            (OverlapOptions { num_context: 1, ..valid() }, "`num_context` = 1"),
            (OverlapOptions { num_targets: 0, ..valid() }, "`num_targets` = 0"),
            (OverlapOptions { num_targets: 43, ..valid() }, "`num_targets` = 43: use 1 to 42, "),
            (OverlapOptions { num_targets: 47, ..valid() }, "`num_targets` = 47"),
            (
                OverlapOptions { distance: [2, 9], ..valid() },
                "`distance` = 2 to 9: 4 contexts and a target need a gap of 4 or more",
            ),
            (OverlapOptions { distance: [9, 8], ..valid() }, "`distance` = 9 to 8"),
            (OverlapOptions { min_overlap: f64::NAN, ..valid() }, "`min_overlap` = NaN"),
        ] {
            let message = options.validate().unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }
}
