//! Checking and indexing data.

use crate::support::{Place, copy_folder, finish, list, number, repository, signal, wait_until};

/// A folder with two rooms; at 240x160 their textures are fine enough for corners.
fn with_rooms(size: &str) -> Place {
    let place = Place::new();
    let look = "--set texture_frequency=3.0 --set path_length=0.9 --set specular=0.1";
    place.clift(&format!("data synth DIR/rooms --scenes 2 --frames 9 --size {size} --split test {look}")).ok();
    place
}

#[test]
fn scenes_are_checked() {
    let place = with_rooms("240x160");
    place.clift("data check DIR/rooms --json DIR/check.json").ok().prints("2 scenes, 2 ok, 0 flagged");
    let report = place.json("check.json");
    let scene = &report["scenes"][0];
    assert_eq!((&scene["verdict"], &scene["num_frames"]), (&"ok".into(), &9.into()));
    assert_eq!(scene["reasons"], serde_json::json!([]));
    assert!(number(scene, "epipolar_px") < 1.0, "{scene}");
}

#[test]
fn a_check_fails_for_damaged_chunks_and_without_scenes() {
    let place = Place::new();
    copy_folder(&repository("data-fixtures/re10k-mini/test"), &place.at("data/test"));
    place.truncate("data/test/000000.torch");
    place.clift("data check DIR/data").fails_with(1, &["bad chunk: ", "perhaps truncated", "000000.torch"]);
    std::fs::remove_file(place.at("data/test/000000.torch")).unwrap();
    place.write("data/test/index.json", "{}");
    place.clift("data check DIR/data").fails_with(1, &["no scenes to check"]);
}

#[test]
fn an_interrupted_synth_leaves_no_split() {
    let place = Place::new();
    let synth = "data synth DIR/rooms --frames 4 --size 16x16";
    for (scenes, unfinished) in [(100_000, vec![".clift-train"]), (4000, vec![".clift-test", ".clift-train"])] {
        let mut child = place.start(&format!("{synth} --scenes {scenes}"));
        let last = place.at("rooms").join(unfinished[0]);
        wait_until(&mut child, "the folder", || last.exists());
        // A shell without job control makes its background commands ignore SIGINT.
        signal(&child, "-TERM");
        finish(child);
        assert_eq!(place.names("rooms"), unfinished);
    }
    place.clift(&format!("{synth} --scenes 1")).ok();
    assert_eq!(place.names("rooms"), ["evaluation_index.json", "test", "train"]);
    place.clift(synth).fails_with(2, &["train exists; choose another folder"]);
    std::fs::remove_dir_all(place.at("rooms/test")).unwrap();
    place.clift(&format!("{synth} --split test")).fails_with(2, &["evaluation_index.json exists"]);
}

#[test]
fn indices_hold_overlapping_views() {
    let place = with_rooms("48x32");
    place
        .clift("data index DIR/rooms -o DIR/index.json --distance 4..8 --targets 1")
        .ok()
        .prints("2 scenes of 2 with views");
    for entry in place.json("index.json").as_object().unwrap().values() {
        assert_eq!((list(&entry["context"]).len(), list(&entry["target"]).len()), (4, 1));
    }
    let ran = place.clift("data index DIR/rooms -o DIR/other.json");
    ran.fails_with(1, &["no scene has overlapping views 45 to 135 frames apart"]);

    let flags = "-o DIR/both.json --distance 4..7 --targets 1 --overlap 0 --split both";
    let ran = place.clift(&format!("data index REPO/data-fixtures/re10k-mini {flags}")).ok();
    ran.prints("3 scenes of 3 with views");
    let index = place.json("both.json");
    let keys: Vec<&String> = index.as_object().unwrap().keys().collect();
    assert_eq!(keys, ["00000000000000a1", "00000000000000a2", "00000000000000b1"]);
}
