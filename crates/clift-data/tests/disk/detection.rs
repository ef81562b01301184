//! Detection of data sets: splits and duplicates.

use std::fs;
use std::path::Path;

use clift_data::{DatasetRoot, FileOptions, OpenedSource, SourceKind, SourceOptions, Split};

use crate::files::{copy_folder, fixtures, layout};
use crate::open;

const HASH: &str = "d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a";

fn copy(part: &str, to: &Path) {
    copy_folder(&layout(part), to);
}

fn open_any(root: &Path, split: Split) -> OpenedSource {
    open(root, split, &SourceOptions::default()).unwrap()
}

fn keys(opened: &OpenedSource) -> Vec<&str> {
    (0..opened.source.num_scenes()).map(|scene| opened.source.key(scene)).collect()
}

#[test]
fn duplicate_benchmark_scenes_are_in_no_training_set() {
    let root = tempfile::tempdir().unwrap();
    copy(&format!("dl3dv/1K/{HASH}"), &root.path().join("1K").join(HASH));
    copy(&format!("dl3dv/1K/{HASH}"), &root.path().join("bench").join(HASH).join("nerfstudio"));
    let other = HASH.replace('d', "e");
    copy(&format!("dl3dv/1K/{HASH}"), &root.path().join("1K").join(&other));
    let list = root.path().join("list.txt");
    fs::write(&list, HASH).unwrap();
    let files = FileOptions { test_scenes: Some(list), ..FileOptions::default() };
    let options = SourceOptions { files, ..SourceOptions::default() };
    let train = open(root.path(), Split::Train, &options).unwrap();
    assert_eq!(keys(&train), [other.as_str()]);
    assert_eq!(train.report.counts()["kept for testing"], 2);
    let test = open(root.path(), Split::Test, &options).unwrap();
    assert_eq!(keys(&test), [format!("1K/{HASH}"), format!("bench/{HASH}")]);
    assert!(test.report.skips.is_empty(), "both copies exist: {}", test.report);
    assert_eq!(test.source.find(HASH), Some(0), "indices contain only the hash");
}

#[test]
fn dl3dv_scenes_among_others_are_no_captures() {
    let root = tempfile::tempdir().unwrap();
    copy("dl3dv", root.path());
    copy("colmap_bin/attic", &root.path().join("1K/stray"));
    let message = open(root.path(), Split::Train, &SourceOptions::default()).err().unwrap();
    assert!(message.contains("1 of 2 scenes are DL3DV scenes") && message.contains("such as stray"), "{message}");
    assert!(message.contains("data.source"), "{message}");
    let asked = SourceOptions { kind: SourceKind::Dl3dv, ..SourceOptions::default() };
    let opened = open(root.path(), Split::Train, &asked).unwrap();
    assert_eq!(keys(&opened), [HASH]);
    let skip = &opened.report.skips[0];
    assert_eq!((skip.key.as_str(), skip.reason.as_str()), ("stray", "with cameras in another format than dl3dv"));
    let asked = SourceOptions { kind: SourceKind::Captures, ..SourceOptions::default() };
    assert_eq!(open(root.path(), Split::Train, &asked).unwrap().source.num_scenes(), 2);
}

#[test]
fn captures_named_as_splits_hide_no_others() {
    let root = tempfile::tempdir().unwrap();
    copy("colmap_bin/attic", &root.path().join("train"));
    copy("colmap_bin/attic", &root.path().join("truck"));
    let opened = open_any(root.path(), Split::Train);
    assert_eq!((keys(&opened), opened.shares_scenes), (vec!["train", "truck"], true));
    let clips = tempfile::tempdir().unwrap();
    copy("re10k_txt/test", &clips.path().join("train"));
    assert!(DatasetRoot::find(clips.path()).unwrap().has_splits);
}

#[test]
fn chunks_open_without_an_index_and_unlisted_ones_are_reported() {
    let root = tempfile::tempdir().unwrap();
    let train = root.path().join("train");
    copy_folder(&fixtures().join("re10k-mini/train"), &train);
    fs::copy(train.join("000000.torch"), train.join("000001.torch")).unwrap();
    fs::write(train.join("index.json"), r#"{"00000000000000a1": "000000.torch"}"#).unwrap();
    let opened = open_any(root.path(), Split::Train);
    assert_eq!(keys(&opened), ["00000000000000a1"]);
    assert_eq!(opened.report.notes, ["not opened, missing from index.json: 1 .torch file (000001.torch)"]);

    fs::remove_file(train.join("index.json")).unwrap();
    for name in ["._000000.torch", "._000001.torch", "00.torch"] {
        fs::write(train.join(name), b"\0\x05\x16\x07\0\x02\0\0Mac OS X").unwrap();
    }
    let opened = open_any(root.path(), Split::Train);
    assert_eq!(keys(&opened), ["00000000000000a1", "00000000000000a2"]);
    assert!(opened.source.frame(1, 7).is_ok());
    let report = opened.report.to_string();
    assert!(report.starts_with("2 of 5 scenes used; 2 also in an earlier file; 1 bad chunk: "), "{report}");
    assert!(report.ends_with("; no index.json: the scenes of 3 files were determined from their contents"), "{report}");
}

#[test]
fn several_camera_files_are_refused_by_name() {
    let root = tempfile::tempdir().unwrap();
    fs::create_dir(root.path().join("train")).unwrap();
    for split in ["train", "test"] {
        fs::write(root.path().join(format!("transforms_{split}.json")), "{}").unwrap();
    }
    for split in [Split::Train, Split::Test] {
        let message = open(root.path(), split, &SourceOptions::default()).err().unwrap();
        let expected =
            "no transforms.json, but transforms_test.json, transforms_train.json: open one of them by its path";
        assert!(message.contains(expected), "{split}: {message}");
    }
}
