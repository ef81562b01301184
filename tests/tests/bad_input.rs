//! Input that is wrong, damaged or missing: what it says and what goes on.

use std::path::Path;

use clift_data::{ChunkSource, SceneFilters, SceneRecord, SceneSource, Split, write_chunks};

use crate::support::{Place, Ran, clift, copy_folder, files, repository};

/// The pictures of two training scenes and a test scene, written by PyTorch's own `torch.save`.
const MINI: &str = "data-fixtures/re10k-mini";
/// The training scenes of it.
const KEYS: [&str; 2] = ["00000000000000a1", "00000000000000a2"];

/// Trains the micro run on a folder of chunks.
fn train_on(place: &Place, data: &Path, set: &[&str], flags: &[&str]) -> Ran {
    let root = format!("data.root=\"{}\"", data.display());
    let chunks = ["data.source=chunks", root.as_str(), "data.width=32", "data.height=32"];
    place.train("run", &[&chunks[..], set].concat(), flags)
}

/// Copies the mini data set, with its two training scenes in a chunk each.
fn two_chunks(place: &Place) -> std::path::PathBuf {
    let data = place.at("data");
    copy_folder(&repository(MINI), &data);
    std::fs::copy(data.join("train/000000.torch"), data.join("train/000001.torch")).unwrap();
    let index = serde_json::json!({KEYS[0]: "000000.torch", KEYS[1]: "000001.torch"});
    std::fs::write(data.join("train/index.json"), index.to_string()).unwrap();
    data
}

/// Copies the mini data set with one training scene changed.
fn changed_scene(place: &Place, change: impl Fn(&mut SceneRecord)) -> std::path::PathBuf {
    let data = place.at("data");
    copy_folder(&repository(MINI).join("test"), &data.join("test"));
    let source = ChunkSource::open(&repository(MINI), Split::Train, &SceneFilters::default()).unwrap();
    let scenes = (0..source.num_scenes()).map(|scene| {
        let frames = 0..source.num_frames(scene)?;
        let mut record = SceneRecord {
            key: source.key(scene).into(),
            url: source.url(scene)?,
            timestamps: source.timestamps(scene)?,
            cameras: source.cameras(scene)?,
            images: frames
                .filter_map(|frame| source.encoded_frame(scene, frame).transpose())
                .collect::<Result<_, _>>()?,
        };
        if record.key == KEYS[1] {
            change(&mut record);
        }
        Ok(record)
    });
    write_chunks(&data.join("train"), scenes, u64::MAX).unwrap();
    data
}

/// Expects a run that left the second scene out for `reason`, said so, and trained on the first one.
fn assert_second_is_skipped(place: &Place, ran: Ran, reason: &str) {
    let stderr = ran.ok().stderr;
    let lines: Vec<_> = stderr.lines().filter(|line| line.starts_with("skipped ")).collect();
    assert!(!lines.is_empty(), "{stderr}");
    let saved = place.text("run/skipped.jsonl");
    assert_eq!(saved.lines().count(), 1, "once for all draws: {saved}");
    assert!(saved.contains(KEYS[1]) && saved.contains("\"reason\":"), "{saved}");
    for line in lines {
        assert!(line.starts_with(&format!("skipped {}: ", KEYS[1])) && line.contains(reason), "{line}");
    }
    assert_eq!(place.metrics("run").len(), 6 + 4, "every step is made");
    let clusters = place.json("run/clusters/index.json");
    let keys: Vec<_> = clusters["entries"].as_array().unwrap().iter().map(|entry| &entry["key"]).collect();
    assert_eq!(keys, [KEYS[0]]);
    assert_eq!(clusters["skipped"]["skips"][0]["key"], KEYS[1], "the ledger is saved");
    assert_eq!(place.json("run/eval/summary.json")["num_scenes"], 1);
}

