//! Evaluation indices of own data, sampled like pixelSplat's: pairs of frames that overlap.

use std::collections::HashSet;
use std::path::Path;

use clift_core::{
    BadConfig, Camera, IntrinsicsNorm, check_config, derive_seed, sample_distinct, sample_from, step_rng,
    uniform_between,
};
use rayon::prelude::*;

use crate::error::DataError;
use crate::geometry::overlap::overlap;
use crate::sampling::clip::ViewIndices;
use crate::scene_source::SceneSource;
use crate::skip_report::SkipReport;
use crate::tools::export::write_index;

/// Options of an overlap index. The defaults are those of the published RealEstate10K index with four contexts, except
/// that no target is a context.
#[derive(Clone, Debug)]
pub struct OverlapOptions {
    /// Number of context frames per scene, at least 2.
    pub num_context: usize,
    /// Number of target frames per scene, at least 1.
    pub num_targets: usize,
    /// Smallest and largest gap between the first and the last context frame.
    pub distance: [usize; 2],
    /// Smallest [`overlap`] of the first and the last context, in both directions.
    pub min_overlap: f64,
    /// Seed of the selection among the possible frames.
    pub seed: u64,
}

impl Default for OverlapOptions {
    fn default() -> Self {
        Self { num_context: 4, num_targets: 3, distance: [45, 135], min_overlap: 0.6, seed: 123 }
    }
}

impl OverlapOptions {
    /// Checks every field.
    pub fn validate(&self) -> Result<(), BadConfig> {
        let Self { num_context, num_targets, distance: [near, far], min_overlap, .. } = *self;
        check_config((2..=10_000).contains(&num_context), "num_context", num_context, || "use 2 or more".into())?;
        let distance = format!("{near} to {far}");
        check_config(far >= near, "distance", &distance, || "write the smaller number first".into())?;
        check_config(near >= num_context, "distance", distance, || {
            format!("{num_context} contexts and a target need a gap of {num_context} or more")
        })?;
        let most = near + 1 - num_context;
        check_config((1..=most).contains(&num_targets), "num_targets", num_targets, || {
            format!("use 1 to {most}, the frames of the smallest gap that are not context views")
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
            let candidates = (left..=right).filter(|frame| !context.contains(frame));
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
    use crate::testing;

    #[test]
    fn every_pair_overlaps_at_an_allowed_distance() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index.json");
        let source = testing::rooms(|c| (c.num_scenes, c.num_frames, c.path_length) = (20, 60, 3.0));
        let options = OverlapOptions { distance: [8, 30], ..OverlapOptions::default() };
        let short = testing::rooms(|c| (c.num_scenes, c.num_frames) = (20, 40));
        let report = write_overlap_index(&path, &[&short], &OverlapOptions::default()).unwrap();
        assert_eq!(report.to_string(), "0 of 20 scenes used; 20 shorter than 46 frames");
        assert!(!path.exists());
        let report = write_overlap_index(&path, &[&source], &options).unwrap();
        let (items, _) = EvaluationIndex::read(&path).unwrap().select(&source, 0);
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
        spans.sort_unstable();
        assert!(spans[0] < spans[spans.len() - 1], "not always the nearest: {spans:?}");
        let message = write_overlap_index(&path, &[&source, &source], &options).unwrap_err().to_string();
        assert!(message.contains("-00000 is in both splits; make one index per split"), "{message}");
    }

    #[test]
    fn invalid_option_is_named() {
        let valid = OverlapOptions::default;
        for (options, expected) in [
            (OverlapOptions { num_context: 1, ..valid() }, "`num_context` = 1"),
            (OverlapOptions { num_targets: 0, ..valid() }, "`num_targets` = 0"),
            (OverlapOptions { num_targets: 43, ..valid() }, "`num_targets` = 43: use 1 to 42, "),
            (OverlapOptions { distance: [2, 9], ..valid() }, "`distance` = 2 to 9: 4 contexts and a target need"),
            (OverlapOptions { distance: [9, 8], ..valid() }, "`distance` = 9 to 8"),
            (OverlapOptions { min_overlap: f64::NAN, ..valid() }, "`min_overlap` = NaN"),
        ] {
            let message = options.validate().unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }
}
