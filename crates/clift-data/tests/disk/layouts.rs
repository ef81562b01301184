//! One scene in every layout, written by `scripts/fixtures/make_layout_fixtures.py`.

use std::path::Path;
use std::sync::Arc;

use clift_data::{
    Clip, ClipOptions, ClipReader, FileOptions, OpenedSource, SceneFilters, SceneSource, SourceInfo, SourceKind,
    SourceOptions, Split, ViewIndices,
};

use crate::files::{copy_folder, copy_of_layout, layout};
use crate::{open, open_test, open_with};

const KEY: &str = "d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a";

/// Folder, split, layout and key of every fixture.
const LAYOUTS: [(&str, Split, SourceKind, &str); 10] = [
    ("chunks", Split::Test, SourceKind::Chunks, KEY),
    ("depthsplat", Split::Train, SourceKind::Chunks, "dl3dv_"),
    ("scenes", Split::Test, SourceKind::Scenes, KEY),
    ("re10k_txt", Split::Test, SourceKind::Re10kTxt, KEY),
    ("re10k_folders", Split::Test, SourceKind::Re10kTxt, KEY),
    ("dl3dv_flat", Split::Test, SourceKind::Dl3dv, KEY),
    ("dl3dv", Split::Test, SourceKind::Dl3dv, KEY),
    ("dl3dv_benchmark", Split::Test, SourceKind::Dl3dv, KEY),
    ("capture", Split::Test, SourceKind::Captures, "attic"),
    ("colmap_bin", Split::Test, SourceKind::Captures, "attic"),
];

fn open_kind(root: &Path, split: Split, kind: SourceKind) -> OpenedSource {
    open(root, split, &SourceOptions { kind, ..SourceOptions::default() }).unwrap()
}

fn clip(source: Arc<dyn SceneSource>) -> Clip {
    let options = ClipOptions { width: 16, height: 16, exact_principal_point: true, ..ClipOptions::default() };
    let views = ViewIndices { context: vec![0, 2, 5], target: vec![1, 3, 4] };
    ClipReader { source, options }.read(0, &views).unwrap()
}

fn numbers(clip: &Clip) -> Vec<f64> {
    let views = [&clip.context, &clip.target];
    let cameras = views.iter().flat_map(|views| &views.cameras);
    cameras.flat_map(|camera| camera.c2w.to_matrix_f64().into_iter().chain(camera.intrinsics.to_array())).collect()
}

#[test]
fn all_layouts_give_the_same_clip() {
    let expected = clip(open_test(&layout("chunks")).unwrap().source);
    let text_model = ("colmap_txt", Split::Test, SourceKind::Captures, "attic");
    for (name, split, kind, key) in LAYOUTS.into_iter().chain([text_model]) {
        for asked in [SourceKind::Auto, kind] {
            let opened = open_kind(&layout(name), split, asked);
            assert_eq!((opened.kind, opened.source.num_scenes()), (kind, 1), "{name}");
            let source = opened.source;
            assert!(source.key(0).starts_with(key), "{name}: {}", source.key(0));
            let found = if key == "attic" { key } else { KEY };
            assert_eq!((source.find(found), source.num_frames(0).unwrap()), (Some(0), 6), "{name}");
            let info = SourceInfo::read(source.as_ref()).unwrap();
            // atan(0.515625 / 0.875) + atan(0.484375 / 0.875), by hand
            let fov_deg = format!("{:.1}", info.fov_deg.unwrap().max);
            assert_eq!((info.num_scenes, info.image_sizes["32x18"], fov_deg.as_str()), (1, 1, "59.5"), "{name}");
            let clip = clip(source.clone());
            assert_eq!(clip.context.images, expected.context.images, "{name}");
            assert_eq!(clip.target.images, expected.target.images, "{name}");
            for (got, expected) in numbers(&clip).into_iter().zip(numbers(&expected)) {
                // Chunks hold f32 and RealEstate10K nine decimals; the path is two units long.
                assert!((got - expected).abs() < 1e-5, "{name}: {got} against {expected}");
            }
            let file = source.encoded_frame(0, 3).unwrap().expect("the file of a frame");
            assert_eq!(clift_data::decode_image(&file, "", 3).unwrap(), source.frame(0, 3).unwrap(), "{name}");
        }
    }
}

