//! `clift data convert`: refused targets, skipped scenes, splits.

use clift_data::{ChunkSource, ImageEncoding, SceneFilters, SceneRecord, Split, read_scene, write_chunks};

use crate::support::{Place, copy_folder, repository};

/// Scenes of eight images of 64 x 36, two for training and one for testing.
const MINI: &str = "REPO/data-fixtures/re10k-mini";

#[test]
fn indices_of_both_splits_hold_all_scenes() {
    let place = Place::new();
    let flags = "--distance 4..7 --targets 1 --overlap 0 --split both";
    let ran = place.clift(&format!("data index {MINI} -o DIR/index.json {flags}")).ok();
    ran.prints("3 scenes of 3 with views");
    let index = place.json("index.json");
    let keys: Vec<&String> = index.as_object().unwrap().keys().collect();
    assert_eq!(keys, ["00000000000000a1", "00000000000000a2", "00000000000000b1"]);
}

#[test]
fn conversion_into_other_data_is_refused_unwritten() {
    let place = Place::new();
    let convert = |words: &str| place.clift(&format!("data convert {words}"));
    place.write("other/test/thesis.txt", "");
    let expected = ["the output folder cannot be used: it is not empty; choose another folder"];
    convert(&format!("{MINI} DIR/other --to scenes")).fails_with(2, &expected);
    assert!(!place.at("other/train").exists(), "the other half is not begun");
    convert(&format!("{MINI} DIR/out --to chunks")).ok();
    convert(&format!("{MINI} DIR/out --to scenes")).fails_with(2, &expected);
    for words in ["DIR/out DIR/out/scenes --to scenes", "DIR/out DIR/out --to chunks"] {
        convert(words).fails_with(2, &["choose an output folder outside the input"]);
    }
}

#[test]
fn test_scene_lists_split_conversion_and_check() {
    let place = Place::new();
    place.write("list.txt", "00000000000000a2\n");
    let list = "--set data.files.test_scenes=DIR/list.txt";
    // Without split folders: all scenes lie in one folder.
    let ran = place.clift(&format!("data convert {MINI}/train DIR/out --to scenes {list}")).ok();
    let ran = ran.prints("train: 1 scene of 2").prints("test: 1 scene of 1");
    ran.notes("train: 1 of 2 scenes used; 1 kept for testing");
    assert_eq!(place.json("out/train/skipped.json")["skips"][0]["key"], "00000000000000a2");
    assert!(place.at("out/train/00000000000000a1.torch").exists());
    assert!(place.at("out/test/00000000000000a2.torch").exists());
    assert_eq!(place.names("out/test").len(), 1);
    let check = |flags: &str| place.clift(&format!("data check {MINI}/train {flags} {list}"));
    check("--split test").prints("test/00000000000000a2").prints("\n\n1 scene, ");
    let ran = check("").prints("\n\n2 scenes, ");
    assert!(!ran.stdout.contains("train/00000000000000a2"), "the training split omits it: {}", ran.stdout);
    let words = format!("data convert {MINI}/train DIR/no --to scenes --set data.width=64");
    place.clift(&words).fails_with(2, &["unknown key"]);
}

#[test]
fn scenes_skipped_at_opening_are_listed() {
    let place = Place::new();
    let data = place.at("data");
    copy_folder(&repository("data-fixtures/layouts/capture"), &data);
    copy_folder(&data.join("attic"), &data.join("empty"));
    std::fs::remove_dir_all(data.join("empty/images")).unwrap();
    let ran = place.clift("data convert DIR/data DIR/out --to chunks").ok();
    ran.notes("skipped empty: without any image").notes("skipped.json");
    let skipped = place.json("out/skipped.json");
    assert_eq!((&skipped["num_scenes"], &skipped["skips"][0]["key"]), (&2.into(), &"empty".into()));
    place.clift("data info DIR/out").ok().prints("chunks").prints("all               1 scene");
    let frame = &skipped["frames"][0];
    assert_eq!((&frame["key"], &frame["frame"]), (&"attic".into(), &"./images/99".into()));
}

/// Writes the scene of the test split, changed.
fn write_changed(place: &Place, key: &str, change: impl Fn(&mut SceneRecord)) {
    let mini = repository("data-fixtures/re10k-mini");
    let source = ChunkSource::open(&mini, Split::Test, &SceneFilters::default()).unwrap();
    let (mut record, _) = read_scene(&source, 0, ImageEncoding::Png, None).unwrap();
    record.key = key.into();
    change(&mut record);
    write_chunks(&place.at("data/test"), [Ok(record)], 1).unwrap();
}

#[test]
fn unreadable_images_are_counted_and_fail() {
    let place = Place::new();
    write_changed(&place, "kitchen", |scene| {
        let half = scene.images[1].len() / 2;
        scene.images[1].truncate(half);
        scene.images[3] = b"RIFF....WEBPVP8 ".to_vec();
        scene.images[6].clear();
    });
    let written = "8 frames written, 8 copied and 0 encoded, 3 unreadable";
    let ran = place.clift("data convert DIR/data DIR/out --to chunks").prints(written);
    let ran = ran.notes("unreadable: frame 3 of scene kitchen: the 16 bytes are neither JPEG nor PNG");
    ran.fails_with(1, &["frame 1 of scene kitchen", "3 images unreadable, copied as found"]);
    let listed = place.json("out/test/unreadable.json");
    let frames: Vec<_> = listed.as_array().unwrap().iter().map(|image| image["frame"].as_u64()).collect();
    assert_eq!(frames, [Some(1), Some(3), Some(6)]);
}

#[test]
fn control_characters_of_keys_do_not_reach_the_terminal() {
    let place = Place::new();
    write_changed(&place, "a\u{1b}[2J\u{7}b\nc", |scene| scene.images.iter_mut().for_each(Vec::clear));
    let ran = place.clift("data check DIR/data").prints("test/a\\u{1b}[2J\\u{7}b\\nc  8");
    assert!(!ran.stdout.contains(['\u{1b}', '\u{7}']) && !ran.stderr.contains(['\u{1b}', '\u{7}']), "{}", ran.stdout);
    let ran = place.clift("data convert DIR/data DIR/out --to chunks").notes("scene a\\u{1b}[2J\\u{7}b\\nc: ");
    assert!(!ran.stderr.contains(['\u{1b}', '\u{7}']), "{}", ran.stderr);
}

#[test]
fn conversion_and_check_without_scenes_fail() {
    let place = Place::new();
    write_changed(&place, "torn", |scene| {
        scene.cameras.iter_mut().for_each(|camera| camera.c2w.translation[0] = f64::NAN);
    });
    let ran = place.clift("data convert DIR/data DIR/out --to chunks").prints("0 scenes of 1");
    ran.fails_with(1, &["skipped torn: ", "no scene of test could be converted"]);
    assert!(!place.at("out/test/index.json").exists());

    std::fs::remove_file(place.at("data/test/000000.torch")).unwrap();
    place.write("data/test/index.json", "{}");
    place.clift("data check DIR/data").fails_with(1, &["no scenes to check"]);
}
