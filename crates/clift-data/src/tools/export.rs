//! Scenes of a source as records to write, and evaluation indices.

use std::collections::BTreeMap;
use std::path::Path;

use clift_core::{RgbImage, replace_file};
use rayon::prelude::*;

use crate::error::DataError;
use crate::image::codec::{encode_jpeg, encode_png};
use crate::image::lanczos::resize_lanczos;
use crate::sampling::clip::ViewIndices;
use crate::sampling::evaluation_index::even_views;
use crate::scene_source::SceneSource;
use crate::sources::chunks::writer::SceneRecord;

/// File format of frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ImageEncoding {
    /// Lossless.
    #[default]
    Png,
    /// Quality in `1..=100`.
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

/// Reads a scene, its frames on all cores. Image files are copied; other frames, and images with a side above `max_size`
/// pixels after their reduction, are encoded. Returns the scene and the number of encoded frames.
pub fn read_scene(
    source: &dyn SceneSource,
    scene: usize,
    encoding: ImageEncoding,
    max_size: Option<usize>,
) -> Result<(SceneRecord, usize), DataError> {
    let cameras = source.cameras(scene)?;
    let timestamps = source.timestamps(scene)?;
    let read = |frame: usize| {
        if let Some(max_size) = max_size {
            let [width, height] = source.image_size(scene, frame)?;
            let scale = max_size as f64 / width.max(height) as f64;
            if scale < 1.0 {
                let side = |side: usize| ((side as f64 * scale).round() as usize).max(1);
                let reduced = resize_lanczos(&source.frame(scene, frame)?, side(width), side(height));
                return Ok((encoding.encode(&reduced)?, 1));
            }
        }
        Ok(match source.encoded_frame(scene, frame)? {
            Some(bytes) => (bytes, 0),
            None => (encoding.encode(&source.frame(scene, frame)?)?, 1),
        })
    };
    let images: Vec<(Vec<u8>, usize)> =
        (0..cameras.len()).into_par_iter().map(read).collect::<Result<_, DataError>>()?;
    let (images, encoded): (Vec<_>, Vec<usize>) = images.into_iter().unzip();
    let key = source.key(scene).to_owned();
    Ok((SceneRecord { key, url: source.url(scene)?, timestamps, cameras, images }, encoded.iter().sum()))
}

/// Writes an evaluation index of every scene of `source` with [`even_views`], `null` for scenes with too few frames.
/// Returns the number of scenes with views.
///
/// # Errors
/// The errors of reading cameras, and [`DataError::Io`].
pub fn write_evaluation_index(
    path: &Path,
    source: &dyn SceneSource,
    num_context: usize,
    num_targets: usize,
) -> Result<usize, DataError> {
    let mut entries = Vec::with_capacity(source.num_scenes());
    for scene in 0..source.num_scenes() {
        entries.push((source.key(scene), even_views(source.num_frames(scene)?, num_context, num_targets)));
    }
    let num_usable = entries.iter().filter(|(_, views)| views.is_some()).count();
    write_index(path, entries)?;
    Ok(num_usable)
}

/// Writes an index for [`EvaluationIndex`](crate::sampling::evaluation_index::EvaluationIndex), sorted by key.
pub(crate) fn write_index<'a>(
    path: &Path,
    entries: impl IntoIterator<Item = (&'a str, Option<ViewIndices>)>,
) -> Result<(), DataError> {
    let entries: BTreeMap<&str, Option<ViewIndices>> = entries.into_iter().collect();
    let bad = |error: serde_json::Error| DataError::BadIndex { what: error.to_string(), path: path.to_path_buf() };
    let text = serde_json::to_vec(&entries).map_err(bad)?;
    replace_file(path, &text).map_err(DataError::io("writing the evaluation index", path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::evaluation_index::EvaluationIndex;
    use crate::scene_source::Split;
    use crate::sources::chunks::chunk_source::ChunkSource;
    use crate::sources::chunks::writer::write_chunks;
    use crate::sources::filters::SceneFilters;
    use crate::testing::{assert_same, rooms};

    #[test]
    fn written_scenes_equal_those_of_the_source() {
        let root = tempfile::tempdir().unwrap();
        let source = rooms(|c| (c.num_scenes, c.num_frames, c.width, c.height) = (5, 6, 40, 24));
        // About two scenes to a chunk.
        let scenes = (0..5).map(|scene| Ok(read_scene(&source, scene, ImageEncoding::Png, None)?.0));
        assert_eq!(write_chunks(&root.path().join("test"), scenes, 25_000).unwrap(), 5);
        assert_same(&source, &ChunkSource::open(root.path(), Split::Test, &SceneFilters::default()).unwrap());
    }

    #[test]
    fn written_index_selects_every_scene_with_enough_frames() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("evaluation_index.json");
        for (num_frames, expected) in [(16, 3), (6, 0)] {
            let source = rooms(|c| (c.num_scenes, c.num_frames) = (3, num_frames));
            assert_eq!(write_evaluation_index(&path, &source, 4, 3).unwrap(), expected);
            let (items, report) = EvaluationIndex::read(&path).unwrap().select(&source, 0);
            assert_eq!((items.len(), report.num_scenes), (expected, 3));
            assert!(items.iter().all(|item| Some(&item.views) == even_views(16, 4, 3).as_ref()));
        }
    }
}
