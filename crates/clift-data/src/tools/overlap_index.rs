//! An evaluation index for one's own data, drawn as pixelSplat's was: pairs of frames that overlap.

use std::collections::HashMap;
use std::path::Path;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::error::DataError;
use crate::geometry::camera::Camera;
use crate::geometry::overlap::overlap;
use crate::random::{between, derive_seed, sample_distinct, sample_from, step_rng};
use crate::sampling::clip::ViewIndices;
use crate::scene_source::SceneSource;
use crate::skip_report::{SkipReport, first_few, plural};
use crate::tools::export::write_index;

/// What an index asks for. The defaults are those of the published RealEstate10K index with four contexts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OverlapOptions {
    /// Context frames per scene, at least 2.
    pub num_context: usize,
    /// Target frames per scene, at least 1.
    pub num_targets: usize,
    /// Fewest and most frames from the first context to the last.
    pub distance: [usize; 2],
    /// Least [`overlap`] of the first and the last context, in both directions.
    pub min_overlap: f64,
    /// Decides which of the possible frames are taken.
    pub seed: u64,
}

impl Default for OverlapOptions {
    fn default() -> Self {
        Self { num_context: 4, num_targets: 3, distance: [45, 135], min_overlap: 0.6, seed: 123 }
    }
}

impl OverlapOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`DataError::BadConfig`] naming the field that cannot hold.
    pub fn validate(&self) -> Result<(), DataError> {
        let fail = |key: &str, problem: String| Err(DataError::bad_config(key, problem));
        let Self { num_context, num_targets, distance: [near, far], min_overlap, .. } = *self;
        if !(2..=10_000).contains(&num_context) {
            return fail("num_context", format!("is {num_context}; use 2 or more"));
        }
        if near + 1 < num_context || far < near {
            let problem =
                format!("is {near} to {far}; {num_context} contexts lie {} frames or more apart", num_context - 1);
            return fail("distance", problem);
        }
        if num_targets == 0 || num_targets > near + 1 {
            return fail("num_targets", format!("is {num_targets}; a stretch has as few as {} frames", near + 1));
        }
        if !(0.0..=1.0).contains(&min_overlap) {
            return fail("min_overlap", format!("is {min_overlap}; use 0 to 1"));
        }
        Ok(())
    }

    /// Draws the views of a scene: a frame at random, a partner at random among those that follow it in steps of one
    /// from the smallest distance on, in both directions, while the overlap lasts; the next frame at random where none
    /// does. Targets are distinct, from the first context to the last, contexts included, in increasing order. Inner
    /// contexts are distinct and uniform. The error is a reason for the report.
    fn sample_views(&self, key: &str, cameras: &[Camera]) -> Result<ViewIndices, String> {
        let num_frames = cameras.len();
        let [near, far] = self.distance;
        if num_frames <= near {
            return Err(format!("shorter than {} frames", near + 1));
        }
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
            let partner = partners[between(&mut rng, 0, partners.len() - 1)];
            let (left, right) = (frame.min(partner), frame.max(partner));
            let mut target = sample_from(&mut rng, (left..=right).collect(), self.num_targets);
            target.sort_unstable();
            let inner = sample_distinct(&mut rng, right - left - 1, self.num_context - 2);
            let inner = inner.into_iter().map(|offset| left + 1 + offset);
            let context = [left].into_iter().chain(inner).chain([right]).collect();
            return Ok(ViewIndices { context, target });
        }
        Err(format!("without two frames {near} to {far} apart that overlap by {}", self.min_overlap))
    }
}

