//! Opening the data set of a config.

use std::sync::Arc;

use rayon::prelude::*;

use crate::config::DataConfig;
use crate::error::DataError;
use crate::sampling::clip_reader::{ClipOptions, ClipReader};
use crate::scene_source::{SceneSource, Split};
use crate::skip_report::SkipReport;
use crate::sources::chunks::table::ScanProgress;
use crate::sources::dataset_root::DatasetRoot;
use crate::sources::keys::is_dl3dv_key;
use crate::sources::kind::SourceKind;
use crate::sources::open::{OpenedSource, open_source};
use crate::sources::options::SourceOptions;
use crate::sources::subset::SceneSubset;
use crate::synthetic::config::SyntheticConfig;
use crate::synthetic::source::SyntheticSource;
use clift_core::BadConfig;

/// Opens one split of the data set of a config. With `data.filters`, every chunk is read: of a large data set this can take a
/// minute, in which `progress` is called.
///
/// # Errors
/// The errors of opening the source, [`DataError::BadConfig`] for a missing key, and [`DataError::NoScenes`] when the
/// filters skip every scene.
pub fn open_dataset(config: &DataConfig, split: Split, progress: ScanProgress<'_>) -> Result<OpenedSource, DataError> {
    let opened = match config.source {
        SourceKind::Synthetic => {
            let source = SyntheticSource::new(SyntheticConfig { split, ..config.synthetic.clone() })?;
            let report = SkipReport::new(source.num_scenes());
            OpenedSource { source: Arc::new(source), kind: config.source, shares_scenes: false, report }
        }
        kind => open_files(config, kind, split, progress)?,
    };
    if opened.source.num_scenes() == 0 {
        return Err(DataError::NoScenes { reason: format!("{split}: {}", opened.report) });
    }
    Ok(opened)
}

fn open_files(
    config: &DataConfig,
    kind: SourceKind,
    split: Split,
    progress: ScanProgress<'_>,
) -> Result<OpenedSource, DataError> {
    let missing = |key: &str, fix: &str| BadConfig::new(key, "missing", fix);
    let root = config.root.as_deref();
    let root = root.ok_or_else(|| missing("data.root", "write the folder of the data set or capture"))?;
    let (filters, files) = (config.filters.clone(), config.files.clone());
    let options = SourceOptions {
        kind,
        filters,
        files,
        background: config.background,
        min_size: [config.width.max(config.min_size[0]), config.height.max(config.min_size[1])],
        caches_photos: true,
        reads_chunks: false,
    };
    let mut opened = open_source(&DatasetRoot::find(root)?, split, &options, progress)?;
    let source = &opened.source;
    let has_dl3dv = || (0..source.num_scenes()).any(|scene| is_dl3dv_key(source.key(scene)));
    let is_divided = !opened.shares_scenes || config.files.test_scenes.is_some();
    if split == Split::Train && !is_divided && (opened.kind == SourceKind::Dl3dv || has_dl3dv()) {
        let fix = "the folders also hold the benchmark scenes of DL3DV, which must be excluded from training: write \
                   the path of an evaluation index or of a file with one key per line (an empty file excludes none)";
        return Err(missing("data.files.test_scenes", fix).into());
    }
    if opened.shares_scenes {
        opened.report.notes.push(match config.hold_out {
            0 => "no folders train/ and test/ and no list of test scenes: both splits are the same scenes".into(),
            every => format!("no test split: 1 of {every} frames (0, {every}, ..) is held out of training as a target"),
        });
    }
    Ok(opened)
}

/// Opens the training split as [`open_dataset`] does, without the frames of `data.hold_out` where the data set has no test
/// split, and skips the scenes that are too short for `data.views` at `last_step`, when its gaps are largest.
pub fn open_training_dataset(
    config: &DataConfig,
    last_step: u64,
    progress: ScanProgress<'_>,
) -> Result<OpenedSource, DataError> {
    let mut opened = open_dataset(config, Split::Train, progress)?;
    opened.source = opened.training_source(config.hold_out);
    let source = opened.source.clone();
    let needed = config.views.min_frames(last_step);
    // An unreadable scene is reported when it is sampled.
    let is_short = |scene: &usize| source.num_frames(*scene).is_ok_and(|num_frames| num_frames < needed);
    let (short, long): (Vec<usize>, Vec<usize>) = (0..source.num_scenes()).into_par_iter().partition(is_short);
    if short.is_empty() {
        return Ok(opened);
    }
    let reason = format!("shorter than the {needed} frames that data.views.min_gap needs");
    for scene in short {
        opened.report.skip(source.key(scene), &reason);
    }
    if long.is_empty() {
        return Err(DataError::NoScenes { reason: format!("{}: {}", Split::Train, opened.report) });
    }
    Ok(OpenedSource { source: Arc::new(SceneSubset::new(source, long)), ..opened })
}

