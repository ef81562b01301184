//! Runs on wrong, damaged or missing data, checkpoints and weights.

use std::path::{Path, PathBuf};

use crate::support::{Place, Ran, STAGE_1, WHOLE, copy_folder, files, list, repository};

/// Images of two training scenes and a test scene, written by PyTorch's `torch.save`.
const MINI: &str = "data-fixtures/re10k-mini";
const KEYS: [&str; 2] = ["00000000000000a1", "00000000000000a2"];

/// Trains the micro run `run`, which flags may follow, on a folder of chunks.
fn train_on(place: &Place, words: &str, data: &Path, set: &[&str]) -> Ran {
    let root = format!("data.root=\"{}\"", data.display());
    let chunks = ["data.source=chunks", root.as_str(), "data.width=32", "data.height=32"];
    place.train(words, &[&chunks[..], set].concat())
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
    let data = two_chunks(&place);
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

#[test]
fn an_index_of_other_scenes_fails_before_training() {
    let place = Place::new();
    let train = |text: &str| {
        place.write("index.json", text);
        let index = format!("eval.index=\"{}\"", place.at("index.json").display());
        train_on(&place, "run", &repository(MINI), &[&index])
    };
    let message = "no usable scene: evaluation: 0 of 1 scene used; 1 not in the data";
    train(r#"{"ffff": {"context": [0, 2], "target": [1]}}"#).fails_with(1, &[message]);
    assert!(!place.at("run/metrics.jsonl").exists());
    let absent = r#"{"00000000000000b1": {"context": [0, 9], "target": [1]}}"#;
    train(absent).fails_naming(1, &["frame 9 of scene 00000000000000b1 does not exist"], "index.json");
}

#[test]
fn unusable_scenes_are_skipped_and_named() {
    let hostile = "which is not on the allow-list; no code was run";
    for (reason, is_hostile) in [("data/train/000001.torch", false), (hostile, true)] {
        let place = Place::new();
        let data = two_chunks(&place);
        if is_hostile {
            let hostile = repository("data-fixtures/hostile/calls_system.torch");
            std::fs::copy(hostile, data.join("train/000001.torch")).unwrap();
        } else {
            place.truncate("data/train/000001.torch");
        }
        let stderr = train_on(&place, "run", &data, &[]).ok().stderr;
        let lines: Vec<_> = stderr.lines().filter(|line| line.starts_with("skipped ")).collect();
        assert!(!lines.is_empty(), "{stderr}");
        let saved = place.text("run/skipped.jsonl");
        assert_eq!(saved.lines().count(), 1, "once for all draws: {saved}");
        assert!(saved.contains(KEYS[1]) && saved.contains("\"reason\":"), "{saved}");
        for line in lines {
            assert!(line.starts_with(&format!("skipped {}: ", KEYS[1])) && line.contains(reason), "{line}");
        }
        // The run trained on the first scene.
        assert_eq!(place.metrics("run").len(), 6 + 4, "every step is made");
        let clusters = place.json("run/clusters/index.json");
        let keys: Vec<_> = list(&clusters["entries"]).iter().map(|entry| &entry["key"]).collect();
        assert_eq!(keys, [KEYS[0]]);
        assert_eq!(clusters["skipped"]["skips"][0]["key"], KEYS[1], "the skipped scene is saved");
        assert_eq!(place.json("run/eval/summary.json")["num_scenes"], 1);
    }
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
fn outputs_replace_neither_inputs_nor_other_files() {
    let place = Place::with(&WHOLE);
    place.write("mine.json", "mine");
    std::fs::copy(repository("tests/micro.toml"), place.at("micro.toml")).unwrap();
    place.clift("data synth DIR/rooms --scenes 1 --frames 9 --size 16x16 --split test").ok();
    let before = files(&place.at(""));
    for (command, input) in [
        ("plan DIR/micro.toml --json", "micro.toml"),
        ("flops DIR/micro.toml --json", "micro.toml"),
        ("flops DIR/micro.toml --set stage1.init_from=DIR/run --json", "run/stage1/model.safetensors"),
        ("plan DIR/run/config.toml --json", "run/run.json"),
        ("bench DIR/micro.toml --json", "micro.toml"),
        ("compare DIR/run DIR/run/eval --json", "run/eval/views.csv"),
        ("data info DIR/rooms --json", "rooms/evaluation_index.json"),
        ("data check DIR/rooms --json", "rooms/test/000000.torch"),
        ("data index DIR/rooms -o", "rooms/test/000000.torch"),
        ("metrics DIR/run --csv", "run/metrics.jsonl"),
    ] {
        place.clift(&format!("{command} DIR/mine.json")).fails_with(2, &["mine.json exists; replace it with --force"]);
        place
            .clift(&format!("{command} DIR/{input} --force"))
            .fails_with(2, &[input, " exists and belongs to the input "]);
    }
    assert!(files(&place.at("")) == before, "a file changed");
}
