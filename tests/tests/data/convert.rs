//! `clift data convert`: refused targets, skipped scenes, splits.

use clift_data::{ChunkSource, SceneFilters, SceneRecord, SceneSource, Split, write_chunks};

use crate::support::{Place, clift, copy_folder, repository};

/// Scenes of eight images of 64 x 36, two for training and one for testing.
const MINI: &str = "data-fixtures/re10k-mini";

/// `clift data convert` with these words.
fn convert(from: &std::path::Path, to: &std::path::Path, words: &[&str]) -> crate::support::Ran {
    let folders = [from.to_str().unwrap(), to.to_str().unwrap()];
    clift(["data", "convert"].iter().chain(&folders).chain(words))
}

#[test]
fn indices_of_both_splits_hold_all_scenes() {
    let place = Place::new();
    let out = place.at("index.json").display().to_string();
    let mini = repository(MINI).display().to_string();
    let words = ["--distance", "4..7", "--targets", "2", "--overlap", "0", "--split", "both"];
    let ran = clift(["data", "index", &mini, "-o", &out].into_iter().chain(words)).ok();
    assert!(ran.stdout.contains("3 scenes of 3 with views"), "{}", ran.stdout);
    let index = place.json("index.json");
    let keys: Vec<&String> = index.as_object().unwrap().keys().collect();
    assert_eq!(keys, ["00000000000000a1", "00000000000000a2", "00000000000000b1"]);
}

#[test]
fn conversion_into_other_data_is_refused_unwritten() {
    let place = Place::new();
    let (mini, out) = (repository(MINI), place.at("out"));
    convert(&mini, &out, &["--to", "chunks"]).ok();
    convert(&mini, &out, &["--to", "scenes"]).fails_with(
        1,
        &[
            "its files were made as: chunks of 100000000 bytes, PNG",
            "requested: a file per scene, PNG; use the same options or choose",
        ],
    );

    let other = place.at("other");
    std::fs::create_dir_all(other.join("test")).unwrap();
    std::fs::write(other.join("test/thesis.txt"), "").unwrap();
    convert(&mini, &other, &["--to", "scenes"]).fails_with(1, &["it holds thesis.txt"]);
    assert!(!other.join("train").exists(), "the other half is not begun");

    let inside = convert(&out, &out.join("scenes"), &["--to", "scenes"]).fails(2);
    assert!(inside.contains("choose an output folder outside the input"), "{inside}");
    let onto = convert(&out, &out, &["--to", "chunks"]).fails(2);
    assert!(onto.contains("choose an output folder outside the input"), "{onto}");
}

#[test]
fn test_scene_lists_split_conversion_and_check() {
    let place = Place::new();
    std::fs::write(place.at("list.txt"), "00000000000000a2\n").unwrap();
    let list = format!("data.files.test_scenes={}", place.at("list.txt").display());
    // Without split folders: all scenes lie in one folder.
    let (from, out) = (repository(MINI).join("train"), place.at("out"));
    let ran = convert(&from, &out, &["--to", "scenes", "--set", &list]).ok();
    assert!(ran.stdout.contains("train: 1 scene of 2") && ran.stdout.contains("test: 1 scene of 1"), "{}", ran.stdout);
    assert!(ran.stderr.contains("train: 1 of 2 scenes used; 1 kept for testing"), "{}", ran.stderr);
    assert_eq!(place.json("out/train/skipped.json")["skips"][0]["key"], "00000000000000a2");
    assert!(out.join("train/00000000000000a1.torch").exists() && out.join("test/00000000000000a2.torch").exists());
    assert_eq!(std::fs::read_dir(out.join("test")).unwrap().count(), 2, "and the sums");

    let words = ["data", "check", from.to_str().unwrap(), "--split", "test", "--set", &list];
    let ran = clift(words);
    assert!(ran.stdout.contains("test/00000000000000a2") && ran.stdout.contains("\n\n1 scene, "), "{}", ran.stdout);
    // The training split omits it.
    let ran = clift(["data", "check", from.to_str().unwrap(), "--set", &list]);
    assert!(ran.stdout.contains("\n\n2 scenes, ") && !ran.stdout.contains("train/00000000000000a2"), "{}", ran.stdout);
    convert(&from, &place.at("no"), &["--to", "scenes", "--set", "data.width=64"]).fails_with(2, &["unknown key"]);
}

#[test]
fn scenes_skipped_at_opening_are_listed() {
    let place = Place::new();
    let data = place.at("data");
    copy_folder(&repository("data-fixtures/layouts/capture"), &data);
    copy_folder(&data.join("attic"), &data.join("empty"));
    std::fs::remove_dir_all(data.join("empty/images")).unwrap();
    let ran = convert(&data, &place.at("out"), &["--to", "chunks"]).ok();
    assert!(ran.stderr.contains("skipped empty: without any image"), "{}", ran.stderr);
    assert!(ran.stderr.contains("skipped.json"), "{}", ran.stderr);
    let skipped = place.json("out/test/skipped.json");
    assert_eq!((&skipped["num_scenes"], &skipped["skips"][0]["key"]), (&2.into(), &"empty".into()));
    assert_eq!(
        (&skipped["frames"][0]["key"], &skipped["frames"][0]["frame"]),
        (&"attic".into(), &"./images/99".into())
    );
}

#[test]
fn conversion_and_check_without_scenes_fail() {
    let place = Place::new();
    let source = ChunkSource::open(&repository(MINI), Split::Test, &SceneFilters::default()).unwrap();
    let mut cameras = source.cameras(0).unwrap();
    cameras[0].c2w.translation[0] = f64::NAN;
    let images = (0..cameras.len()).map(|frame| source.encoded_frame(0, frame).unwrap().unwrap()).collect();
    let timestamps = source.timestamps(0).unwrap();
    let record = SceneRecord { key: "torn".into(), url: String::new(), timestamps, cameras, images };
    let data = place.at("data");
    write_chunks(&data.join("test"), [Ok(record)], 1).unwrap();
    let ran = convert(&data, &place.at("out"), &["--to", "chunks"]);
    assert!(ran.stdout.contains("0 scenes of 1"), "{}", ran.stdout);
    ran.fails_with(1, &["skipped torn: ", "no scene of test could be converted"]);
    assert!(!place.at("out/test/index.json").exists());

    std::fs::remove_file(data.join("test/000000.torch")).unwrap();
    std::fs::write(data.join("test/index.json"), "{}").unwrap();
    clift(["data", "check", data.to_str().unwrap()]).fails_with(1, &["no scenes to check"]);
}

#[test]
fn what_a_kill_leaves_behind_is_removed() {
    let place = Place::new();
    let (mini, out) = (repository(MINI), place.at("out"));
    for leftover in ["out/train/.clift-Ab12Cd", "out/test/.clift-Ef34Gh"] {
        std::fs::create_dir_all(place.at(leftover).parent().unwrap()).unwrap();
        std::fs::write(place.at(leftover), "half a file").unwrap();
        convert(&mini, &out, &["--to", "scenes"]).ok();
        assert!(!place.at(leftover).exists(), "{leftover}");
    }
}