/// Returns a reader of the same training clips as `reader`, of the data set of `config`, with half as many columns and rows.
///
/// Images are reduced after they are fitted to the whole size. Synthetic scenes that need no crop are drawn at half the size,
/// which is faster.
///
/// # Errors
/// [`DataError::BadConfig`] for synthetic scenes too small to halve.
pub fn half_size_reader(config: &DataConfig, reader: &ClipReader) -> Result<ClipReader, DataError> {
    let SyntheticConfig { width, height, .. } = config.synthetic;
    let is_even = width.is_multiple_of(2) && height.is_multiple_of(2);
    if config.source == SourceKind::Synthetic && is_even && width * config.height == height * config.width {
        return drawn_reader(&config.at_half_resolution(), reader.source.num_scenes());
    }
    let options = ClipOptions { half_size: true, ..reader.options };
    Ok(ClipReader { source: reader.source.clone(), options })
}

/// Returns a reader of the same training clips as `reader`, of the data set of `config`, with images of another size, and the
/// config with this size.
///
/// Synthetic scenes that need no crop are drawn at that size. Those of `look = "real"` keep the field of view of the longer
/// side, rooms that of the width.
///
/// # Errors
/// [`DataError::BadConfig`] for a size that synthetic scenes cannot have.
pub fn resized_reader(
    config: &DataConfig,
    reader: &ClipReader,
    [width, height]: [usize; 2],
) -> Result<(DataConfig, ClipReader), DataError> {
    let mut resized = DataConfig { width, height, ..config.clone() };
    let drawn = &mut resized.synthetic;
    if config.source == SourceKind::Synthetic && [drawn.width, drawn.height] == [config.width, config.height] {
        [drawn.width, drawn.height] = [width, height];
        let reader = drawn_reader(&resized, reader.source.num_scenes())?;
        return Ok((resized, reader));
    }
    let reader = ClipReader { source: reader.source.clone(), options: resized.clip_options() };
    Ok((resized, reader))
}

