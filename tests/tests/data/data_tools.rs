//! Checking, indexing, converting and timing data.

use crate::support::{Place, clift};

/// Two rooms with textures fine enough for corners.
fn rooms(place: &Place) -> String {
    let rooms = place.at("rooms").display().to_string();
    let words = ["data", "synth", &rooms, "--scenes", "2", "--frames", "9", "--size", "240x160", "--split", "test"];
    let changes = ["--set", "texture_frequency=3.0", "--set", "path_length=0.9", "--set", "specular=0.1"];
    clift(words.into_iter().chain(changes)).ok();
    rooms
}

#[test]
fn scenes_are_checked_converted_and_checked_again() {
    let place = Place::new();
    let rooms = rooms(&place);
    let (json, images) = (place.at("check.json").display().to_string(), place.at("lines").display().to_string());
    let ran = clift(["data", "check", &rooms, "--json", &json, "--images", &images]).ok();
    assert!(ran.stdout.contains("2 scenes, 2 ok, 0 flagged"), "{}", ran.stdout);
    let report = place.json("check.json");
    let scene = &report["scenes"][0];
    assert_eq!(
        (&scene["ok"], &scene["num_frames"], &scene["reasons"]),
        (&true.into(), &9.into(), &serde_json::json!([]))
    );
    assert!(scene["epipolar_px"].as_f64().is_some_and(|px| px < 1.0), "{scene}");
    let key = scene["key"].as_str().unwrap();
    assert!(place.at("lines").join(format!("test-{key}.png")).exists());

    let packed = place.at("packed").display().to_string();
    let convert = || clift(["data", "convert", &rooms, &packed, "--to", "scenes"]).ok();
    let text = convert().stdout;
    assert!(text.contains("2 scenes of 2; 18 frames written, 18 copied and 0 encoded"), "{text}");
    let text = convert().stdout;
    assert!(text.contains("2 scenes of 2, 2 of them already complete; 0 frames written"), "{text}");
    clift(["data", "check", &packed]).ok();

    // A truncated scene is flagged; converting again rewrites it.
    let path = place.at("packed").join(format!("test/{key}.torch"));
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let ran = clift(["data", "check", &packed]);
    assert!(ran.stdout.contains("2 scenes, 1 ok, 1 flagged"), "{}", ran.stdout);
    ran.fails_with(1, &["1 of 2 scenes flagged"]);
    assert!(convert().stdout.contains("2 scenes of 2, 1 of them already complete; 9 frames written"));
    clift(["data", "check", &packed]).ok();
}

#[test]
fn indices_hold_overlapping_views_and_are_not_overwritten() {
    let place = Place::new();
    let rooms = rooms(&place);
    let out = place.at("index.json").display().to_string();
    let ran = clift(["data", "index", &rooms, "-o", &out, "--distance", "4..8", "--targets", "2"]).ok();
    assert!(ran.stdout.contains("2 scenes of 2 with views"), "{}", ran.stdout);
    for entry in place.json("index.json").as_object().unwrap().values() {
        assert_eq!((entry["context"].as_array().unwrap().len(), entry["target"].as_array().unwrap().len()), (4, 2));
    }
    clift(["data", "index", &rooms, "-o", &out]).fails_with(2, &["exists; remove it"]);
    let other = place.at("other.json").display().to_string();
    clift(["data", "index", &rooms, "-o", &other])
        .fails_with(1, &["no scene has overlapping views 45 to 135 frames apart"]);
}

#[test]
fn reading_is_timed_and_the_clips_are_named() {
    let place = Place::new();
    let rooms = rooms(&place);
    let json = place.at("bench.json").display().to_string();
    let words = ["bench", "data", &rooms, "--split", "test", "--size", "64x64", "--views", "3+2", "--clips", "5"];
    let ran = clift(words.into_iter().chain(["--json", &json])).ok();
    assert!(ran.stdout.starts_with("clips of 3 + 2 frames, 64x64\n\nread "), "{}", ran.stdout);
    let report = place.json("bench.json");
    assert!(report["sequential_clips_per_s"].as_f64().unwrap() > 0.0);
    assert_eq!(report["random"].as_array().unwrap().len(), 5);
}

#[test]
fn training_takes_spread_contexts_flips_and_exact_crops() {
    let place = Place::new();
    for (name, inner) in [("far", "farthest_point"), ("even", "even")] {
        let views = format!(
            "data.views={{min_context=3, max_context=3, min_gap=[3, 3], max_gap=[6, 6], warm_up_steps=0, \
             num_targets=2, inner='{inner}'}}"
        );
        place.train(name, &[&views, "data.flip=true", "data.crop=\"exact\"", "data.width=8"], &[]).ok();
        let config = place.text(&format!("{name}/config.toml"));
        assert!(config.contains("flip = true") && config.contains("crop = \"exact\""), "{config}");
    }
    let plain = place.train("plain", &[], &["--only", "stage1"]).ok();
    assert!(!place.text("plain/config.toml").contains("flip"), "{}", plain.stdout);
}
