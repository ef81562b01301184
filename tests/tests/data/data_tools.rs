//! Checking, indexing, converting and timing data.

use crate::support::{Place, finish, list, number, signal, wait_until};

/// A folder with two rooms; at 240x160 their textures are fine enough for corners.
fn with_rooms(size: &str) -> Place {
    let place = Place::new();
    let look = "--set texture_frequency=3.0 --set path_length=0.9 --set specular=0.1";
    place.clift(&format!("data synth DIR/rooms --scenes 2 --frames 9 --size {size} --split test {look}")).ok();
    place
}

#[test]
fn scenes_are_checked_converted_and_checked_again() {
    let place = with_rooms("240x160");
    let check = "data check DIR/rooms --json DIR/check.json --images DIR/lines";
    place.clift(check).ok().prints("2 scenes, 2 ok, 0 flagged");
    let report = place.json("check.json");
    let scene = &report["scenes"][0];
    assert_eq!((&scene["verdict"], &scene["num_frames"]), (&"ok".into(), &9.into()));
    assert_eq!(scene["reasons"], serde_json::json!([]));
    assert!(number(scene, "epipolar_px") < 1.0, "{scene}");
    let key = scene["key"].as_str().unwrap();
    assert!(place.at("lines").join(format!("test-{key}.png")).exists());
    let ran = place.clift("data convert DIR/rooms DIR/packed --to scenes").ok();
    ran.prints("2 scenes of 2; 18 frames written, 18 copied and 0 encoded");
    place.clift("data check DIR/packed").ok();
    place.clift(check).fails_with(2, &["check.json exists; replace it with --force"]);
    place.clift(&check.replace("check.json", "new.json")).fails_with(2, &["png exists; replace it with --force"]);
    place.clift(&format!("{check} --force")).ok();

    // A truncated scene is flagged.
    place.truncate(&format!("packed/test/{key}.torch"));
    let ran = place.clift("data check DIR/packed").prints("2 scenes, 1 ok, 1 flagged");
    ran.fails_with(1, &["1 of 2 scenes flagged"]);
}

#[test]
fn an_interrupted_synth_leaves_no_split() {
    let place = Place::new();
    let synth = "data synth DIR/rooms --frames 4 --size 16x16";
    for (scenes, unfinished) in [(100_000, vec![".clift-train"]), (4000, vec![".clift-test", ".clift-train"])] {
        let mut child = place.start(&format!("{synth} --scenes {scenes}"));
        let last = place.at("rooms").join(unfinished[0]);
        wait_until(&mut child, "the folder", || last.exists());
        signal(&child, "-INT");
        finish(child);
        assert_eq!(place.names("rooms"), unfinished);
    }
    place.clift(&format!("{synth} --scenes 1")).ok();
    assert_eq!(place.names("rooms"), ["evaluation_index.json", "test", "train"]);
}

#[test]
fn indices_hold_overlapping_views_and_are_not_overwritten() {
    let place = with_rooms("48x32");
    let index = "data index DIR/rooms -o DIR/index.json";
    place.clift(&format!("{index} --distance 4..8 --targets 1")).ok().prints("2 scenes of 2 with views");
    for entry in place.json("index.json").as_object().unwrap().values() {
        assert_eq!((list(&entry["context"]).len(), list(&entry["target"]).len()), (4, 1));
    }
    place.clift(index).fails_with(2, &["index.json exists; replace it with --force"]);
    let ran = place.clift("data index DIR/rooms -o DIR/other.json");
    ran.fails_with(1, &["no scene has overlapping views 45 to 135 frames apart"]);
}

#[test]
fn reading_is_timed_and_the_clips_are_named() {
    let place = with_rooms("48x32");
    let words = "bench data DIR/rooms --split test --size 32x32 --views 3+2 --clips 5 --json DIR/bench.json";
    let ran = place.clift(words).ok();
    assert!(ran.stdout.starts_with("clips of 3 + 2 frames, 32x32\n\nread "), "{}", ran.stdout);
    let report = place.json("bench.json");
    assert!(number(&report, "sequential_clips_per_s") > 0.0);
    assert_eq!(list(&report["random"]).len(), 5);
}

#[test]
fn training_takes_spread_contexts_flips_and_exact_crops() {
    let place = Place::new();
    for (name, inner) in [("far", "farthest_point"), ("even", "even")] {
        let views = format!(
            "data.views={{min_context=3, max_context=3, min_gap=[3, 3], max_gap=[6, 6], warm_up_steps=0, \
             num_targets=2, inner='{inner}'}}"
        );
        let words = format!("{name} --only stage1");
        place.train(&words, &[&views, "data.flip=true", "data.crop=\"exact\"", "data.width=8"]).ok();
        let config = place.text(&format!("{name}/config.toml"));
        assert!(config.contains("flip = true") && config.contains("crop = \"exact\""), "{config}");
    }
}
