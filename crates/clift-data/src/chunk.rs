//! Scenes in the chunk layout of pixelSplat: `<root>/{train,test}/NNNNNN.torch` with an `index.json`.

use std::collections::{BTreeMap, HashMap};
use std::path::{Component, Path, PathBuf};
use std::sync::OnceLock;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::chunk_table::{ChunkTable, SceneTable};
use crate::clip::{Frame, SceneSource};
use crate::error::DataError;
use crate::image::decode;
use crate::ledger::Ledger;
use crate::split::Split;

/// Which scenes of a data set are used. What they leave out is in the source's [`Ledger`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SceneFilters {
    /// Fewest frames of a usable scene; 0 keeps all. The paper's training set keeps scenes of 46 and more.
    pub min_frames: usize,
    /// Largest field of view of any frame, in degrees; pixelSplat leaves out scenes above 100.
    pub max_fov_deg: Option<f64>,
}

/// One chunk file; its table is read when a scene of it is first needed.
struct Chunk {
    path: PathBuf,
    table: OnceLock<ChunkTable>,
}

/// A scene's key and its chunk.
struct Entry {
    key: String,
    chunk: usize,
}

/// Scenes of one split of a chunked data set, sorted by key, with random access to single frames.
///
/// Chunks are never read whole: a table of 24 bytes per frame is kept once a chunk has been used (about 0.2 GiB for
/// all of RealEstate10K), and a frame or a scene's cameras are one read each.
pub struct ChunkSource {
    chunks: Vec<Chunk>,
    scenes: Vec<Entry>,
    positions: HashMap<String, usize>,
    ledger: Ledger,
}

impl ChunkSource {
    /// Opens `<root>/<split>`. Without filters this reads `index.json` alone; with filters, every chunk's table.
    ///
    /// # Errors
    /// [`DataError::Io`] for a missing `index.json` or chunk, [`DataError::BadIndex`] for an index that is no map
    /// from keys to files beside it, and with filters whatever reading a chunk gives.
    pub fn open(root: &Path, split: Split, filters: &SceneFilters) -> Result<Self, DataError> {
        let folder = root.join(split.to_string());
        let index = read_index(&folder.join("index.json"))?;
        let mut chunk_ids = BTreeMap::new();
        let mut chunks = Vec::new();
        let mut scenes = Vec::with_capacity(index.len());
        for (key, file) in index {
            let chunk = *chunk_ids.entry(file).or_insert_with_key(|file| {
                chunks.push(Chunk { path: folder.join(file), table: OnceLock::new() });
                chunks.len() - 1
            });
            scenes.push(Entry { key, chunk });
        }
        for chunk in &chunks {
            std::fs::metadata(&chunk.path)
                .map_err(DataError::io("opening a chunk that index.json lists", &chunk.path))?;
        }
        let mut source = Self { chunks, ledger: Ledger::new(scenes.len()), scenes, positions: HashMap::new() };
        source.apply(filters)?;
        source.positions = source.scenes.iter().enumerate().map(|(i, entry)| (entry.key.clone(), i)).collect();
        Ok(source)
    }