#[test]
fn cameras_equal_those_of_the_fixture_script() {
    // Frame 3 of the script: 1.0 + 0.2 * 3, -0.5 + 0.03 * 9, 2.0 - 0.1 * 3.
    for (name, split, ..) in LAYOUTS {
        let source = open_kind(&layout(name), split, SourceKind::Auto).source;
        let camera = source.cameras(0).unwrap()[3];
        let k = camera.intrinsics;
        let expected = [1.6, -0.23, 1.7, 0.875, 1.5625, 0.515_625, 0.468_75];
        let got = camera.c2w.translation.to_array().into_iter().chain([k.fx, k.fy, k.cx, k.cy]);
        for (got, expected) in got.zip(expected) {
            assert!((got - expected).abs() < 1e-6, "{name}: {got} against {expected}"); // f32
        }
        assert!(source.frame(0, 6).is_err() && source.frame(1, 0).is_err() && source.cameras(1).is_err(), "{name}");
    }
}

#[test]
fn timestamps_and_urls_come_from_the_files() {
    let times = |name: &str| open_test(&layout(name)).unwrap().source.timestamps(0).unwrap();
    assert_eq!(times("re10k_txt")[..2], [1_000_000, 1_033_367]);
    assert_eq!(times("dl3dv"), [1, 2, 3, 4, 5, 6]);
    assert_eq!(times("capture"), [8, 9, 10, 11, 12, 13]);
    let url = |name: &str| open_test(&layout(name)).unwrap().source.url(0).unwrap();
    assert_eq!((url("re10k_txt").as_str(), url("dl3dv").as_str()), ("https://example.org/watch", ""));
}

#[test]
fn captures_open_as_folders_or_file() {
    let capture = layout("capture");
    let expected = clip(open_test(&capture).unwrap().source);
    for part in ["attic", "attic/transforms.json"] {
        let opened = open_kind(&capture.join(part), Split::Train, SourceKind::Auto);
        assert_eq!((opened.source.key(0), opened.kind), ("attic", SourceKind::Captures));
        assert_eq!(clip(opened.source), expected, "{part}");
    }
    let model = open_test(&layout("colmap_txt/attic")).unwrap().source;
    assert_eq!((model.key(0), model.num_scenes()), ("attic", 1));
}

/// Writes two copies of the DL3DV fixture, with a frame of the second renamed; returns their keys.
fn two_scenes(root: &Path) -> [String; 2] {
    let keys = [KEY.to_owned(), KEY.replace('d', "e")];
    for key in &keys {
        copy_folder(&layout("dl3dv/1K").join(KEY), &root.join("2K").join(key));
    }
    let images = root.join("2K").join(&keys[1]).join("images_8");
    std::fs::rename(images.join("frame_00004.png"), images.join("4.png")).unwrap();
    keys
}

#[test]
fn incomplete_scenes_are_skipped_unless_asked_for() {
    let root = tempfile::tempdir().unwrap();
    let [whole, torn] = two_scenes(root.path());
    let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
    assert_eq!((source.num_scenes(), source.key(0)), (1, whole.as_str()));
    assert_eq!(report.skips[0].reason, "with frames that have no image");
    assert_eq!((&report.frames[0].key, report.frames[0].frame.as_str()), (&torn, "images/frame_00004.png"));
    let files = FileOptions { keep_incomplete: true, ..FileOptions::default() };
    let OpenedSource { source, report, .. } = open_with(root.path(), files).unwrap();
    let scene = source.find(&torn).unwrap();
    assert_eq!((source.num_scenes(), source.num_frames(scene).unwrap()), (2, 5));
    assert!(report.skips.is_empty() && report.frames.len() == 1);
    // Images and cameras are joined by name: the frame after the missing one keeps both.
    let other = source.find(&whole).unwrap();
    assert_eq!(source.frame(scene, 3).unwrap(), source.frame(other, 4).unwrap());
    assert_eq!(source.cameras(scene).unwrap()[3], source.cameras(other).unwrap()[4]);
}

