//! Converted scenes are the same scenes.

use super::*;
use crate::{
    Camera, ChunkSource, Frame, LayoutOptions, SceneFilters, Split, SyntheticConfig, SyntheticSource, open_layout,
};
use std::sync::atomic::{AtomicUsize, Ordering};

const CHUNKS: ConvertOptions = ConvertOptions { to: ConvertTo::Chunks { target_bytes: 1 }, encoding: Encoding::Png };
const SCENES: ConvertOptions = ConvertOptions { to: ConvertTo::Scenes, encoding: Encoding::Png };

fn rooms(num_scenes: usize) -> SyntheticSource {
    let config = SyntheticConfig { num_scenes, num_frames: 3, width: 16, height: 8, ..Default::default() };
    SyntheticSource::new(config).unwrap()
}

fn mini() -> ChunkSource {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/re10k-mini");
    ChunkSource::open(&root, Split::Train, &SceneFilters::default()).unwrap()
}

fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap());
    entries.map(|entry| (entry.file_name().into_string().unwrap(), std::fs::read(entry.path()).unwrap())).collect()
}

fn same(a: &dyn SceneSource, b: &dyn SceneSource) {
    assert_eq!(a.num_scenes(), b.num_scenes());
    for scene in 0..a.num_scenes() {
        let other = b.find(a.key(scene)).unwrap();
        assert_eq!(a.timestamps(scene).unwrap(), b.timestamps(other).unwrap());
        assert_eq!(a.url(scene).unwrap(), b.url(other).unwrap());
        let (cameras, others) = (a.cameras(scene).unwrap(), b.cameras(other).unwrap());
        assert_eq!(cameras.len(), others.len());
        for (frame, (camera, other_camera)) in cameras.iter().zip(&others).enumerate() {
            assert_eq!(a.frame(scene, frame).unwrap(), b.frame(other, frame).unwrap());
            for (x, y) in camera.to_re10k().iter().zip(other_camera.to_re10k()) {
                assert!((x - y).abs() < 1e-6 * (1.0 + x.abs()), "{x} {y}"); // f32 files
            }
        }
    }
}

#[test]
fn chunks_and_scenes_hold_the_same_and_keep_the_files_of_the_pictures() {
    for options in [CHUNKS, SCENES] {
        let folder = tempfile::tempdir().unwrap();
        let source = mini();
        let mut seen = Vec::new();
        let converted = convert(&source, &folder.path().join("train"), options, |done| seen.push(done)).unwrap();
        assert_eq!((converted.num_scenes, converted.num_found, converted.num_frames), (2, 0, 16));
        assert_eq!((converted.num_encoded, converted.skipped.len()), (0, 0));
        assert_eq!(seen, [1, 2]);
        let (back, ledger) = open_layout(folder.path(), Split::Train, &LayoutOptions::default()).unwrap();
        assert_eq!(ledger.num_used(), 2);
        same(&source, back.as_ref());
        for scene in 0..2 {
            let other = back.find(source.key(scene)).unwrap();
            for frame in 0..8 {
                assert_eq!(source.encoded_frame(scene, frame).unwrap(), back.encoded_frame(other, frame).unwrap());
            }
        }
    }
}

#[test]
fn every_layout_is_converted_to_the_same_scene() {
    let layouts = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/layouts");
    let open = |root: &Path| open_layout(root, Split::Test, &LayoutOptions::default()).unwrap().0;
    for name in ["re10k_txt", "re10k_folders", "dl3dv_flat", "capture", "colmap_bin", "scenes"] {
        let source = open(&layouts.join(name));
        for options in [CHUNKS, SCENES] {
            let folder = tempfile::tempdir().unwrap();
            let converted = convert(source.as_ref(), &folder.path().join("test"), options, |_| ()).unwrap();
            assert_eq!((converted.num_scenes, &converted.skipped[..]), (source.num_scenes(), &[][..]), "{name}");
            same(source.as_ref(), open(folder.path()).as_ref());
        }
        if name.starts_with("re10k") {
            let times: Vec<i64> = (0..6).map(|frame| 1_000_000 + 33_367 * frame).collect();
            assert_eq!(source.timestamps(0).unwrap(), times, "{name}");
        }
    }
}

#[test]
fn pictures_without_a_file_are_encoded() {
    let folder = tempfile::tempdir().unwrap();
    let converted = convert(&rooms(3), &folder.path().join("test"), CHUNKS, |_| ()).unwrap();
    assert_eq!((converted.num_frames, converted.num_encoded), (9, 9));
    let (back, _) = open_layout(folder.path(), Split::Test, &LayoutOptions::default()).unwrap();
    same(&rooms(3), back.as_ref());
}

