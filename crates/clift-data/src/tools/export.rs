//! Scenes of a source as records to write, and evaluation indices.

use std::collections::BTreeMap;
use std::path::Path;

use clift_core::replace_file;
use rayon::prelude::*;

use crate::error::DataError;
use crate::image::codec::encode_png;
use crate::sampling::clip::ViewIndices;
use crate::sampling::evaluation_index::even_views;
use crate::scene_source::SceneSource;
use crate::sources::chunks::writer::SceneRecord;

/// Reads a scene, its frames as PNG, on all cores.
pub fn read_scene(source: &dyn SceneSource, scene: usize) -> Result<SceneRecord, DataError> {
    let cameras = source.cameras(scene)?;
    let read = |frame: usize| encode_png(&source.frame(scene, frame)?);
    let images = (0..cameras.len()).into_par_iter().map(read).collect::<Result<_, DataError>>()?;
    Ok(SceneRecord { key: source.key(scene).to_owned(), cameras, images })
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
    use crate::testing::rooms;

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