#[test]
fn filters_and_sizes_skip_scenes_with_reasons() {
    let report = |filters: SceneFilters, min_size: [usize; 2]| {
        let options = SourceOptions { filters, min_size, ..SourceOptions::default() };
        let OpenedSource { source, report, .. } = open(&layout("dl3dv"), Split::Test, &options).unwrap();
        assert_eq!(source.num_scenes(), report.num_used());
        report.skips.into_iter().map(|skip| skip.reason).collect::<Vec<_>>()
    };
    let none = SceneFilters::default;
    assert_eq!(report(none(), [32, 18]), [] as [&str; 0]);
    assert_eq!(report(none(), [32, 19]), ["with images smaller than 32x19"]);
    assert_eq!(
        report(SceneFilters { min_frames: 7, ..none() }, [0, 0]),
        ["shorter than the 7 frames of data.filters.min_frames"]
    );
    let narrow = SceneFilters { max_fov_deg: Some(40.0), ..none() };
    assert_eq!(report(narrow, [0, 0]), ["with a field of view above 40 degrees"]);
}

#[test]
fn image_folders_may_be_chosen() {
    let root = copy_of_layout("dl3dv");
    let scene = root.path().join("1K").join(KEY);
    copy_folder(&scene.join("images_8"), &scene.join("small"));
    let chosen = |folder: &str| {
        open_with(root.path(), FileOptions { image_folder: Some(folder.into()), ..FileOptions::default() })
    };
    assert_eq!(chosen("small").unwrap().source.num_frames(0).unwrap(), 6);
    let message = chosen("large").err().unwrap();
    assert!(message.contains("none of 6 frames has an image; the first is images/frame_00001.png"), "{message}");
    assert!(message.ends_with("transforms.json"), "{message}");
}

#[test]
fn re10k_frames_are_found_where_configured() {
    let root = tempfile::tempdir().unwrap();
    copy_folder(&layout("re10k_txt/test"), &root.path().join("data/test"));
    let elsewhere = root.path().join("extracted");
    copy_folder(&layout("re10k_txt/frames"), &elsewhere.join("test"));
    let data = root.path().join("data");
    let message = open_test(&data).err().unwrap();
    assert!(message.contains("none of 6 frames has an image; the first is 1000000"), "{message}");
    let files = FileOptions { frames: Some(elsewhere), ..FileOptions::default() };
    assert_eq!(open_with(&data, files).unwrap().source.num_frames(0).unwrap(), 6);
}

#[test]
fn scenes_and_chunks_open_without_an_index() {
    let root = copy_of_layout("scenes");
    let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
    assert_eq!((source.key(0), report.to_string()), (KEY, "1 of 1 scenes used".into()));
    std::fs::write(root.path().join("test/invalid_keys.txt"), KEY).unwrap();
    let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
    assert_eq!((source.num_scenes(), report.to_string()), (0, "0 of 1 scenes used; 1 in invalid_keys.txt".into()));
    let chunks = copy_of_layout("chunks");
    std::fs::remove_file(chunks.path().join("test/index.json")).unwrap();
    std::fs::write(chunks.path().join("test/000001.torch"), "cut").unwrap();
    let opened = open_test(chunks.path()).unwrap();
    assert_eq!((opened.source.key(0), opened.source.num_frames(0).unwrap()), (KEY, 6));
    let report = opened.report.to_string();
    assert!(report.starts_with("1 of 2 scenes used; 1 bad chunk: "), "{report}");
    assert!(report.ends_with("no index.json: the scenes of 2 files were determined from their contents"), "{report}");
}

#[test]
fn scenes_of_equal_name_take_distinct_keys() {
    let root = tempfile::tempdir().unwrap();
    for path in ["a/attic", "b/c/attic", "b/cellar"] {
        copy_folder(&layout("capture/attic"), &root.path().join(path));
    }
    let source = open_test(root.path()).unwrap().source;
    let keys: Vec<&str> = (0..source.num_scenes()).map(|scene| source.key(scene)).collect();
    assert_eq!(keys, ["a/attic", "b/c/attic", "cellar"]);
}

#[test]
fn split_folders_differ_from_a_shared_folder() {
    let root = tempfile::tempdir().unwrap();
    copy_folder(&layout("capture"), &root.path().join("train"));
    let opened = open_kind(root.path(), Split::Train, SourceKind::Auto);
    assert!(!opened.shares_scenes && opened.report.notes.is_empty());
    let error = open_test(root.path()).err().unwrap();
    assert!(error.starts_with("no scenes found: no folder test/ beside the other split: "));
    assert!(open_test(&root.path().join("train")).unwrap().shares_scenes);
}
