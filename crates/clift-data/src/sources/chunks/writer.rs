//! Writing scenes as chunks, for `torch.load` and [`crate::sources::chunks::chunk_source::ChunkSource`].

use std::collections::BTreeMap;
use std::path::Path;

use clift_core::{Camera, IntrinsicsNorm, replace_file};

use crate::error::DataError;
use crate::torch::pickle_writer::PickleWriter;
use crate::torch::values::{MAX_BYTES, MAX_VALUES};

/// Number of frames at which a chunk is closed; readers accept 1,048,576 values, about 19 per frame.
const MAX_CHUNK_FRAMES: usize = 50_000;

/// One scene to write.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneRecord {
    /// Unique scene key.
    pub key: String,
    /// URL of the scene; may be empty.
    pub url: String,
    /// One per frame: microseconds for RealEstate10K, frame numbers for DL3DV.
    pub timestamps: Vec<i64>,
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
    pub(crate) fn check(&self) -> Result<(), String> {
        let Self { key, timestamps, cameras, images, .. } = self;
        let (timestamps, cameras, images) = (timestamps.len(), cameras.len(), images.len());
        if timestamps != images || cameras != images {
            return Err(format!("scene {key} has {images} images, {cameras} cameras, {timestamps} time stamps"));
        }
        if images == 0 {
            return Err(format!("scene {key} has no frames"));
        }
        if ChunkFill::default().has_room(self) {
            return Ok(());
        }
        Err(format!("scene {key} has {images} frames, above the limit of a file (about 50,000)"))
    }
}

/// Sizes of the scenes in a file.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ChunkFill {
    image_bytes: u64,
    num_frames: usize,
    /// Upper bounds of the values and bytes of the pickle.
    num_values: usize,
    pickle_bytes: usize,
}

impl ChunkFill {
    fn with(self, scene: &SceneRecord) -> Self {
        let num_frames = scene.images.len();
        // At most 19 values and 170 bytes per tensor: one tensor per frame, two and five names per scene.
        Self {
            image_bytes: self.image_bytes + scene.image_bytes(),
            num_frames: self.num_frames + num_frames,
            num_values: self.num_values + 20 * num_frames + 60,
            pickle_bytes: self.pickle_bytes + 180 * num_frames + 600 + scene.url.len() + scene.key.len(),
        }
    }

    pub fn add(&mut self, scene: &SceneRecord) {
        *self = self.with(scene);
    }

    /// Returns whether readers accept the file with one more scene.
    pub fn has_room(self, scene: &SceneRecord) -> bool {
        let Self { num_values, pickle_bytes, .. } = self.with(scene);
        num_values < MAX_VALUES && pickle_bytes < MAX_BYTES
    }

    pub fn is_full(self, target_bytes: u64) -> bool {
        self.image_bytes >= target_bytes || self.num_frames >= MAX_CHUNK_FRAMES
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
    let mut fill = ChunkFill::default();
    for scene in scenes {
        let scene = scene?;
        scene.check().map_err(&bad)?;
        if !pending.is_empty() && (fill.is_full(target_bytes) || !fill.has_room(&scene)) {
            write_chunk(&folder.join(chunk_name(num_chunks)), &pending)?;
            num_chunks += 1;
            pending.clear();
            fill = ChunkFill::default();
        }
        if index.insert(scene.key.clone(), chunk_name(num_chunks)).is_some() {
            return Err(bad(format!("scene {} occurs twice", scene.key)));
        }
        fill.add(&scene);
        pending.push(scene);
    }
    if !pending.is_empty() {
        write_chunk(&folder.join(chunk_name(num_chunks)), &pending)?;
    }
    let text = serde_json::to_vec_pretty(&index).map_err(|error| bad(error.to_string()))?;
    replace_file(&index_path, &text).map_err(DataError::io("writing the index", &index_path))?;
    Ok(index.len())
}

pub(crate) fn chunk_name(number: usize) -> String {
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
    pack(path, pickle)
}

/// Returns the bytes of the file at `path` with one scene, as in the authors' released code.
pub(crate) fn scene_file_bytes(path: &Path, scene: &SceneRecord) -> Result<Vec<u8>, DataError> {
    let mut pickle = PickleWriter::new();
    write_scene(scene, &mut pickle);
    pickle.raw(b".");
    pack(path, pickle)
}

fn pack(path: &Path, pickle: PickleWriter) -> Result<Vec<u8>, DataError> {
    let prefix = path.file_stem().unwrap_or_default().to_string_lossy();
    pickle.pack(&prefix).map_err(|error| DataError::io("packing a chunk", path)(error.into()))
}

/// Returns time stamps in the format of a chunk: i64.
fn timestamp_bytes(timestamps: &[i64]) -> Vec<u8> {
    timestamps.iter().flat_map(|time| time.to_le_bytes()).collect()
}

/// Returns cameras in the format of a chunk: rows of 18 f32.
fn camera_bytes(cameras: &[Camera<IntrinsicsNorm>]) -> Vec<u8> {
    let rows = cameras.iter().flat_map(Camera::to_re10k);
    rows.flat_map(|number| (number as f32).to_le_bytes()).collect()
}

fn write_scene(scene: &SceneRecord, pickle: &mut PickleWriter) {
    let num_frames = scene.images.len();
    pickle.raw(b"}(");
    pickle.string("url");
    pickle.string(&scene.url);
    pickle.string("timestamps");
    pickle.tensor("LongStorage", timestamp_bytes(&scene.timestamps), &[num_frames]);
    pickle.string("cameras");
    pickle.tensor("FloatStorage", camera_bytes(&scene.cameras), &[num_frames, 18]);
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
            url: format!("https://example.org/{key}"),
            timestamps: (0..num_frames as i64).map(|frame| frame * 33_367 + (1 << 33)).collect(),
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
            assert_eq!(source.url(scene).unwrap(), record.url);
            assert_eq!(source.timestamps(scene).unwrap(), record.timestamps);
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
        assert_eq!(source.report.to_string(), "20001 of 20001 scenes used");
        assert_eq!(source.num_frames(source.find("long").unwrap()).unwrap(), most);
        let message = write_chunks(&folder.path().join("train"), [Ok(record("a", most + 1))], 1).unwrap_err();
        assert!(message.to_string().contains(" frames, above the limit of a file (about 50,000)"), "{message}");
    }

    #[test]
    fn invalid_scenes_and_existing_indices_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut uneven = record("a", 3);
        uneven.timestamps.pop();
        let message = write_chunks(folder.path(), [Ok(uneven)], 1).unwrap_err().to_string();
        assert!(message.contains("scene a has 3 images, 3 cameras, 2 time stamps"), "{message}");
        let message =
            write_chunks(folder.path(), [Ok(record("a", 1)), Ok(record("a", 1))], 1000).unwrap_err().to_string();
        assert!(message.contains("scene a occurs twice"), "{message}");
        write_chunks(folder.path(), [Ok(record("a", 1))], 1).unwrap();
        let message = write_chunks(folder.path(), [Ok(record("a", 1))], 1).unwrap_err().to_string();
        assert!(message.contains("it holds an index.json; choose an empty folder"), "{message}");
    }
}