#[test]
fn an_unknown_key_is_shown_in_its_line_with_the_nearest_one() {
    let place = Place::new();
    let text = std::fs::read_to_string(repository("configs/tiny.toml")).unwrap();
    let wrong = text.replacen("learning_rate", "learnin_rate", 1);
    assert_ne!(wrong, text);
    std::fs::write(place.at("wrong.toml"), &wrong).unwrap();
    let path = place.at("wrong.toml").display().to_string();

    let message = clift(["train", &path]).fails(2);
    let line = 1 + wrong[..wrong.find("learnin_rate").unwrap()].matches('\n').count();
    assert!(message.contains("unknown key `learnin_rate` in [stage1.optimizer]\n"), "{message}");
    assert!(message.contains(&format!("--> {path}:{line}:")), "line {line}: {message}");
    assert!(message.contains(" ^^^^^^^^^^^^ did you mean `learning_rate`?"), "{message}");

    let message = place.train("run", &["stage1.step=3"], &[]).fails(2);
    assert!(message.contains("stage1.step=3\n |        ^^^^ did you mean `steps`?"), "{message}");
    let message = place.train("run", &["stage1.steps=ten"], &[]).fails(2);
    assert!(message.contains("expected a whole number of 0 or more, got the string \"ten\""), "{message}");
    assert!(!place.at("run").exists(), "a refused config leaves nothing behind");
}

#[test]
fn wrong_usage_is_told_from_failure_by_the_exit_code() {
    let place = Place::new();
    let message = clift(["train", "no/such.toml"]).fails(2);
    assert!(message.starts_with("error: reading the configuration failed: "), "{message}");
    assert!(message.trim_end().ends_with(": no/such.toml"), "what, where, why, the path last: {message}");
    for (set, expected) in [
        (vec!["data.source=chunks"], "`data.root` = missing: write the folder that holds train/ and test/"),
        (vec!["model.num_heads=3"], "`model.num_heads` = 3: write a divisor of model.dim = 16"),
        (vec!["data.width=20"], "`data.width` = 20: write a multiple of model.patch_size = 8"),
        (vec!["stage1.batch_size=0"], "`stage1.batch_size` = 0: write at least 1"),
        (vec!["stage1.accumulate=3"], "`stage1.accumulate` = 3: write 1 to 2"),
        (vec!["device=cuda"], "unknown value of `device`"),
        (vec!["data.views.min_context=1"], "`data.views.min_context` = 1: a stretch has two ends, so use 2 or more"),
        (vec!["clusters.grid=[9]"], "`clusters.grid` = 9: a scene has as few as 8 tokens"),
        (vec!["data.synthetic.fov_deg=180.0"], "`data.synthetic.fov_deg` = 180: use 10 to 100"),
    ] {
        let message = place.train("run", &set, &[]).fails(2);
        assert!(message.contains(expected), "{expected}: {message}");
        assert!(!place.at("run").exists(), "a refused config leaves nothing behind");
    }
    // Known once the scenes are open, and before a step is made.
    let message = place.train("run", &["eval.storage=[9]"], &[]).fails(2);
    let expected = "`eval.storage` = 9: write at most 8, the fewest tokens of an evaluated scene";
    assert!(message.contains(expected), "{message}");
    assert!(!place.at("run/metrics.jsonl").exists());
    let nowhere = place.at("nowhere");
    let message = train_on(&place, &nowhere, &[], &[]).fails(1);
    assert!(message.trim_end().ends_with(&nowhere.display().to_string()), "{message}");
    // The corrected command is no other run: nothing was trained with the wrong one.
    train_on(&place, &repository(MINI), &[], &["--only", "stage1"]).ok();
}

#[cfg(not(feature = "wgpu"))]
#[test]
fn a_device_that_is_not_built_in_says_how_to_rebuild() {
    let place = Place::new();
    let message = place.train("run", &[], &["--device", "wgpu"]).fails(2);
    assert!(message.contains("cargo build --release --features wgpu"), "{message}");
    assert!(message.contains("`--device flex`"), "{message}");
    assert!(!place.at("run").exists());
}

