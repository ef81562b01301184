//! Runs on wrong, damaged or missing data, checkpoints and weights.

use std::path::{Path, PathBuf};

use clift_data::{ChunkSource, ImageEncoding, SceneFilters, SceneRecord, SceneSource, Split, read_scene, write_chunks};

use crate::support::{Place, Ran, STAGE_1, WHOLE, copy_folder, files, list, number, repository};

/// Images of two training scenes and a test scene, written by PyTorch's `torch.save`.
const MINI: &str = "data-fixtures/re10k-mini";
const KEYS: [&str; 2] = ["00000000000000a1", "00000000000000a2"];

/// Trains the micro run `run`, which flags may follow, on a folder of chunks.
fn train_on(place: &Place, words: &str, data: &Path, set: &[&str]) -> Ran {
    let root = format!("data.root=\"{}\"", data.display());
    let chunks = ["data.source=chunks", root.as_str(), "data.width=32", "data.height=32"];
    place.train(words, &[&chunks[..], set].concat())
}

fn train_on_mini(place: &Place, set: &[&str]) -> Ran {
    train_on(place, "run", &repository(MINI), set)
}

/// Key that names the evaluation index of the folder, and the index with this text.
fn index(place: &Place, text: &str) -> String {
    place.write("index.json", text);
    format!("eval.index=\"{}\"", place.at("index.json").display())
}

/// Copies the mini data set, with its two training scenes in a chunk each.
fn two_chunks(place: &Place) -> PathBuf {
    let data = place.at("data");
    copy_folder(&repository(MINI), &data);
    std::fs::copy(data.join("train/000000.torch"), data.join("train/000001.torch")).unwrap();
    let index = serde_json::json!({KEYS[0]: "000000.torch", KEYS[1]: "000001.torch"});
    place.write("data/train/index.json", index.to_string());
    data
}

/// Copies the mini data set with one training scene changed.
fn changed_scene(place: &Place, change: impl Fn(&mut SceneRecord)) -> PathBuf {
    let data = place.at("data");
    copy_folder(&repository(MINI).join("test"), &data.join("test"));
    let source = ChunkSource::open(&repository(MINI), Split::Train, &SceneFilters::default()).unwrap();
    let scenes = (0..source.num_scenes()).map(|scene| {
        let (mut record, _) = read_scene(&source, scene, ImageEncoding::Png, None)?;
        if record.key == KEYS[1] {
            change(&mut record);
        }
        Ok(record)
    });
    write_chunks(&data.join("train"), scenes, u64::MAX).unwrap();
    data
}

/// The mini data set with the camera centres of one training scene changed.
fn moved_cameras(place: &Place, change: impl Fn(&mut clift_core::DVec3)) -> PathBuf {
    changed_scene(place, |scene| scene.cameras.iter_mut().for_each(|camera| change(&mut camera.c2w.translation)))
}

/// Expects a run that skipped the second scene for `reason`, reported it, and trained on the first.
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
    let keys: Vec<_> = list(&clusters["entries"]).iter().map(|entry| &entry["key"]).collect();
    assert_eq!(keys, [KEYS[0]]);
    assert_eq!(clusters["skipped"]["skips"][0]["key"], KEYS[1], "the skipped scene is saved");
    assert_eq!(place.json("run/eval/summary.json")["num_scenes"], 1);
}

#[test]
fn what_the_data_refutes_is_refused_before_any_step() {
    let place = Place::new();
    let expected = "`eval.stored_tokens` = 9: write at most 8, the fewest tokens of an evaluated scene";
    place.train("run", &["eval.stored_tokens=[9]"]).fails_with(2, &[expected]);
    assert!(!place.at("run/metrics.jsonl").exists());
    let nowhere = place.at("nowhere");
    train_on(&place, "run", &nowhere, &[]).fails_naming(1, &[], &nowhere.display().to_string());
    // The corrected command is accepted: the refused one started no run.
    train_on(&place, "run --only stage1", &repository(MINI), &[]).ok();
}

