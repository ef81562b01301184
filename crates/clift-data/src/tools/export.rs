//! Writes the scenes of any source as chunks, and an evaluation index beside them.

use std::collections::BTreeMap;
use std::path::Path;

use rayon::prelude::*;
use serde::Serialize;

use crate::error::DataError;
use crate::files::atomic::replace_file;
use crate::image::codec::{encode_jpeg, encode_png};
use crate::image::rgb_image::RgbImage;
use crate::sampling::clip::ViewIndices;
use crate::sampling::evaluation_index::even_views;
use crate::scene_source::SceneSource;
use crate::sources::chunks::writer::{SceneRecord, write_chunks};

/// How frames are stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ImageEncoding {
    /// Without loss.
    #[default]
    Png,
    /// With a quality in `1..=100`.
    Jpeg(u8),
}

impl ImageEncoding {
    pub(crate) fn encode(self, frame: &RgbImage) -> Result<Vec<u8>, DataError> {
        match self {
            Self::Png => encode_png(frame),
            Self::Jpeg(quality) => encode_jpeg(frame, quality),
        }
    }
}

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Written {
    /// Scenes.
    pub num_scenes: usize,
    /// Frames of all scenes.
    pub num_frames: usize,
    /// Bytes of the encoded frames.
    pub image_bytes: u64,
}

/// Writes every scene of `source` into `folder` as [`write_chunks`] does. Time stamps are frame numbers.
///
/// `written` is told how many scenes are ready after each one. Frames of a scene are read on all cores.
///
/// # Errors
/// Whatever reading a scene, encoding a frame and [`write_chunks`] give.
pub fn write_source(
    source: &dyn SceneSource,
    folder: &Path,
    encoding: ImageEncoding,
    target_bytes: u64,
    mut written: impl FnMut(usize),
) -> Result<Written, DataError> {
    let mut total = Written::default();
    let scenes = (0..source.num_scenes()).map(|scene| {
        let cameras = source.cameras(scene)?;
        let images: Vec<Vec<u8>> = (0..cameras.len())
            .into_par_iter()
            .map(|frame| encoding.encode(&source.frame(scene, frame)?))
            .collect::<Result<_, _>>()?;
        total.num_scenes += 1;
        total.num_frames += images.len();
        total.image_bytes += images.iter().map(|image| image.len() as u64).sum::<u64>();
        written(total.num_scenes);
        let timestamps = (0..images.len() as i64).collect();
        Ok(SceneRecord { key: source.key(scene).to_owned(), url: String::new(), timestamps, cameras, images })
    });
    write_chunks(folder, scenes, target_bytes)?;
    Ok(total)
}

/// Writes an evaluation index of every scene of `source`, with the views of [`even_views`] (`null` where there are
/// too few frames); returns how many scenes have views.
///
/// # Errors
/// Whatever reading cameras gives, and [`DataError::Io`].
pub fn write_evaluation_index(
    path: &Path,
    source: &dyn SceneSource,
    num_context: usize,
    num_targets: usize,
) -> Result<usize, DataError> {
    let mut entries = Vec::with_capacity(source.num_scenes());
    for scene in 0..source.num_scenes() {
        let views = even_views(source.num_frames(scene)?, num_context, num_targets);
        entries.push((source.key(scene), views));
    }
    let num_usable = entries.iter().filter(|(_, views)| views.is_some()).count();
    write_index(path, entries)?;
    Ok(num_usable)
}

/// Writes an index that [`EvaluationIndex`](crate::sampling::evaluation_index::EvaluationIndex) reads, sorted by key.
pub(crate) fn write_index<'a>(
    path: &Path,
    entries: impl IntoIterator<Item = (&'a str, Option<ViewIndices>)>,
) -> Result<(), DataError> {
    #[derive(Serialize)]
    struct Entry {
        context: Vec<usize>,
        target: Vec<usize>,
    }
    let entry = |ViewIndices { context, target }| Entry { context, target };
    let entries: BTreeMap<&str, Option<Entry>> =
        entries.into_iter().map(|(key, views)| (key, views.map(entry))).collect();
    let bad = |error: serde_json::Error| DataError::BadIndex { what: error.to_string(), path: path.to_path_buf() };
    let text = serde_json::to_vec(&entries).map_err(bad)?;
    replace_file(path, &text).map_err(DataError::io("writing the evaluation index", path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::evaluation_index::EvaluationIndex;
    use crate::synthetic::config::SyntheticConfig;
    use crate::synthetic::source::SyntheticSource;

    fn source(num_frames: usize) -> SyntheticSource {
        let config = SyntheticConfig { num_scenes: 3, num_frames, width: 8, height: 8, ..Default::default() };
        SyntheticSource::new(config).unwrap()
    }

    #[test]
    fn a_written_index_selects_every_scene_with_enough_frames() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("evaluation_index.json");
        for (num_frames, expected) in [(16, 3), (6, 0)] {
            let source = source(num_frames);
            assert_eq!(write_evaluation_index(&path, &source, 4, 3).unwrap(), expected);
            let (items, report) = EvaluationIndex::read(&path).unwrap().select(&source, 0);
            assert_eq!((items.len(), report.num_scenes), (expected, 3));
            assert!(items.iter().all(|item| Some(&item.views) == even_views(16, 4, 3).as_ref()));
        }
    }

    #[test]
    fn what_is_written_is_counted_scene_by_scene_and_jpeg_is_smaller_at_a_low_quality() {
        let bytes = [ImageEncoding::Jpeg(10), ImageEncoding::Jpeg(95)].map(|encoding| {
            let folder = tempfile::tempdir().unwrap();
            let mut seen = Vec::new();
            let written = write_source(&source(4), folder.path(), encoding, 1, |done| seen.push(done)).unwrap();
            assert_eq!(seen, [1, 2, 3]);
            assert_eq!((written.num_scenes, written.num_frames), (3, 12));
            assert!(folder.path().join("000002.torch").exists() && folder.path().join("index.json").exists());
            written.image_bytes
        });
        assert!(bytes[0] < bytes[1], "{bytes:?}");
    }
}