#[test]
fn torch_files_train_without_skips_and_an_index_may_have_null_entries() {
    let place = Place::new();
    let index = format!("eval.index={:?}", repository(MINI).join("evaluation_index.json"));
    let stderr = train_on(&place, &repository(MINI), &[&index], &[]).ok().stderr;
    assert!(!stderr.contains("skipped"), "{stderr}");
    assert!(stderr.contains("evaluation: 1 of 3 scenes used; 2 without views in the evaluation index"), "{stderr}");
    let summary = place.json("run/eval/summary.json");
    let counts = ["num_scenes", "num_views", "num_skipped"].map(|key| summary[key].as_u64());
    assert_eq!(counts, [Some(1), Some(4), Some(2)]);
    // Its four contexts of 16 patches each, half of them and all.
    assert_eq!(summary["points"][0]["num_storage_tokens"], 32);
    assert_eq!(summary["points"][1]["num_storage_tokens"], 64);
}

#[test]
fn an_index_of_other_scenes_fails_before_training() {
    let place = Place::new();
    std::fs::write(place.at("index.json"), r#"{"ffff": {"context": [0, 2], "target": [1]}}"#).unwrap();
    let index = format!("eval.index={:?}", place.at("index.json"));
    let message = train_on(&place, &repository(MINI), &[&index], &[]).fails(1);
    assert!(message.contains("no usable scene: evaluation: 0 of 1 scenes used; 1 not in the data"), "{message}");
    assert!(!place.at("run/metrics.jsonl").exists());

    for (text, expected) in [
        (
            r#"{"00000000000000b1": {"context": [0, 9], "target": [1]}}"#,
            "it asks for frame 9 of scene 00000000000000b1",
        ),
        (r#"{"00000000000000b1": {"context": [0, 2]}}"#, "has 2 context and 0 target frames"),
        ("[]", "bad index: expected {key: "),
    ] {
        std::fs::write(place.at("index.json"), text).unwrap();
        let message = train_on(&place, &repository(MINI), &[&index], &[]).fails(1);
        assert!(message.contains(expected) && message.trim_end().ends_with("index.json"), "{expected}: {message}");
    }
}

#[test]
fn targets_that_are_contexts_are_measured() {
    let place = Place::new();
    std::fs::write(place.at("index.json"), r#"{"00000000000000b1": {"context": [0, 7], "target": [0, 7]}}"#).unwrap();
    let index = format!("eval.index={:?}", place.at("index.json"));
    // Contexts that are neighbours leave no other frame to draw targets from.
    let views = "data.views={min_context=2, max_context=2, min_gap=[1, 1], max_gap=[1, 1], num_targets=3}";
    let stderr = train_on(&place, &repository(MINI), &[&index, views], &[]).ok().stderr;
    assert!(!stderr.contains("skipped"), "{stderr}");
    let summary = place.json("run/eval/summary.json");
    // The nearest view is the target itself: an infinite PSNR counts as 100 dB.
    assert_eq!(summary["baselines"]["nearest_view"]["psnr"], 100.0);
    assert!(summary["points"][0]["psnr"].as_f64().unwrap() < 40.0, "{summary}");
}

#[test]
fn a_truncated_chunk_is_skipped_and_named() {
    let place = Place::new();
    let data = two_chunks(&place);
    place.truncate("data/train/000001.torch");
    let ran = train_on(&place, &data, &[], &[]);
    let path = data.join("train/000001.torch").display().to_string();
    assert_second_is_skipped(&place, ran, &path);

    place.truncate("data/train/000000.torch");
    let message = train_on(&place, &data, &[], &["--fresh"]).fails(1);
    assert!(message.contains("error: no usable scene for slot 0 of step 0 in 16 tries; the last, "), "{message}");
    assert!(message.contains("bad chunk: "), "{message}");
    assert!(message.trim_end().ends_with("000000.torch") || message.trim_end().ends_with("000001.torch"), "{message}");
}

#[test]
fn a_chunk_that_would_run_code_is_skipped_and_named() {
    let place = Place::new();
    let data = two_chunks(&place);
    std::fs::copy(repository("data-fixtures/hostile/calls_system.torch"), data.join("train/000001.torch")).unwrap();
    let ran = train_on(&place, &data, &[], &[]);
    assert_second_is_skipped(&place, ran, "which is not allowed; nothing was run");
}

#[test]
fn an_unreadable_picture_is_skipped_and_named() {
    let place = Place::new();
    let data = changed_scene(&place, |scene| {
        for image in &mut scene.images {
            image.truncate(image.len() / 2);
        }
    });
    let ran = train_on(&place, &data, &[], &[]);
    assert_second_is_skipped(&place, ran, "of scene 00000000000000a2 cannot be decoded: its JPEG data of ");
}

#[test]
fn a_scene_too_short_for_any_step_is_left_out_at_the_start_and_listed() {
    let place = Place::new();
    let data = changed_scene(&place, |scene| {
        scene.images.truncate(3);
        scene.cameras.truncate(3);
        scene.timestamps.truncate(3);
    });
    let ran = train_on(&place, &data, &[], &["--only", "stage1"]).ok();
    let expected = "train: 1 of 2 scenes used; 1 shorter than the 4 frames that data.views needs";
    assert!(ran.stderr.contains(expected), "{}", ran.stderr);
    assert!(!ran.stderr.contains("skipped "), "{}", ran.stderr);
    assert_eq!(place.json("run/skipped-train.json")["skips"][0]["key"], KEYS[1]);
}

#[test]
fn poses_that_are_not_finite_are_skipped_and_named() {
    for value in [f64::NAN, f64::INFINITY] {
        let place = Place::new();
        let data = changed_scene(&place, |scene| {
            for camera in &mut scene.cameras {
                camera.c2w.translation[1] = value;
            }
        });
        let ran = train_on(&place, &data, &[], &[]);
        assert_second_is_skipped(&place, ran, "bad camera: ");
    }
}

#[test]
fn scenes_without_a_baseline_are_skipped_with_the_reason() {
    let place = Place::new();
    let data = changed_scene(&place, |scene| {
        for camera in &mut scene.cameras {
            camera.c2w.translation = [1.0, 2.0, 3.0].into();
        }
    });
    let ran = train_on(&place, &data, &[], &[]);
    assert_second_is_skipped(&place, ran, "scene 00000000000000a2 has no baseline: its 2 camera centres lie within ");
}

#[test]
fn pictures_smaller_than_the_configured_size_are_refused_with_the_fix() {
    let place = Place::new();
    let message = train_on(&place, &repository(MINI), &["data.height=64"], &[]).fails(1);
    assert!(message.contains("cannot make a 32x64 picture from one of 64x36"), "{message}");
    assert!(message.contains("lower the configured size"), "{message}");
}

#[test]
fn truncated_weights_and_a_stale_cluster_cache_are_refused() {
    let place = Place::new();
    place.train("run", &[], &[]).ok();
    place.truncate("run/stage2/model.safetensors");
    let message = place.eval("run", &[]).fails(1);
    assert!(message.contains("reading the weights failed: "), "{message}");
    assert!(message.trim_end().ends_with("run/stage2/model.safetensors"), "{message}");

    std::fs::remove_dir_all(place.at("run/stage2")).unwrap();
    let clusters = place.at("run/clusters/index.json");
    let good = place.json("run/clusters/index.json");
    let mut stale = good.clone();
    stale["encoder"] = "0123456789abcdef".into();
    std::fs::write(&clusters, stale.to_string()).unwrap();
    let message = place.train("run", &[], &[]).fails(1);
    assert!(
        message.contains("stale cluster cache: its tokens are of encoder 0123456789ab, the run's is "),
        "{message}"
    );
    assert!(message.contains("move it away to make a new one"), "{message}");
    assert!(!place.at("run/stage2").exists(), "nothing is trained on it");

    std::fs::write(&clusters, good.to_string()).unwrap();
    place.truncate("run/clusters/clusters.bin");
    let message = place.train("run", &[], &[]).fails(1);
    assert!(message.contains("bad cluster cache: ") && message.trim_end().ends_with("clusters.bin"), "{message}");
}

#[test]
fn a_damaged_checkpoint_is_an_error_and_never_a_silent_restart() {
    let place = Place::new();
    place.train("whole", &[], &["--only", "stage1"]).ok();
    let newest = "stage1/checkpoints/step-000000006";
    for file in ["state.json", "model.bpk", "optimizer.bpk"] {
        for missing in [false, true] {
            let run = place.at("run");
            copy_folder(&place.at("whole"), &run);
            // A stage whose last checkpoint is there and whose weights are not: it goes on from the checkpoint.
            std::fs::remove_file(run.join("stage1/model.safetensors")).unwrap();
            if missing {
                std::fs::remove_file(run.join(newest).join(file)).unwrap();
            } else {
                place.truncate(&format!("run/{newest}/{file}"));
            }
            std::fs::remove_file(run.join("config.toml")).unwrap(); // names the run it was copied from
            let before = files(&run.join("stage1"));
            let message = place.train("run", &[], &["--only", "stage1"]).fails(1);
            assert!(message.contains(&run.join(newest).join(file).display().to_string()), "{file}: {message}");
            let fix = "the newest checkpoint is damaged: move step-000000006 away to go on from step-000000004";
            assert!(message.trim_end().ends_with(fix), "{file}: {message}");
            assert!(files(&run.join("stage1")) == before, "{file}: a checkpoint was changed");
            assert_eq!(place.metrics("run"), place.metrics("whole"), "{file}: a step was made or forgotten");
            std::fs::remove_dir_all(run).unwrap();
        }
    }
}

#[test]
fn steps_that_are_not_finite_are_left_out_and_three_in_a_row_stop_the_run() {
    let place = Place::new();
    // One update of this size overflows every product after it.
    let set = ["stage1.optimizer={learning_rate=1e30, warm_up_steps=1}", "checkpoint.every=1", "stage1.steps=9"];
    let message = place.train("run", &set, &[]).fails(1);
    assert!(
        message.contains("step 2 left out: loss or gradient is not finite (scenes synthetic-0-train-"),
        "{message}"
    );
    assert!(
        message.contains("3 steps in a row were left out, up to step 4: loss or gradient is not finite"),
        "{message}"
    );
    assert!(message.contains(&place.at("run/stage1/checkpoints").display().to_string()), "{message}");
    assert!(!place.at("run/stage1/model.safetensors").exists());
    let lines = place.metrics("run");
    assert_eq!(lines.len(), 4);
    assert!(lines[0]["loss"].is_number() && lines[3]["loss"].is_null(), "{lines:?}");
}

#[test]
fn weights_of_two_trainings_are_not_evaluated_together() {
    let place = Place::new();
    place.train("a", &[], &[]).ok();
    place.train("b", &["seed=1"], &["--only", "stage1"]).ok();
    std::fs::copy(place.at("b/stage1/model.safetensors"), place.at("a/stage1/model.safetensors")).expect("copies");
    let message = place.eval("a", &[]).fails(1);
    assert!(message.contains("trained on another encoder"), "{message}");
}

#[test]
fn an_empty_cluster_cache_is_not_kept() {
    let place = Place::new();
    // Scenes of 8 frames train in the first steps and are too short once the gaps have grown.
    let views =
        "data.views={min_context=2, max_context=2, min_gap=[3, 8], max_gap=[6, 8], warm_up_steps=6, num_targets=2}";
    let message = place.train("run", &[views, "stage1.steps=6"], &[]).fails(1);
    assert!(message.contains("none could be clustered"), "{message}");
    assert!(!place.at("run/clusters").exists());
}

#[test]
fn fresh_is_refused_for_a_later_stage() {
    let place = Place::new();
    place.train("run", &[], &["--only", "stage1"]).ok();
    let message = place.train("run", &[], &["--fresh", "--only", "clusters"]).fails(2);
    assert!(message.contains("--fresh"), "{message}");
    assert!(place.at("run/stage1/model.safetensors").exists(), "nothing was moved");
}