#[test]
fn evaluated_scenes_that_train_are_named() {
    let place = Place::new();
    let data = changed_scene(&place, |_| ());
    std::fs::remove_dir_all(data.join("test")).unwrap();
    copy_folder(&data.join("train"), &data.join("test"));
    let warning = format!("the evaluation shares 2 scenes with training, such as {}", KEYS[0]);
    train_on(&place, "run --only stage1", &data, &[]).ok().notes(&warning);
    train_on(&place, "run", &data, &[]).ok();
    place.eval("run").ok().notes(&warning).prints(&format!("warning: {warning}"));
    assert!(place.text("run/eval/report.html").contains(&format!("Warning: {warning}")));
    let ran = train_on(&place, "other --only stage1", &repository(MINI), &[]).ok();
    assert!(!ran.stderr.contains("with training"), "{}", ran.stderr);
}

#[cfg(not(feature = "wgpu"))]
#[test]
fn missing_devices_are_refused_with_the_build_command() {
    let place = Place::new();
    place.train("run --device wgpu", &[]).fails_with(2, &["cargo build --release --features wgpu", "`--device flex`"]);
    assert!(!place.at("run").exists());
}

#[test]
fn chunks_train_and_null_index_entries_are_unused() {
    let place = Place::new();
    let index = format!("eval.index={:?}", repository(MINI).join("evaluation_index.json"));
    let ran = train_on_mini(&place, &[&index]).ok();
    assert!(!ran.stderr.contains("skipped"), "{}", ran.stderr);
    ran.notes("evaluation: 1 of 3 scenes used; 2 without views in the evaluation index");
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
    let train = |text: &str| train_on_mini(&place, &[&index(&place, text)]);
    let message = "no usable scene: evaluation: 0 of 1 scenes used; 1 not in the data";
    train(r#"{"ffff": {"context": [0, 2], "target": [1]}}"#).fails_with(1, &[message]);
    assert!(!place.at("run/metrics.jsonl").exists());
    let absent = "frame 9 of scene 00000000000000b1 does not exist";
    for (text, expected) in [
        (r#"{"00000000000000b1": {"context": [0, 9], "target": [1]}}"#, absent),
        (r#"{"00000000000000b1": {"context": [0, 2]}}"#, "has 2 context and 0 target frames"),
        ("[]", "bad index: expected {key: "),
    ] {
        train(text).fails_naming(1, &[expected], "index.json");
    }
}

#[test]
fn targets_that_are_contexts_are_measured() {
    let place = Place::new();
    let index = index(&place, r#"{"00000000000000b1": {"context": [0, 7], "target": [0, 7]}}"#);
    // Between neighbouring contexts no other frame is left for targets.
    let views = "data.views={min_context=2, max_context=2, min_gap=[1, 1], max_gap=[1, 1], num_targets=3}";
    let stderr = train_on_mini(&place, &[&index, views]).ok().stderr;
    assert!(!stderr.contains("skipped"), "{stderr}");
    let summary = place.json("run/eval/summary.json");
    // The nearest view is the target itself: an infinite PSNR counts as 100 dB.
    assert_eq!(summary["baselines"]["nearest_view"]["psnr"], 100.0);
    assert!(number(&summary["points"][0], "psnr") < 40.0, "{summary}");
}

#[test]
fn unusable_scenes_are_skipped_and_named() {
    /// Makes a data set whose second scene is unusable.
    type Damage = fn(&Place) -> PathBuf;
    let cases: [(&str, Damage); 5] = [
        ("data/train/000001.torch", |place| {
            let data = two_chunks(place);
            place.truncate("data/train/000001.torch");
            data
        }),
        ("which is not on the allow-list; no code was run", |place| {
            let data = two_chunks(place);
            let hostile = repository("data-fixtures/hostile/calls_system.torch");
            std::fs::copy(hostile, data.join("train/000001.torch")).unwrap();
            data
        }),
        ("of scene 00000000000000a2 cannot be decoded: the JPEG data of ", |place| {
            changed_scene(place, |scene| scene.images.iter_mut().for_each(|image| image.truncate(image.len() / 2)))
        }),
        ("bad camera: ", |place| moved_cameras(place, |centre| centre[1] = f64::NAN)),
        ("scene 00000000000000a2 has no baseline: its 2 camera centres lie within ", |place| {
            moved_cameras(place, |centre| *centre = [1.0, 2.0, 3.0].into())
        }),
    ];
    for (reason, damage) in cases {
        let place = Place::new();
        let data = damage(&place);
        assert_second_is_skipped(&place, train_on(&place, "run", &data, &[]), reason);
    }
}

#[test]
fn without_any_usable_scene_the_run_ends() {
    let place = Place::new();
    let data = two_chunks(&place);
    for chunk in ["000000.torch", "000001.torch"] {
        place.truncate(&format!("data/train/{chunk}"));
    }
    let expected = "error: no usable scene for slot 0 of step 0 in 16 tries; the last, ";
    let message = train_on(&place, "run", &data, &[]).fails_with(1, &[expected, "bad chunk: "]);
    assert!(message.trim_end().ends_with("000000.torch") || message.trim_end().ends_with("000001.torch"), "{message}");
}

#[test]
fn too_short_scenes_are_skipped_at_the_start() {
    let place = Place::new();
    let data = changed_scene(&place, |scene| {
        scene.images.truncate(3);
        scene.cameras.truncate(3);
        scene.timestamps.truncate(3);
    });
    let ran = train_on(&place, "run --only stage1", &data, &[]).ok();
    let ran = ran.notes("train: 1 of 2 scenes used; 1 shorter than the 4 frames that data.views.min_gap needs");
    assert!(!ran.stderr.contains("skipped "), "{}", ran.stderr);
    assert_eq!(place.json("run/skipped-train.json")["skips"][0]["key"], KEYS[1]);
}

#[test]
fn too_small_images_are_refused_with_the_fix() {
    let place = Place::new();
    train_on_mini(&place, &["data.height=64"])
        .fails_with(1, &["cannot make a 32x64 image from a 64x36 image", "lower the configured size"]);
}

#[test]
fn truncated_weights_and_stale_caches_are_refused() {
    let place = Place::with(&WHOLE);
    place.truncate("run/stage2/model.safetensors");
    let file = "run/stage2/model.safetensors";
    place.eval("run").fails_naming(1, &["reading the weights failed: "], file);
    std::fs::remove_dir_all(place.at("run/stage2")).unwrap();
    let good = place.text("run/clusters/index.json");
    let mut stale = place.json("run/clusters/index.json");
    stale["encoder"] = "0123456789abcdef".into();
    place.write("run/clusters/index.json", stale.to_string());
    let what = "stale cluster cache: its tokens are of encoder 0123456789ab, the run's is ";
    place.train("run", &[]).fails_with(1, &[what, "remove the cache to build a new one"]);
    assert!(!place.at("run/stage2").exists(), "nothing is trained on it");

    place.write("run/clusters/index.json", &good);
    place.truncate("run/clusters/clusters.bin");
    place.train("run", &[]).fails_naming(1, &["bad cluster cache: "], "clusters.bin");
}

#[test]
fn damaged_checkpoints_are_errors_and_change_nothing() {
    let place = Place::new();
    place.copy(&STAGE_1, "whole");
    let newest = "stage1/checkpoints/step-000000006";
    for file in ["state.json", "model.bpk", "optimizer.bpk"] {
        for missing in [false, true] {
            let run = place.at("run");
            place.copy(&STAGE_1, "run");
            // Without its weights the stage resumes from the last checkpoint.
            std::fs::remove_file(run.join("stage1/model.safetensors")).unwrap();
            if missing {
                std::fs::remove_file(run.join(newest).join(file)).unwrap();
            } else {
                place.truncate(&format!("run/{newest}/{file}"));
            }
            let before = files(&run.join("stage1"));
            let damaged = run.join(newest).join(file).display().to_string();
            let fix =
                "the newest checkpoint is damaged: move step-000000006 to another folder to resume from step-000000004";
            place.train("run --only stage1", &[]).fails_naming(1, &[&damaged], fix);
            assert!(files(&run.join("stage1")) == before, "{file}: a checkpoint was changed");
            assert_eq!(place.metrics("run"), place.metrics("whole"), "{file}: a step was made or forgotten");
            std::fs::remove_dir_all(run).unwrap();
        }
    }
}

#[test]
fn three_steps_without_finite_loss_stop_the_run() {
    let place = Place::new();
    // One update of this size overflows every product after it.
    let set = ["stage1.optimizer={learning_rate=1e30, warm_up_steps=1}", "checkpoint.every=1", "stage1.steps=9"];
    let skipped = "skipped step 2: loss or gradient is not finite (scenes synthetic-0-train-";
    let stopped = "skipped 3 consecutive steps, the last at step 4: loss or gradient is not finite";
    let saved = place.at("run/stage1/checkpoints").display().to_string();
    place.train("run", &set).fails_with(1, &[skipped, stopped, &saved]);
    assert!(!place.at("run/stage1/model.safetensors").exists());
    let lines = place.metrics("run");
    assert_eq!(lines.len(), 4);
    assert!(lines[0]["loss"].is_number() && lines[3]["loss"].is_null(), "{lines:?}");
}

#[test]
fn weights_of_two_trainings_are_not_evaluated_together() {
    let place = Place::new();
    place.copy(&WHOLE, "a");
    place.train("b --only stage1", &["seed=1"]).ok();
    std::fs::copy(place.at("b/stage1/model.safetensors"), place.at("a/stage1/model.safetensors")).expect("copies");
    place.eval("a").fails_with(1, &["trained on another encoder"]);
}

#[test]
fn scenes_that_become_too_short_are_refused_before_training() {
    let place = Place::new();
    // Scenes of 8 frames would train in the first steps, until the gaps have grown.
    let views =
        "data.views={min_context=2, max_context=2, min_gap=[3, 8], max_gap=[6, 8], warm_up_steps=6, num_targets=2}";
    let expected = "0 of 8 scenes used; 8 shorter than the 9 frames that data.views.min_gap needs";
    place.train("run", &[views, "stage1.steps=6"]).fails_with(1, &[expected]);
    assert!(!place.at("run/stage1").exists());
}

#[test]
fn outputs_replace_neither_inputs_nor_other_files() {
    let place = Place::with(&WHOLE);
    place.write("mine.json", "mine");
    std::fs::copy(repository("tests/micro.toml"), place.at("micro.toml")).unwrap();
    place.clift("data synth DIR/rooms --scenes 1 --frames 9 --size 16x16 --split test").ok();
    place.clift("data convert DIR/rooms DIR/scenes --to scenes").ok();
    copy_folder(&repository("data-fixtures/layouts/capture/attic"), &place.at("0048"));
    place.write("0048/images/0048.png", "a photo");
    let before = files(&place.at(""));
    let images = "data check DIR/0048 --images DIR/0048/images --force";
    place.clift(images).fails_with(2, &["0048.png exists and belongs to the input "]);
    for (command, input) in [
        ("plan DIR/micro.toml --json", "micro.toml"),
        ("flops DIR/micro.toml --json", "micro.toml"),
        ("flops DIR/micro.toml --set stage1.init_from=DIR/run --json", "run/stage1/model.safetensors"),
        ("plan DIR/run/config.toml --json", "run/run.json"),
        ("bench DIR/micro.toml --json", "micro.toml"),
        ("bench precision DIR/micro.toml --json", "micro.toml"),
        ("compare DIR/run DIR/run/eval --json", "run/eval/views.csv"),
        ("bench data DIR/rooms --json", "rooms/test/index.json"),
        ("data info DIR/rooms/evaluation_index.json --json", "rooms/evaluation_index.json"),
        ("data check DIR/scenes --json", "scenes/test/synthetic-0-test-00000.torch"),
        ("data index DIR/rooms -o", "rooms/test/000000.torch"),
        ("metrics DIR/run --csv", "run/metrics.jsonl"),
        ("encode DIR/run --scene synthetic-0-test-00000 -o DIR/new.clift --save-clusters", "run/run.json"),
    ] {
        place.clift(&format!("{command} DIR/mine.json")).fails_with(2, &["mine.json exists; replace it with --force"]);
        place
            .clift(&format!("{command} DIR/{input} --force"))
            .fails_with(2, &[input, " exists and belongs to the input "]);
    }
    let one_file =
        "encode DIR/run --scene synthetic-0-test-00000 -o DIR/new.clift --save-clusters DIR/run/../new.clift";
    place.clift(one_file).fails_with(2, &["--save-clusters and -o name one file"]);
    assert!(files(&place.at("")) == before, "a file changed");
}
