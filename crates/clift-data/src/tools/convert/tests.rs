//! Tests that converted scenes equal their sources.

use super::*;
use crate::scene_source::Split;
use crate::skip_report::SkippedScene;
use crate::sources::chunks::table::ChunkTable;
use crate::sources::dataset_root::DatasetRoot;
use crate::sources::open::{OpenedSource, open_source};
use crate::sources::options::SourceOptions;
use crate::synthetic::source::SyntheticSource;
use crate::testing::{self, TestSource, assert_same, fixture, names, re10k_mini};

const CHUNKS: ConvertOptions = options(ConvertTo::Chunks { target_bytes: 1 });
const SCENES: ConvertOptions = options(ConvertTo::Scenes);

const fn options(to: ConvertTo) -> ConvertOptions {
    ConvertOptions { to, encoding: ImageEncoding::Png, max_size: None }
}

fn convert_all(
    source: &dyn SceneSource,
    folder: &Path,
    options: &ConvertOptions,
) -> Result<ConversionReport, DataError> {
    convert(source, &SkipReport::new(source.num_scenes()), folder, options)
}

fn convert(
    source: &dyn SceneSource,
    skipped: &SkipReport,
    folder: &Path,
    options: &ConvertOptions,
) -> Result<ConversionReport, DataError> {
    Converter::open(source, skipped, folder, options)?.run(|_| ())
}

fn open(root: &Path, split: Split) -> OpenedSource {
    open_source(&DatasetRoot::find(root).unwrap(), split, &SourceOptions::default()).unwrap()
}

fn rooms(num_scenes: usize) -> SyntheticSource {
    testing::rooms(|c| (c.num_scenes, c.num_frames, c.width, c.height) = (num_scenes, 3, 16, 8))
}

fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let file = |name: String| (name.clone(), std::fs::read(folder.join(name)).unwrap());
    names(folder).into_iter().map(file).collect()
}

#[test]
fn large_images_are_reduced_with_their_field_of_view() {
    let source = re10k_mini(Split::Train); // 64 x 36
    for (max_size, expected, num_encoded) in [(48, [48, 27], 16), (64, [64, 36], 0)] {
        let folder = tempfile::tempdir().unwrap();
        let options = ConvertOptions { max_size: Some(max_size), ..CHUNKS };
        let report = convert_all(&source, folder.path(), &options).unwrap();
        assert_eq!((report.num_frames, report.num_encoded), (16, num_encoded));
        let reduced = open(folder.path(), Split::Train).source;
        assert_eq!(reduced.image_size(1, 3).unwrap(), expected);
        assert_eq!(reduced.cameras(1).unwrap(), source.cameras(1).unwrap());
    }
}

#[test]
fn converted_scenes_keep_cameras_and_image_files() {
    for options in [CHUNKS, SCENES] {
        let folder = tempfile::tempdir().unwrap();
        let source = re10k_mini(Split::Train);
        let mut seen = Vec::new();
        let report = SkipReport::new(2);
        let converter = Converter::open(&source, &report, &folder.path().join("train"), &options).unwrap();
        let report = converter.run(|done| seen.push(done)).unwrap();
        assert_eq!((report.num_scenes, report.num_frames), (2, 16));
        assert_eq!((report.num_encoded, report.skipped.skips.len()), (0, 0));
        assert_eq!(seen, [1, 2]);
        let OpenedSource { source: back, report, .. } = open(folder.path(), Split::Train);
        assert_eq!(report.num_used(), 2);
        assert_same(&source, back.as_ref());
        for scene in 0..2 {
            let other = back.find(source.key(scene)).unwrap();
            for frame in 0..8 {
                assert_eq!(source.encoded_frame(scene, frame).unwrap(), back.encoded_frame(other, frame).unwrap());
            }
        }
    }
}

#[test]
fn every_layout_is_converted() {
    let open = |root: &Path| open(root, Split::Test).source;
    for name in ["re10k_txt", "re10k_folders", "dl3dv_flat", "capture", "colmap_bin", "scenes"] {
        let source = open(&fixture("layouts").join(name));
        for options in [CHUNKS, SCENES] {
            let folder = tempfile::tempdir().unwrap();
            let report = convert_all(source.as_ref(), &folder.path().join("test"), &options).unwrap();
            assert_eq!((report.num_scenes, &report.skipped.skips[..]), (source.num_scenes(), &[][..]), "{name}");
            assert_same(source.as_ref(), open(folder.path()).as_ref());
        }
    }
}

#[test]
fn frames_without_an_image_file_are_encoded() {
    let folder = tempfile::tempdir().unwrap();
    let report = convert_all(&rooms(3), &folder.path().join("test"), &CHUNKS).unwrap();
    assert_eq!((report.num_frames, report.num_encoded), (9, 9));
    assert_same(&rooms(3), open(folder.path(), Split::Test).source.as_ref());
}

