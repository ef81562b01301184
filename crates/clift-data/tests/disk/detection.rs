//! Detection of data sets: splits, links, duplicates, other layouts.

use std::fs;
use std::path::Path;

use clift_data::{DatasetRoot, FileOptions, OpenedSource, SceneFilters, SourceKind, SourceOptions, Split};

use crate::files::{copy_folder, fixtures, layout};
use crate::open;

const HASH: &str = "d6b00d693f813db59886beb214cc6e1939fe3d29fc1b4349616adf2d36ebdc6a";

fn copy(part: &str, to: &Path) {
    copy_folder(&layout(part), to);
}

fn has_splits(root: &Path) -> bool {
    DatasetRoot::find(root).unwrap().has_splits
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
    let note = format!("1 scene of DL3DV with several copies, all of which are used: 1K/{HASH} and bench/{HASH}");
    assert!(train.report.notes.contains(&note), "{:?}", train.report.notes);
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
    fs::rename(root.path().join("truck"), root.path().join("test")).unwrap();
    assert!(has_splits(root.path()), "two splits of one capture each");
    copy("colmap_bin/attic", &root.path().join("truck"));
    assert!(!has_splits(root.path()));
    // A single RealEstate10K clip in a split looks like a scene folder.
    let clips = tempfile::tempdir().unwrap();
    copy("re10k_txt/test", &clips.path().join("train"));
    assert!(has_splits(clips.path()));
}

#[cfg(unix)]
#[test]
fn linked_folders_keep_their_own_names() {
    use std::os::unix::fs::symlink;
    let root = tempfile::tempdir().unwrap();
    let path = |name: &str| root.path().join(name);
    for name in ["far/y", "z"] {
        copy("colmap_bin/attic", &path(name));
    }
    // Links before and after the folder in order of names.
    for (link, to) in [("a", "z"), ("zz", "z"), ("b", "far"), ("self", "."), ("gone", "nowhere")] {
        symlink(path(to), path(link)).unwrap();
    }
    let opened = open_any(root.path(), Split::Test);
    assert_eq!(keys(&opened), ["y", "z"]);
    assert_eq!(opened.report.notes[0], "2 links to scenes that are used already: a to z, zz to z");
}

#[test]
fn unindexed_chunks_and_scenes_are_reported() {
    let root = tempfile::tempdir().unwrap();
    let train = root.path().join("train");
    copy_folder(&fixtures().join("re10k-mini/train"), &train);
    fs::copy(train.join("000000.torch"), train.join("000001.torch")).unwrap();
    fs::write(train.join("index.json"), r#"{"00000000000000a1": "000000.torch"}"#).unwrap();
    let opened = open_any(root.path(), Split::Train);
    assert_eq!(opened.report.notes, ["not opened, missing from index.json: 1 .torch file (000001.torch)"]);
    let filters = SceneFilters { min_frames: 2, max_fov_deg: None };
    for options in [
        SourceOptions { reads_chunks: true, ..SourceOptions::default() },
        SourceOptions { filters, ..SourceOptions::default() },
    ] {
        let opened = open(root.path(), Split::Train, &options).unwrap();
        assert_eq!(keys(&opened), ["00000000000000a1"]);
        let expected = "1 of 2 scenes used; 1 in a chunk but not in its index.json";
        assert!(opened.report.to_string().starts_with(expected), "{}", opened.report);
        assert_eq!(opened.report.skips[0].key, "00000000000000a2");
    }
    let index = r#"{"00000000000000a1": "000000.torch", "00000000000000a2": "000001.torch"}"#;
    fs::write(train.join("index.json"), index).unwrap();
    let options = SourceOptions { reads_chunks: true, ..SourceOptions::default() };
    let opened = open(root.path(), Split::Train, &options).unwrap();
    let expected = "2 of 2 scenes used; 2 scenes also in chunks other than those of index.json, not used \
                    (00000000000000a1, 00000000000000a2)";
    assert_eq!(opened.report.to_string(), expected);
}

#[test]
fn duplicate_scenes_use_the_first_file() {
    let root = tempfile::tempdir().unwrap();
    let train = root.path().join("train");
    copy_folder(&fixtures().join("re10k-mini/train"), &train);
    fs::remove_file(train.join("index.json")).unwrap();
    fs::copy(train.join("000000.torch"), train.join("000009.torch")).unwrap();
    let opened = open_any(root.path(), Split::Train);
    assert_eq!(opened.source.num_scenes(), 2);
    let expected = "2 scenes in more than one file, the first of which is used (00000000000000a1 in 000000.torch and \
                    000009.torch, 00000000000000a2 in 000000.torch and 000009.torch)";
    assert_eq!(opened.report.notes[0], expected);
    fs::remove_file(train.join("000009.torch")).unwrap();
    assert!(open_any(root.path(), Split::Train).source.frame(1, 7).is_ok());
}

#[test]
fn data_of_other_layouts_is_named() {
    let root = tempfile::tempdir().unwrap();
    copy("capture/attic", &root.path().join("captures/attic"));
    copy_folder(&fixtures().join("re10k-mini"), &root.path().join("re10k"));
    copy("re10k_txt", &root.path().join("clips"));
    let opened = open_any(root.path(), Split::Test);
    assert_eq!(keys(&opened), ["attic"]);
    let expected = "not opened, other data sets: clips/test (text files of RealEstate10K), \
                    re10k/test (chunks or scenes in .torch files), re10k/train (chunks or scenes in .torch files)";
    assert_eq!(opened.report.notes[0], expected);
    fs::remove_dir_all(root.path().join("captures")).unwrap();
    fs::remove_dir_all(root.path().join("clips")).unwrap();
    let message = open(root.path(), Split::Test, &SourceOptions::default()).err().unwrap();
    assert!(message.contains("other data sets below it, to be opened separately: re10k/test (chunks"), "{message}");
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