    /// What the filters left out.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// How many frames a scene has.
    pub fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        Ok(self.table(scene)?.1.images.len())
    }

    /// Time stamp of every frame: microseconds in RealEstate10K, frame numbers in DL3DV.
    pub fn timestamps(&self, scene: usize) -> Result<Vec<i64>, DataError> {
        let (path, table) = self.table(scene)?;
        table.read_timestamps(path)
    }

    /// Where a scene comes from; empty if its file does not say.
    pub fn url(&self, scene: usize) -> Result<&str, DataError> {
        Ok(&self.table(scene)?.1.url)
    }

    /// Reads the file of one frame, JPEG or PNG, as it is in the chunk.
    pub fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Vec<u8>, DataError> {
        let (path, table) = self.table(scene)?;
        let span = table.images.get(frame).ok_or_else(|| DataError::NoSuchFrame {
            key: table.key.clone(),
            frame,
            num_frames: table.images.len(),
        })?;
        span.read(path)
    }

    fn apply(&mut self, filters: &SceneFilters) -> Result<(), DataError> {
        if filters.min_frames == 0 && filters.max_fov_deg.is_none() {
            return Ok(());
        }
        let verdicts = (0..self.scenes.len())
            .into_par_iter()
            .map(|scene| self.reason_to_skip(scene, filters))
            .collect::<Result<Vec<_>, _>>()?;
        let scenes = std::mem::take(&mut self.scenes);
        for (entry, reason) in scenes.into_iter().zip(verdicts) {
            match reason {
                Some(reason) => self.ledger.skip(entry.key, reason),
                None => self.scenes.push(entry),
            }
        }
        Ok(())
    }

    fn reason_to_skip(&self, scene: usize, filters: &SceneFilters) -> Result<Option<String>, DataError> {
        if self.num_frames(scene)? < filters.min_frames {
            return Ok(Some(format!("shorter than {} frames", filters.min_frames)));
        }
        let Some(limit) = filters.max_fov_deg else { return Ok(None) };
        let is_wide = self.cameras(scene)?.iter().any(|camera| {
            let (x, y) = camera.fov_deg();
            x.max(y) > limit
        });
        Ok(is_wide.then(|| format!("with a field of view above {limit} degrees")))
    }

    /// The table of a scene, with the path of its chunk.
    fn table(&self, scene: usize) -> Result<(&Path, &SceneTable), DataError> {
        let num_scenes = self.scenes.len();
        let Entry { key, chunk } = self.scenes.get(scene).ok_or(DataError::NoSuchScene { scene, num_scenes })?;
        let Chunk { path, table } = &self.chunks[*chunk];
        let table = if let Some(table) = table.get() {
            table
        } else {
            // Two threads may read the same chunk at once; the first to finish is kept.
            let read = ChunkTable::read(path)?;
            table.get_or_init(|| read)
        };
        let scene = table.scenes.iter().find(|scene| scene.key == *key).ok_or_else(|| DataError::BadChunk {
            what: format!("index.json lists scene {key} in it, but it holds {} other scenes", table.scenes.len()),
            path: path.clone(),
        })?;
        Ok((path, scene))
    }
}

impl SceneSource for ChunkSource {
    fn num_scenes(&self) -> usize {
        self.scenes.len()
    }

    fn key(&self, scene: usize) -> &str {
        &self.scenes[scene].key
    }

    fn find(&self, key: &str) -> Option<usize> {
        self.positions.get(key).copied()
    }

    fn cameras(&self, scene: usize) -> Result<Vec<Camera>, DataError> {
        let (path, table) = self.table(scene)?;
        table.read_cameras(path)
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<Frame, DataError> {
        decode(&self.encoded_frame(scene, frame)?, self.key(scene), frame)
    }
}

/// Reads `index.json`: scene key to file name, sorted by key.
fn read_index(path: &Path) -> Result<BTreeMap<String, String>, DataError> {
    let bad = |what: String| DataError::BadIndex { what, path: path.to_path_buf() };
    let text = std::fs::read(path).map_err(DataError::io("reading the scene index", path))?;
    let index: BTreeMap<String, String> = serde_json::from_slice(&text)
        .map_err(|error| bad(format!("expected a map from scene keys to chunk files, got {error}")))?;
    for (key, file) in &index {
        if !Path::new(file).components().all(|part| matches!(part, Component::Normal(_))) {
            return Err(bad(format!("scene {key} is in {file:?}, expected a file beside the index")));
        }
    }
    Ok(index)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use safetensors::SafeTensors;

    const ALL: SceneFilters = SceneFilters { min_frames: 0, max_fov_deg: None };

    fn fixtures() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures")
    }