#[test]
fn interrupted_conversion_leaves_a_folder_that_counts_as_empty() {
    let folder = tempfile::tempdir().unwrap();
    let killed = TestSource::new(rooms(3)).with_frames(|scene, _, frame| {
        assert!(scene < 2, "killed");
        Ok(frame)
    });
    let run = std::panic::AssertUnwindSafe(|| convert_all(&killed, folder.path(), &SCENES));
    assert!(std::panic::catch_unwind(run).is_err());
    assert_eq!(names(folder.path()), [""; 0]);
    convert_all(&rooms(3), folder.path(), &SCENES).unwrap();
    let before = files(folder.path());
    let message = convert_all(&rooms(3), folder.path(), &SCENES).unwrap_err().to_string();
    assert!(message.contains("it is not empty; choose another folder") && files(folder.path()) == before, "{message}");
}

#[test]
fn skipped_scenes_are_reported() {
    let folder = tempfile::tempdir().unwrap();
    let mut skipped = SkipReport::new(4);
    skipped.skip("far", "without any image");
    skipped.skip_frame("near", "7.jpg", "without an image");
    let second_is_torn = TestSource::new(rooms(3)).with_torn_frames(|scene| scene == 1);
    let report = convert(&second_is_torn, &skipped, folder.path(), &SCENES).unwrap();
    assert_eq!((report.num_scenes, report.skipped.num_scenes, report.skipped.num_used()), (2, 4, 2));
    let text = std::fs::read(folder.path().join("skipped.json")).unwrap();
    let saved: SkipReport = serde_json::from_slice(&text).unwrap();
    assert_eq!((&saved, saved.skips.len(), saved.frames.len()), (&report.skipped, 2, 1));
    assert_eq!(saved.skips[0], SkippedScene { key: "far".into(), reason: "without any image".into() });
    assert!(saved.skips[1].key.ends_with("00001") && saved.skips[1].reason.contains("it is torn"));
}

#[test]
fn unreadable_images_are_listed() {
    let torn = TestSource::new(rooms(3)).with_encoded_frames(|scene, frame| {
        let image = ImageEncoding::Png.encode(&rooms(3).frame(scene, frame).unwrap()).unwrap();
        Some(if scene == 1 && frame > 0 { image[..image.len() - 1].to_vec() } else { image })
    });
    for options in [CHUNKS, SCENES] {
        let folder = tempfile::tempdir().unwrap();
        let report = convert_all(&torn, folder.path(), &options).unwrap();
        assert_eq!(report.num_scenes, 3);
        let unreadable: Vec<(&str, usize)> = report.unreadable.iter().map(|image| (&*image.key, image.frame)).collect();
        assert_eq!(unreadable, [(rooms(3).key(1), 1), (rooms(3).key(1), 2)]);
        assert!(report.unreadable[0].reason.contains("the PNG data of"), "{}", report.unreadable[0].reason);
        assert!(names(folder.path()).contains(&"unreadable.json".to_owned()));
    }
}

#[test]
fn scene_without_frames_is_skipped() {
    let folder = tempfile::tempdir().unwrap();
    let empty =
        TestSource::new(rooms(2)).with_cameras(|scene, cameras| Ok(if scene == 0 { Vec::new() } else { cameras }));
    let report = convert_all(&empty, folder.path(), &CHUNKS).unwrap();
    assert_eq!((report.num_scenes, report.skipped.skips.len()), (1, 1));
    assert!(report.skipped.skips[0].reason.contains("has no frames"), "{:?}", report.skipped.skips);
}

#[test]
fn keys_that_no_file_can_have_are_refused() {
    assert!(!is_file_name("a/b") && !is_file_name("..") && is_file_name("1K-ab.c"));
    assert!(!"*?\"<>|".chars().any(|no| is_file_name(&format!("a{no}"))), "invalid on Windows");
    assert!(is_file_name(&"k".repeat(200)) && !is_file_name(&"k".repeat(201)));
}

#[test]
fn chunks_and_scenes_have_a_largest_number_of_frames() {
    let folder = tempfile::tempdir().unwrap();
    let one = options(ConvertTo::Chunks { target_bytes: u64::MAX });
    let num_frames = |scene| if scene == 1 { 60_000 } else { 30_000 };
    let long = TestSource::new(rooms(3))
        .with_cameras(move |scene, cameras| Ok(vec![cameras[0]; num_frames(scene)]))
        .with_encoded_frames(|_, frame| Some(vec![frame as u8]));
    let report = convert_all(&long, folder.path(), &one).unwrap();
    assert_eq!((report.num_scenes, report.skipped.skips.len()), (2, 1));
    let reason = &report.skipped.skips[0].reason;
    assert!(reason.contains("has 60000 frames, above the limit of a file"), "{reason}");
    for name in ["000000.torch", "000001.torch"] {
        let table = ChunkTable::read(&folder.path().join(name)).unwrap();
        assert_eq!(table.scenes.into_values().map(|scene| scene.images.len()).collect::<Vec<_>>(), [30_000]);
    }
}