/// Writes an index of every scene of `sources` that [`EvaluationIndex`](crate::sampling::evaluation_index::EvaluationIndex) reads, `null` for
/// scenes without such views; nothing if no scene has any. The report says which and why. A scene's views depend on its
/// cameras, its key and the seed alone: other scenes may come and go.
///
/// # Errors
/// [`DataError::BadConfig`] for options that cannot hold, [`DataError::BadIndex`] for a key that two sources have with
/// different cameras, and [`DataError::Io`]. A scene whose cameras cannot be read is in the report.
pub fn write_overlap_index(
    path: &Path,
    sources: &[&dyn SceneSource],
    options: &OverlapOptions,
) -> Result<SkipReport, DataError> {
    options.validate()?;
    let mut scenes: Vec<(&dyn SceneSource, usize)> = Vec::new();
    let mut places: HashMap<&str, usize> = HashMap::new();
    let mut shared = Vec::new();
    for (source, scene) in sources.iter().flat_map(|source| (0..source.num_scenes()).map(|scene| (*source, scene))) {
        let key = source.key(scene);
        let place = *places.entry(key).or_insert(scenes.len());
        let Some(&(other, other_scene)) = scenes.get(place) else {
            scenes.push((source, scene));
            continue;
        };
        match (other.cameras(other_scene), source.cameras(scene)) {
            (Ok(a), Ok(b)) if a != b => {
                let what = format!("scene {key} is in both halves with other cameras; make an index of each");
                return Err(DataError::BadIndex { what, path: path.to_owned() });
            }
            (Err(_), Ok(_)) => scenes[place] = (source, scene),
            _ => {}
        }
        shared.push(key);
    }
    let note = |shared: &[&str]| {
        format!("{} in both halves, counted once ({})", plural(shared.len(), "scene"), first_few(shared))
    };
    let notes = (!shared.is_empty()).then(|| note(&shared)).into_iter().collect();
    let draw = |(source, scene): &(&dyn SceneSource, usize)| {
        let cameras = source.cameras(*scene).map_err(|error| error.to_string())?;
        options.sample_views(source.key(*scene), &cameras)
    };
    let drawn: Vec<_> = scenes.par_iter().map(draw).collect();
    let mut report = SkipReport { notes, ..SkipReport::new(drawn.len()) };
    let mut entries = Vec::with_capacity(drawn.len());
    for ((source, scene), views) in scenes.into_iter().zip(drawn) {
        let key = source.key(scene);
        let views = views.map_err(|reason| report.skip(key, reason)).ok();
        entries.push((key, views));
    }
    // Nothing to evaluate is no index.
    if report.num_used() > 0 {
        write_index(path, entries)?;
    }
    Ok(report)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::evaluation_index::EvaluationIndex;
    use crate::synthetic::config::SyntheticConfig;
    use crate::synthetic::source::SyntheticSource;
    use crate::testing::TestSource;

    fn rooms(num_frames: usize, path_length: f64) -> SyntheticSource {
        let config = SyntheticConfig { num_scenes: 20, num_frames, path_length, ..Default::default() };
        SyntheticSource::new(config).unwrap()
    }

    fn index(source: &dyn SceneSource, options: &OverlapOptions) -> (EvaluationIndex, SkipReport) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index.json");
        let report = write_overlap_index(&path, &[source], options).unwrap();
        (EvaluationIndex::read(&path).unwrap(), report)
    }

    #[test]
    fn every_pair_of_the_index_overlaps_and_lies_as_far_apart_as_asked() {
        let source = rooms(60, 3.0);
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
            let (a, b) = (&cameras[left], &cameras[right]);
            assert!(overlap(a, b) >= 0.6 && overlap(b, a) >= 0.6);
            spans.push(right - left);
        }
        spans.sort_unstable();
        assert!(spans[0] < spans[spans.len() - 1], "not always the nearest: {spans:?}");
    }

    #[test]
    fn scenes_without_views_are_null_and_in_the_ledger() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index.json");
        let report = write_overlap_index(&path, &[&rooms(40, 3.0)], &OverlapOptions::default()).unwrap();
        assert_eq!(report.to_string(), "0 of 20 scenes used; 20 shorter than 46 frames");
        assert!(!path.exists(), "an index without views");
        let (written, report) = index(&first_is_short(rooms(60, 3.0)), &OverlapOptions::default());
        assert_eq!((written.num_keys(), written.usable().count()), (20, 19));
        assert_eq!(report.to_string(), "19 of 20 scenes used; 1 shorter than 46 frames");
    }

    /// Rooms of which the first has ten frames.
    fn first_is_short(rooms: SyntheticSource) -> TestSource {
        TestSource::new(rooms).with_cameras(|scene, mut cameras| {
            cameras.truncate(if scene == 0 { 10 } else { usize::MAX });
            Ok(cameras)
        })
    }

    #[test]
    fn a_camera_that_turns_away_has_pairs_only_as_far_apart_as_it_still_sees_the_same() {
        // 75 degrees wide, three degrees per frame: half of the view is left after some 12 frames, nothing after 25.
        let intrinsics_norm = crate::geometry::camera::IntrinsicsNorm { fx: 0.65, fy: 0.65, cx: 0.5, cy: 0.5 };
        let camera = |frame: usize| {
            let rotation = crate::DMat3::from_rotation_y((3.0 * frame as f64).to_radians());
            Camera {
                intrinsics_norm,
                c2w: crate::geometry::pose::Pose { rotation, ..crate::geometry::pose::Pose::IDENTITY },
            }
        };
        let cameras: Vec<Camera> = (0..60).map(camera).collect();
        let options = |near, far| OverlapOptions { distance: [near, far], ..OverlapOptions::default() };
        for key in ["a", "b", "c", "d", "e", "f"] {
            let ViewIndices { context, .. } = options(4, 50).sample_views(key, &cameras).unwrap();
            assert!((4..=12).contains(&(context[3] - context[0])), "{context:?}");
        }
        let reason = options(20, 50).sample_views("a", &cameras).unwrap_err();
        assert_eq!(reason, "without two frames 20 to 50 apart that overlap by 0.6");
    }

    #[test]
    fn views_depend_on_the_seed_and_not_on_the_other_scenes() {
        let options = OverlapOptions { distance: [8, 30], ..OverlapOptions::default() };
        let views = |source: &SyntheticSource, options: &OverlapOptions| {
            index(source, options).0.usable().map(|(key, views)| (key.to_owned(), views.clone())).collect::<Vec<_>>()
        };
        let all = views(&rooms(60, 3.0), &options);
        assert_eq!(all, views(&rooms(60, 3.0), &options));
        let fewer = SyntheticConfig { num_scenes: 5, num_frames: 60, path_length: 3.0, ..Default::default() };
        let fewer = views(&SyntheticSource::new(fewer).unwrap(), &options);
        assert_eq!(fewer[..], all[..fewer.len()]);
        assert_ne!(all, views(&rooms(60, 3.0), &OverlapOptions { seed: 5, ..options }));
    }

    #[test]
    fn an_index_of_two_halves_has_the_scenes_of_both_and_a_shared_one_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index.json");
        let options = OverlapOptions { distance: [8, 30], ..OverlapOptions::default() };
        let other = SyntheticConfig { num_scenes: 3, num_frames: 60, seed: 1, path_length: 3.0, ..Default::default() };
        let other = SyntheticSource::new(other).unwrap();
        let report = write_overlap_index(&path, &[&rooms(60, 3.0), &other], &options).unwrap();
        let written = EvaluationIndex::read(&path).unwrap();
        assert_eq!((report.num_scenes, written.num_keys()), (23, 23));
        let alone = index(&other, &options).0;
        for scene in 0..3 {
            let key = other.key(scene);
            assert_eq!(written.views(key, 60).unwrap(), alone.views(key, 60).unwrap());
        }
        let report = write_overlap_index(&path, &[&other, &other], &options).unwrap();
        assert_eq!(report.num_scenes, 3);
        let keys = [0, 1, 2].map(|scene| other.key(scene)).join(", ");
        assert_eq!(report.notes, [format!("3 scenes in both halves, counted once ({keys})")]);
        let rooms = rooms(60, 3.0);
        let shorter = first_is_short(self::rooms(60, 3.0));
        let message = write_overlap_index(&path, &[&rooms, &shorter], &options).unwrap_err().to_string();
        assert!(message.contains("is in both halves with other cameras; make an index of each"), "{message}");
    }

    #[test]
    fn of_a_shared_scene_the_half_counts_that_can_be_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index.json");
        let options = OverlapOptions { distance: [8, 30], ..OverlapOptions::default() };
        let whole = rooms(60, 3.0);
        let broken = TestSource::new(rooms(60, 3.0))
            .with_cameras(|scene, _| Err(DataError::NoSuchScene { scene, num_scenes: 0 }));
        let num_used = index(&whole, &options).1.num_used();
        let orders: [[&dyn SceneSource; 2]; 2] = [[&whole, &broken], [&broken, &whole]];
        for sources in orders {
            let report = write_overlap_index(&path, &sources, &options).unwrap();
            assert_eq!((report.num_used(), report.notes.len()), (num_used, 1), "{report}");
        }
        let report = write_overlap_index(&path, &[&broken, &broken], &options).unwrap();
        assert_eq!((report.num_used(), report.skips.len()), (0, 20), "{report}");
    }

    #[test]
    fn options_that_cannot_hold_are_named() {
        let check = |options: OverlapOptions| options.validate().unwrap_err().to_string();
        let valid = OverlapOptions::default;
        assert!(check(OverlapOptions { num_context: 1, ..valid() }).starts_with("num_context is 1"));
        assert!(check(OverlapOptions { num_targets: 0, ..valid() }).starts_with("num_targets is 0"));
        assert!(check(OverlapOptions { num_targets: 47, ..valid() }).starts_with("num_targets is 47"));
        assert!(
            check(OverlapOptions { distance: [2, 9], ..valid() }).contains("4 contexts lie 3 frames or more apart")
        );
        assert!(check(OverlapOptions { distance: [9, 8], ..valid() }).starts_with("distance is 9 to 8"));
        assert!(check(OverlapOptions { min_overlap: f64::NAN, ..valid() }).starts_with("min_overlap is NaN"));
    }
}
