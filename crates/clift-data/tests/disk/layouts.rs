//! One scene in every layout, written by `scripts/fixtures/make_layout_fixtures.py`.

use std::path::Path;
use std::sync::Arc;

use clift_data::{
    Clip, ClipOptions, ClipReader, FileOptions, OpenedSource, SceneFilters, SceneSource, SourceInfo, SourceKind,
    SourceOptions, Split, ViewIndices,
};

use crate::files::{copy_folder, fixtures, layout};
use crate::{open, open_test, open_with};

const KEY: &str = "d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a";

/// Folder, split, layout and key of every fixture.
const LAYOUTS: [(&str, Split, SourceKind, &str); 9] = [
    ("chunks", Split::Test, SourceKind::Chunks, KEY),
    ("depthsplat", Split::Train, SourceKind::Chunks, "dl3dv_"),
    ("scenes", Split::Test, SourceKind::Scenes, KEY),
    ("re10k_txt", Split::Test, SourceKind::Re10kTxt, KEY),
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
    let options = ClipOptions { width: 16, height: 16, ..ClipOptions::default() };
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
            let info = SourceInfo::read(source.as_ref());
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
    let source = open_test(&layout("capture")).unwrap().source;
    let camera = source.cameras(0).unwrap()[3];
    let k = camera.intrinsics;
    // Frame 3 of the script: 1.0 + 0.2 * 3, -0.5 + 0.03 * 9, 2.0 - 0.1 * 3.
    let expected = [1.6, -0.23, 1.7, 0.875, 1.5625, 0.515_625, 0.468_75];
    let got = camera.c2w.translation.to_array().into_iter().chain([k.fx, k.fy, k.cx, k.cy]);
    for (got, expected) in got.zip(expected) {
        assert!((got - expected).abs() < 1e-6, "{got} against {expected}");
    }
    for name in ["capture", "chunks"] {
        let source = open_test(&layout(name)).unwrap().source;
        assert!(source.frame(0, 6).is_err() && source.frame(1, 0).is_err() && source.cameras(1).is_err(), "{name}");
    }
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

#[test]
fn incomplete_scenes_are_skipped() {
    let root = tempfile::tempdir().unwrap();
    let torn = KEY.replace('d', "e");
    for key in [KEY, &torn] {
        copy_folder(&layout("dl3dv/1K").join(KEY), &root.path().join("2K").join(key));
    }
    std::fs::remove_file(root.path().join("2K").join(&torn).join("images_8/frame_00004.png")).unwrap();
    let OpenedSource { source, report, .. } = open_test(root.path()).unwrap();
    assert_eq!((source.num_scenes(), source.key(0)), (1, KEY));
    assert_eq!(report.skips[0].reason, "with frames that have no image");
    assert_eq!((&report.frames[0].key, report.frames[0].frame.as_str()), (&torn, "images/frame_00004.png"));
    // Images and cameras are joined by name: the frame after the missing one keeps both.
    let asked = SourceOptions { kind: SourceKind::Captures, ..SourceOptions::default() };
    let source = open(root.path(), Split::Test, &asked).unwrap().source;
    let [whole, torn] = [KEY, &torn].map(|key| source.find(key).unwrap());
    assert_eq!((source.num_scenes(), source.num_frames(torn).unwrap()), (2, 5));
    assert_eq!(source.frame(torn, 3).unwrap(), source.frame(whole, 4).unwrap());
    assert_eq!(source.cameras(torn).unwrap()[3], source.cameras(whole).unwrap()[4]);
}

#[test]
fn filters_and_sizes_skip_scenes_with_reasons() {
    for (root, num_frames) in [(layout("dl3dv"), 6), (fixtures().join("re10k-mini"), 8)] {
        let opened = |min_frames, max_fov_deg, min_size| {
            let filters = SceneFilters { min_frames, max_fov_deg };
            open(&root, Split::Test, &SourceOptions { filters, min_size, ..SourceOptions::default() })
        };
        let reasons = |min_frames, max_fov_deg, min_size| {
            let OpenedSource { source, report, .. } = opened(min_frames, max_fov_deg, min_size).unwrap();
            assert_eq!(source.num_scenes(), report.num_used());
            report.skips.into_iter().map(|skip| skip.reason).collect::<Vec<_>>()
        };
        assert_eq!(reasons(num_frames, Some(60.0), [32, 18]), [] as [&str; 0]);
        let short = format!("shorter than the {} frames of data.filters.min_frames", num_frames + 1);
        assert_eq!(reasons(num_frames + 1, None, [0, 0]), [short]);
        assert_eq!(reasons(0, Some(58.0), [0, 0]), ["with a field of view above 58 degrees"]);
        if num_frames == 6 {
            assert_eq!(reasons(0, None, [32, 19]), ["with images smaller than 32x19"]);
        }
        let message = opened(0, Some(f64::NAN), [0, 0]).err().unwrap();
        assert_eq!(message, "`max_fov_deg` = NaN: use a positive number such as 100");
    }
}

#[test]
fn re10k_frames_are_found_where_configured() {
    let root = tempfile::tempdir().unwrap();
    copy_folder(&layout("re10k_txt/test"), &root.path().join("data/test"));
    let elsewhere = root.path().join("extracted");
    copy_folder(&layout("re10k_txt/frames"), &elsewhere.join("test"));
    let data = root.path().join("data");
    let message = open_test(&data).err().unwrap();
    let expected = "none of 6 frames has an image; the first is 1000000; name frames by time stamp, such as ";
    assert!(message.contains(expected) && message.contains("data.files.frames"), "{message}");
    let files = FileOptions { frames: Some(elsewhere), ..FileOptions::default() };
    assert_eq!(open_with(&data, files).unwrap().source.num_frames(0).unwrap(), 6);
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