/// Returns a reader of the first `num_scenes` synthetic training scenes.
fn drawn_reader(config: &DataConfig, num_scenes: usize) -> Result<ClipReader, DataError> {
    let drawn = SyntheticSource::new(SyntheticConfig { split: Split::Train, ..config.synthetic.clone() })?;
    let source = Arc::new(SceneSubset::first(Arc::new(drawn), num_scenes));
    Ok(ClipReader { source, options: config.clip_options() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::clip::ViewIndices;
    use crate::sampling::view_sampler::ViewSampler;
    use crate::sources::chunks::writer::{SceneRecord, write_chunks};
    use crate::synthetic::config::Look;
    use crate::testing::rooms;

    #[test]
    fn small_synthetic_clips_show_what_reduced_ones_show() {
        let views = ViewIndices { context: vec![0, 7], target: vec![3] };
        let mut data = DataConfig { width: 32, height: 16, ..DataConfig::default() };
        let scene = &mut data.synthetic;
        (scene.num_scenes, scene.num_frames, scene.width, scene.height) = (2, 8, 64, 32);
        let read = |data: &DataConfig| {
            let source = open_dataset(data, Split::Train, &mut |_, _| ()).unwrap().source;
            let reader = ClipReader { source, options: data.clip_options() };
            let half = half_size_reader(data, &reader).unwrap();
            (half.read(1, &views).unwrap(), reader.read(1, &views).unwrap().at_half_resolution())
        };
        let (drawn, reduced) = read(&data);
        assert_eq!((drawn.key, drawn.target.width, drawn.target.height), (reduced.key, 16, 8));
        for (drawn, reduced) in [(&drawn.context, &reduced.context), (&drawn.target, &reduced.target)] {
            assert_eq!((&drawn.cameras, &drawn.frame_index), (&reduced.cameras, &reduced.frame_index));
            let differences = drawn.images.iter().zip(&reduced.images).map(|(a, b)| f64::from(a.abs_diff(*b)));
            let mean = differences.sum::<f64>() / drawn.images.len() as f64;
            assert!(mean < 4.0, "{mean} grey levels");
        }
        assert_ne!(drawn.target.images, reduced.target.images);
        // Half of an odd size or margin would have other intrinsics.
        data.synthetic.height = 36;
        let (read_half, reduced) = read(&data);
        assert_eq!(read_half, reduced);
    }

    #[test]
    fn resized_synthetic_clips_are_drawn_or_cropped() {
        let views = ViewIndices { context: vec![0, 7], target: vec![3] };
        for drawn in [[32, 32], [40, 40]] {
            let mut data = DataConfig { width: 32, height: 32, ..DataConfig::default() };
            let scene = &mut data.synthetic;
            (scene.num_scenes, scene.num_frames, [scene.width, scene.height]) = (2, 8, drawn);
            scene.look = Look::Real;
            let source = open_dataset(&data, Split::Train, &mut |_, _| ()).unwrap().source;
            let reader = ClipReader { source, options: data.clip_options() };
            let whole = reader.read(1, &views).unwrap().target.cameras[0];
            for size in [[40, 24], [24, 40]] {
                let (resized, reader) = resized_reader(&data, &reader, size).unwrap();
                assert_eq!([resized.width, resized.height], size);
                let target = reader.read(1, &views).unwrap().target;
                assert_eq!([target.width, target.height], size);
                let (camera, longer) = (target.cameras[0], 40.0 / 32.0);
                assert_eq!(camera.c2w, whole.c2w);
                // Drawn frames have the field of view along the longer side, cropped ones are resized to it.
                let expected = whole.intrinsics.fx * longer;
                assert!((camera.intrinsics.fx - expected).abs() < 1e-4 * expected, "{camera:?}");
                assert!((camera.intrinsics.fx / camera.intrinsics.fy - 1.0).abs() < 1e-4, "{camera:?}");
            }
        }
    }

    #[test]
    fn training_skips_scenes_too_short_for_its_last_step() {
        let rooms = rooms(|c| (c.num_scenes, c.num_frames) = (2, 8));
        let folder = tempfile::tempdir().unwrap();
        let record = |(scene, num_frames): (usize, usize)| {
            Ok(SceneRecord {
                key: format!("of-{num_frames}"),
                cameras: rooms.cameras(scene)?[..num_frames].to_vec(),
                images: vec![vec![0]; num_frames],
            })
        };
        for split in [Split::Train, Split::Test] {
            let split_folder = folder.path().join(split.to_string());
            write_chunks(&split_folder, [(0, 4), (1, 5), (0, 8)].into_iter().map(record), 1).unwrap();
        }
        // Over four steps, the gap of four contexts grows from 3 to 5 frames; two contexts lie half as far apart.
        let views = ViewSampler {
            min_context: 2,
            max_context: 4,
            min_gap: [3, 5],
            max_gap: [4, 6],
            warm_up_steps: 4,
            ..Default::default()
        };
        let mut data = DataConfig { views, source: SourceKind::Chunks, ..DataConfig::default() };
        data.root = Some(folder.path().to_owned());
        assert_eq!(open_training_dataset(&data, 0, &mut |_, _| ()).unwrap().source.num_scenes(), 3);
        let OpenedSource { source, report, .. } = open_training_dataset(&data, 2, &mut |_, _| ()).unwrap();
        assert_eq!((source.num_scenes(), source.key(0), source.find("of-8")), (2, "of-5", Some(1)));
        let expected = "2 of 3 scenes used; 1 shorter than the 5 frames that data.views.min_gap needs";
        assert_eq!(report.to_string(), expected);
        assert_eq!(report.skips[0].key, "of-4");
        let OpenedSource { source, report, .. } = open_training_dataset(&data, 4, &mut |_, _| ()).unwrap();
        assert_eq!((source.num_scenes(), source.key(0)), (1, "of-8"));
        assert!(report.to_string().contains("2 shorter than the 6 frames"), "{report}");
        data.views = ViewSampler { min_gap: [9, 9], max_gap: [9, 9], ..Default::default() };
        let message = open_training_dataset(&data, 0, &mut |_, _| ()).err().unwrap().to_string();
        assert!(message.contains("train: 0 of 3 scenes used; 3 shorter than the 10 frames"), "{message}");
    }
}