/// Rooms whose cameras can be read so many times, twice per scene: as when a process is killed.
struct Interrupted {
    rooms: SyntheticSource,
    left: AtomicUsize,
}

impl SceneSource for Interrupted {
    fn num_scenes(&self) -> usize {
        self.rooms.num_scenes()
    }
    fn key(&self, scene: usize) -> &str {
        self.rooms.key(scene)
    }
    fn find(&self, key: &str) -> Option<usize> {
        self.rooms.find(key)
    }
    fn cameras(&self, scene: usize) -> Result<Vec<Camera>, DataError> {
        assert!(self.left.fetch_sub(1, Ordering::SeqCst) > 0, "killed");
        self.rooms.cameras(scene)
    }
    fn frame(&self, scene: usize, frame: usize) -> Result<Frame, DataError> {
        self.rooms.frame(scene, frame)
    }
}

#[test]
fn an_interrupted_conversion_goes_on_and_ends_with_the_same_files() {
    for options in [CHUNKS, SCENES] {
        let whole = tempfile::tempdir().unwrap();
        convert(&rooms(6), whole.path(), options, |_| ()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let killed = Interrupted { rooms: rooms(6), left: AtomicUsize::new(6) };
        let run = std::panic::AssertUnwindSafe(|| convert(&killed, folder.path(), options, |_| ()));
        assert!(std::panic::catch_unwind(run).is_err());
        assert!(!folder.path().join("index.json").exists());
        // One of the three files is damaged meanwhile: it is made again.
        let damaged = files(folder.path()).into_keys().find(|name| name.contains(".torch")).unwrap();
        std::fs::write(folder.path().join(&damaged), [&files(folder.path())[&damaged][..], b"x"].concat()).unwrap();
        let converted = convert(&rooms(6), folder.path(), options, |_| ()).unwrap();
        assert_eq!((converted.num_scenes, converted.num_found, converted.num_frames), (6, 2, 12));
        let (got, expected) = (files(folder.path()), files(whole.path()));
        assert_eq!(got.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
        for name in got.keys().filter(|name| *name != "SHA256SUMS") {
            assert!(got[name] == expected[name], "{name}");
        }
        // Finished: nothing is read again but to verify it.
        let again = Interrupted { rooms: rooms(6), left: AtomicUsize::new(0) };
        let converted = convert(&again, folder.path(), options, |_| ()).unwrap();
        assert_eq!((converted.num_found, converted.num_frames), (6, 0));
        assert_eq!(files(folder.path()).len(), expected.len());
    }
}

/// Rooms of which the second cannot be read.
struct SecondIsBroken(SyntheticSource);

impl SceneSource for SecondIsBroken {
    fn num_scenes(&self) -> usize {
        self.0.num_scenes()
    }
    fn key(&self, scene: usize) -> &str {
        self.0.key(scene)
    }
    fn find(&self, key: &str) -> Option<usize> {
        self.0.find(key)
    }
    fn cameras(&self, scene: usize) -> Result<Vec<Camera>, DataError> {
        self.0.cameras(scene)
    }
    fn frame(&self, scene: usize, frame: usize) -> Result<Frame, DataError> {
        if scene == 1 {
            return Err(DataError::BadImage { key: self.key(scene).into(), frame, what: "it is torn".into() });
        }
        self.0.frame(scene, frame)
    }
}

#[test]
fn a_scene_that_cannot_be_read_is_named_and_made_later() {
    let folder = tempfile::tempdir().unwrap();
    let converted = convert(&SecondIsBroken(rooms(3)), folder.path(), SCENES, |_| ()).unwrap();
    assert_eq!((converted.num_scenes, converted.skipped.len()), (2, 1));
    assert!(converted.skipped[0].key.ends_with("00001") && converted.skipped[0].reason.contains("it is torn"));
    assert!(files(folder.path()).contains_key("skipped.json"));
    let converted = convert(&rooms(3), folder.path(), SCENES, |_| ()).unwrap();
    assert_eq!((converted.num_scenes, converted.num_found, converted.skipped.len()), (3, 2, 0));
    assert!(!files(folder.path()).contains_key("skipped.json"));
}

#[test]
fn a_folder_of_other_scenes_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    convert(&rooms(3), folder.path(), SCENES, |_| ()).unwrap();
    let message = convert(&mini(), folder.path(), SCENES, |_| ()).unwrap_err().to_string();
    assert!(message.contains("which is not to be converted; choose another folder"), "{message}");
    assert!(!is_file_name("a/b") && !is_file_name("..") && is_file_name("1K-ab.c"));
}
