//! Writing scenes as chunks, for `torch.load` and [`crate::sources::chunks::chunk_source::ChunkSource`].

use std::collections::BTreeMap;
use std::path::Path;

use clift_core::{Camera, IntrinsicsNorm, replace_file};

use crate::error::DataError;
use crate::torch::pickle_writer::PickleWriter;
use crate::torch::values::MAX_VALUES;

/// One scene to write.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneRecord {
    /// Unique scene key.
    pub key: String,
    /// One per frame.
    pub cameras: Vec<Camera<IntrinsicsNorm>>,
    /// One JPEG or PNG file per frame.
    pub images: Vec<Vec<u8>>,
}

impl SceneRecord {
    /// Returns the number of bytes of all images.
    pub fn image_bytes(&self) -> u64 {
        self.images.iter().map(|image| image.len() as u64).sum()
    }

    /// Checks that the lists have equal lengths, that there are frames, and that the scene fits into one file.
    fn check(&self) -> Result<(), String> {
        let Self { key, cameras, images } = self;
        let (cameras, images) = (cameras.len(), images.len());
        if cameras != images {
            return Err(format!("scene {key} has {images} images, {cameras} cameras"));
        }
        if images == 0 {
            return Err(format!("scene {key} has no frames"));
        }
        if self.num_values() < MAX_VALUES {
            return Ok(());
        }
        Err(format!("scene {key} has {images} frames, above the limit of a file (about 50,000)"))
    }

    /// Returns an upper bound of the values in a pickle: 19 per tensor, of which a scene has two and one per frame.
    fn num_values(&self) -> usize {
        20 * self.images.len() + 60
    }
}

/// Writes `000000.torch, 000001.torch, ..` and then `index.json` into `folder`; returns the number of scenes. A chunk is
/// closed once its images have `target_bytes` or more. Every file is written atomically.
///
/// # Errors
/// Errors of the items, [`DataError::Io`] from writing, [`DataError::BadOutput`] for an existing `index.json`, and
/// [`DataError::BadIndex`] for a duplicate key or an invalid scene.
pub fn write_chunks(
    folder: &Path,
    scenes: impl IntoIterator<Item = Result<SceneRecord, DataError>>,
    target_bytes: u64,
) -> Result<usize, DataError> {
    std::fs::create_dir_all(folder).map_err(DataError::io("making the folder", folder))?;
    let index_path = folder.join("index.json");
    let bad = |what: String| DataError::BadIndex { what, path: index_path.clone() };
    if index_path.exists() {
        let what = "it holds an index.json; choose an empty folder".into();
        return Err(DataError::BadOutput { what, path: folder.to_owned() });
    }
    let mut index = BTreeMap::new();
    let mut num_chunks = 0;
    let mut pending = Vec::new();
    let (mut image_bytes, mut num_values) = (0, 0);
    for scene in scenes {
        let scene = scene?;
        scene.check().map_err(&bad)?;
        let is_full = image_bytes >= target_bytes || num_values + scene.num_values() >= MAX_VALUES;
        if is_full && !pending.is_empty() {
            write_chunk(&folder.join(chunk_name(num_chunks)), &pending)?;
            num_chunks += 1;
            pending.clear();
            (image_bytes, num_values) = (0, 0);
        }
        if index.insert(scene.key.clone(), chunk_name(num_chunks)).is_some() {
            return Err(bad(format!("scene {} occurs twice", scene.key)));
        }
        image_bytes += scene.image_bytes();
        num_values += scene.num_values();
        pending.push(scene);
    }
    if !pending.is_empty() {
        write_chunk(&folder.join(chunk_name(num_chunks)), &pending)?;
    }
    let text = serde_json::to_vec_pretty(&index).map_err(|error| bad(error.to_string()))?;
    replace_file(&index_path, &text).map_err(DataError::io("writing the index", &index_path))?;
    Ok(index.len())
}

fn chunk_name(number: usize) -> String {
    format!("{number:06}.torch")
}

fn write_chunk(path: &Path, scenes: &[SceneRecord]) -> Result<(), DataError> {
    replace_file(path, &chunk_bytes(path, scenes)?).map_err(DataError::io("writing a chunk", path))
}

pub(crate) fn chunk_bytes(path: &Path, scenes: &[SceneRecord]) -> Result<Vec<u8>, DataError> {
    let mut pickle = PickleWriter::new();
    pickle.raw(b"](");
    for scene in scenes {
        write_scene(scene, &mut pickle);
    }
    pickle.raw(b"e.");
    let prefix = path.file_stem().unwrap_or_default().to_string_lossy();
    pickle.pack(&prefix).map_err(|error| DataError::io("packing a chunk", path)(error.into()))
}