    /// A data set whose only training chunk has the given bytes and whose index lists the given scenes.
    fn with_chunk(bytes: &[u8], keys: &[&str]) -> (tempfile::TempDir, ChunkSource) {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("train")).unwrap();
        std::fs::write(folder.path().join("train/000000.torch"), bytes).unwrap();
        let index: BTreeMap<_, _> = keys.iter().map(|key| (*key, "000000.torch")).collect();
        std::fs::write(folder.path().join("train/index.json"), serde_json::to_vec(&index).unwrap()).unwrap();
        let source = ChunkSource::open(folder.path(), Split::Train, &ALL).unwrap();
        (folder, source)
    }

    fn mini_chunk() -> Vec<u8> {
        std::fs::read(fixtures().join("re10k-mini/train/000000.torch")).unwrap()
    }

    #[test]
    fn a_chunk_written_by_torch_save_is_read_frame_by_frame() {
        let source = ChunkSource::open(&fixtures().join("re10k-mini"), Split::Train, &ALL).unwrap();
        assert_eq!(source.num_scenes(), 2);
        assert_eq!(source.ledger().to_string(), "2 of 2 scenes used");
        let scene = source.find("00000000000000a2").unwrap();
        assert_eq!(source.key(scene), "00000000000000a2");
        assert_eq!(source.url(scene).unwrap(), "https://example.org/00000000000000a2");
        let times: Vec<i64> = (0..8).map(|frame| 1_000_000 + 33_367 * frame).collect();
        assert_eq!(source.timestamps(scene).unwrap(), times);

        let bytes = std::fs::read(fixtures().join("reference/re10k_mini.safetensors")).unwrap();
        let tensors = SafeTensors::deserialize(&bytes).unwrap();
        let frame = source.frame(scene, 3).unwrap();
        let expected = tensors.tensor("frame").unwrap();
        assert_eq!(expected.shape(), [frame.height, frame.width, 3]);
        let worst = frame.rgb.iter().zip(expected.data()).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst <= Some(4), "{worst:?}"); // JPEG decoders round differently, chroma most
        let expected: Vec<f64> =
            tensors.tensor("c2w").unwrap().data().as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
        let c2w = source.cameras(scene).unwrap()[3].c2w.to_matrix();
        for (got, expected) in c2w.iter().zip(&expected) {
            assert!((f64::from(*got) - expected).abs() < 1e-6, "{got} against {expected}"); // f32 file, f32 matrix
        }
    }

    #[test]
    fn filters_leave_scenes_out_into_the_ledger() {
        let open = |min_frames, max_fov_deg| {
            let filters = SceneFilters { min_frames, max_fov_deg };
            ChunkSource::open(&fixtures().join("re10k-mini"), Split::Train, &filters).unwrap()
        };
        assert_eq!(open(8, Some(60.0)).num_scenes(), 2);
        let short = open(9, None);
        assert_eq!((short.num_scenes(), short.find("00000000000000a1")), (0, None));
        assert_eq!(short.ledger().to_string(), "0 of 2 scenes used; 2 shorter than 9 frames");
        // fx = 0.9 of the width: 58.1 degrees.
        let wide = open(8, Some(58.0));
        assert_eq!(wide.ledger().to_string(), "0 of 2 scenes used; 2 with a field of view above 58 degrees");
    }

    #[test]
    fn sources_are_shared_between_threads() {
        let source = ChunkSource::open(&fixtures().join("re10k-mini"), Split::Train, &ALL).unwrap();
        let one_by_one: Vec<Frame> = (0..16).map(|i| source.frame(i / 8, i % 8).unwrap()).collect();
        let source = ChunkSource::open(&fixtures().join("re10k-mini"), Split::Train, &ALL).unwrap();
        let at_once: Vec<Frame> = (0..16).into_par_iter().map(|i| source.frame(i / 8, i % 8).unwrap()).collect();
        assert_eq!(at_once, one_by_one);
    }

    #[test]
    fn truncated_chunks_are_errors_that_name_the_file() {
        let bytes = mini_chunk();
        for length in [0, 10, bytes.len() / 2, bytes.len() - 10] {
            let (_folder, source) = with_chunk(&bytes[..length], &["00000000000000a1"]);
            let message = source.frame(0, 0).unwrap_err().to_string();
            assert!(message.starts_with("bad chunk: ") && message.ends_with("000000.torch"), "{length}: {message}");
            assert!(message.contains("truncated"), "{length}: {message}");
        }
    }

    #[test]
    fn a_chunk_whose_pickle_calls_os_system_is_refused() {
        let bytes = std::fs::read(fixtures().join("hostile/calls_system.torch")).unwrap();
        let (_folder, source) = with_chunk(&bytes, &["a"]);
        let message = source.cameras(0).unwrap_err().to_string();
        assert!(message.contains("`os.system`") && message.ends_with("000000.torch"), "{message}");
    }

    #[test]
    fn a_frame_with_a_flipped_bit_is_found_by_its_checksum() {
        let mut bytes = mini_chunk();
        let start = bytes.windows(4).position(|window| window == b"\xff\xd8\xff\xe0").unwrap();
        bytes[start + 700] ^= 1;
        let (_folder, source) = with_chunk(&bytes, &["00000000000000a1"]);
        let message = source.frame(0, 0).unwrap_err().to_string();
        assert!(message.contains("has another checksum") && message.ends_with("000000.torch"), "{message}");
        assert!(source.frame(0, 1).is_ok());
    }

    proptest! {
        #[test]
        fn a_chunk_with_bytes_changed_never_panics(
            changes in proptest::collection::vec((0.0..1.0, any::<bool>(), any::<u8>()), 1..8),
        ) {
            let mut bytes = mini_chunk();
            // Half of the changes hit the pickle and the first headers, half anywhere, the directory included.
            for (at, near_start, byte) in changes {
                let range = if near_start { 3000 } else { bytes.len() };
                bytes[(at * range as f64) as usize] = byte;
            }
            let (_folder, source) = with_chunk(&bytes, &["00000000000000a1"]);
            let _ = (source.cameras(0), source.timestamps(0), source.frame(0, 0));
        }
    }

    #[test]
    fn a_key_that_the_chunk_does_not_hold_is_an_error() {
        let (_folder, source) = with_chunk(&mini_chunk(), &["00ff"]);
        let message = source.cameras(0).unwrap_err().to_string();
        assert!(message.contains("index.json lists scene 00ff in it, but it holds 2 other scenes"), "{message}");
    }

    #[test]
    fn a_frame_or_scene_that_does_not_exist_is_an_error() {
        let source = ChunkSource::open(&fixtures().join("re10k-mini"), Split::Test, &ALL).unwrap();
        let message = source.frame(0, 8).unwrap_err().to_string();
        assert_eq!(message, "scene 00000000000000b1 has 8 frames, so there is no frame 8 (counted from 0)");
        let message = source.frame(1, 0).unwrap_err().to_string();
        assert_eq!(message, "there are 1 scenes, so there is no scene 1 (counted from 0)");
    }

    #[test]
    fn bad_indices_and_missing_chunks_are_errors_that_name_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let open = || ChunkSource::open(folder.path(), Split::Test, &ALL).err().map(|error| error.to_string()).unwrap();
        assert!(open().starts_with("reading the scene index failed: "), "{}", open());
        std::fs::create_dir(folder.path().join("test")).unwrap();
        let index = folder.path().join("test/index.json");
        std::fs::write(&index, "[1, 2]").unwrap();
        assert!(open().contains("expected a map from scene keys to chunk files"), "{}", open());
        std::fs::write(&index, r#"{"a": "../../secret.torch"}"#).unwrap();
        assert!(open().contains("expected a file beside the index"), "{}", open());
        std::fs::write(&index, r#"{"a": "000000.torch"}"#).unwrap();
        assert!(open().starts_with("opening a chunk that index.json lists failed"), "{}", open());
        assert!(open().ends_with("000000.torch"), "{}", open());
    }
}