fn write_scene(scene: &SceneRecord, pickle: &mut PickleWriter) {
    let num_frames = scene.images.len();
    pickle.raw(b"}(");
    pickle.string("url");
    pickle.string("");
    pickle.string("timestamps");
    let timestamps = (0..num_frames as i64).flat_map(i64::to_le_bytes).collect();
    pickle.tensor("LongStorage", timestamps, &[num_frames]);
    pickle.string("cameras");
    let rows = scene.cameras.iter().flat_map(Camera::to_re10k);
    let rows = rows.flat_map(|number| (number as f32).to_le_bytes()).collect();
    pickle.tensor("FloatStorage", rows, &[num_frames, 18]);
    pickle.string("images");
    pickle.raw(b"](");
    for image in &scene.images {
        pickle.tensor("ByteStorage", image.clone(), &[image.len()]);
    }
    pickle.raw(b"e");
    pickle.string("key");
    pickle.string(&scene.key);
    pickle.raw(b"u");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_source::{SceneSource, Split};
    use crate::sources::chunks::chunk_source::ChunkSource;
    use crate::sources::filters::SceneFilters;

    fn record(key: &str, num_frames: usize) -> SceneRecord {
        let camera = |frame: usize| {
            let mut row = [0.0; 18];
            row[..4].copy_from_slice(&[0.9, 1.6, 0.5, 0.5]);
            (row[6], row[11], row[16]) = (1.0, 1.0, 1.0);
            row[9] = frame as f64;
            Camera::from_re10k(row).unwrap()
        };
        SceneRecord {
            key: key.into(),
            cameras: (0..num_frames).map(camera).collect(),
            images: (0..num_frames).map(|frame| vec![frame as u8; 100 + frame % 50]).collect(),
        }
    }

    #[test]
    fn written_scenes_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let records = [record("b", 3), record("a", 5), record("c", 1)];
        // 303, 510 and 100 bytes of images: the second scene closes the first chunk.
        assert_eq!(write_chunks(&folder.path().join("test"), records.clone().map(Ok), 400).unwrap(), 3);
        let index = std::fs::read_to_string(folder.path().join("test/index.json")).unwrap();
        let index: BTreeMap<String, String> = serde_json::from_str(&index).unwrap();
        let expected = [("a", "000000.torch"), ("b", "000000.torch"), ("c", "000001.torch")];
        assert_eq!(index, expected.map(|(key, file)| (key.to_owned(), file.to_owned())).into());
        let source = ChunkSource::open(folder.path(), Split::Test, &SceneFilters::default()).unwrap();
        assert_eq!(source.num_scenes(), 3);
        for record in &records {
            let scene = source.find(&record.key).unwrap();
            assert_eq!(source.num_frames(scene).unwrap(), record.images.len());
            for (frame, image) in record.images.iter().enumerate() {
                assert_eq!(source.encoded_frame(scene, frame).unwrap().as_ref(), Some(image));
            }
            for (got, expected) in source.cameras(scene).unwrap().iter().zip(&record.cameras) {
                assert_eq!(got.c2w, expected.c2w); // whole numbers, so f32 loses nothing
                assert!((got.intrinsics.fx - 0.9).abs() < 1e-7); // f32
            }
        }
    }

    #[test]
    fn written_files_stay_within_reader_limits() {
        // Many scenes of one frame, and one scene that fills a file.
        let most = (MAX_VALUES - 61) / 20;
        let small = (0..20_000).map(|number| record(&format!("{number:05}"), 1));
        let folder = tempfile::tempdir().unwrap();
        write_chunks(&folder.path().join("test"), small.chain([record("long", most)]).map(Ok), u64::MAX).unwrap();
        let filters = SceneFilters { min_frames: 1, ..Default::default() };
        let source = ChunkSource::open(folder.path(), Split::Test, &filters).unwrap();
        assert_eq!(source.report.to_string(), "all 20001 scenes used");
        assert_eq!(source.num_frames(source.find("long").unwrap()).unwrap(), most);
        let message = write_chunks(&folder.path().join("train"), [Ok(record("a", most + 1))], 1).unwrap_err();
        assert!(message.to_string().contains(" frames, above the limit of a file (about 50,000)"), "{message}");
    }

    #[test]
    fn invalid_scenes_and_existing_indices_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let message = |scenes: Vec<SceneRecord>| {
            write_chunks(folder.path(), scenes.into_iter().map(Ok), 1000).unwrap_err().to_string()
        };
        let uneven = SceneRecord { cameras: Vec::new(), ..record("a", 3) };
        assert!(message(vec![uneven]).contains("scene a has 3 images, 0 cameras"));
        assert!(message(vec![record("a", 1), record("a", 1)]).contains("scene a occurs twice"));
        write_chunks(folder.path(), [Ok(record("a", 1))], 1).unwrap();
        assert!(message(vec![record("a", 1)]).contains("it holds an index.json; choose an empty folder"));
    }
}
