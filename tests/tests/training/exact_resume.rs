//! A run killed at a chosen step and resumed ends with the files of an undisturbed run, bit for bit.

use clift_model::InstructionSet;
use serde_json::{Value, json};

use crate::support::{Place, Shared, list, number};

/// Thirty steps per stage, with a checkpoint at step 17.
const THIRTY: [&str; 4] = ["stage1.steps=30", "stage2.steps=30", "eval.every=17", "checkpoint={every=17, keep=2}"];
static UNDISTURBED: Shared = Shared::new("run", &THIRTY);

#[test]
fn killed_runs_end_the_same_with_any_loader_threads() {
    let place = Place::new();
    place.copy(&UNDISTURBED, "whole");
    // The undisturbed run has one thread.
    for (name, threads) in [("0", &["data.num_threads=0"][..]), ("3", &["data.num_threads=3", "data.num_prefetch=3"])] {
        let set = [&THIRTY[..], threads].concat();
        let kill_at = |moment: &str| place.kill_at(moment, name, &set);
        // Between the save of a step and its validation; then eight steps after the save.
        kill_at("saved/stage1/17");
        kill_at("step/stage1/25");
        assert_eq!(place.checkpoints(name, "stage1"), [17]);
        kill_at("set/4");
        place.train(&format!("{name} --only clusters"), &set).ok().notes("clusters: resumed after 4 of 6 context sets");
        kill_at("saved/stage2/17");
        let ran =
            place.train(&format!("{name} --only stage2"), &set).ok().notes("stage2: resumed after 17 of 30 steps");
        assert!(ran.stdout.is_empty(), "a part has no evaluation to print: {}", ran.stdout);
        place.eval(name).ok();
        assert_eq!(place.checkpoints(name, "stage1"), [17, 30]);
        assert_eq!(place.progress(name, "stage2")["validated"], 30, "the checkpoint knows its validation");
        place.assert_same_run(name, "whole");
    }
}

/// Compares a run of a precision with one that was killed; returns its loss scale and the relative distance of its last loss
/// from that of f32.
fn resume_in(place: &Place, precision: &str) -> (Value, f64) {
    let keys = ["precision", "eval.precision"].map(|key| format!("{key}={precision:?}"));
    let set: Vec<&str> = THIRTY.iter().copied().chain(keys.iter().map(String::as_str)).collect();
    place.train("whole", &set).ok();
    place.kill_at("step/stage1/25", "parts", &set);
    let changed = format!("  precision: {precision:?} -> \"f32\"\n");
    place.train("parts", &THIRTY).fails_with(2, &[&changed]);
    place.train("parts", &set).ok();
    place.assert_same_run("parts", "whole");
    place.copy(&UNDISTURBED, "single");
    let state = place.json("whole/stage2/checkpoints/step-000000030/state.json");
    (state["loss_scale"].clone(), (last_loss(place, "whole") / last_loss(place, "single") - 1.0).abs())
}

fn last_loss(place: &Place, run: &str) -> f64 {
    number(place.metrics(run).last().expect("a step"), "loss")
}

#[test]
fn f16_training_resumes_with_its_loss_scale() {
    let place = Place::new();
    let (loss_scale, apart) = resume_in(&place, "f16");
    assert_eq!(loss_scale, json!({"factor": 65536.0, "good_steps": 30}));
    assert!(apart > 0.0 && apart < 0.02, "halves round, and training goes where it went: {apart}");
    place
        .train("refused --device ndarray", &["precision=\"f16\""])
        .fails_with(2, &["`precision` = f16: the device has no f16"]);
}

#[test]
fn bf16_training_resumes_exactly_or_is_refused_before_work() {
    let place = Place::new();
    if !InstructionSet::detected().has_bf16() {
        let expected = "`precision` = bf16: the kernels have no bf16 instructions";
        place.train("whole", &["precision=\"bf16\""]).fails_with(2, &[expected]);
        return;
    }
    let (loss_scale, apart) = resume_in(&place, "bf16");
    assert!(loss_scale.is_null(), "the range of f32 needs no loss scaling");
    assert!(apart > 0.0 && apart < 0.05, "operands round, and training goes where it went: {apart}");
}

#[test]
fn runs_with_camera_relative_attention_and_muon_resume_exactly() {
    let place = Place::new();
    let muon = "optimizer={algorithm=\"muon\", learning_rate=1e-3, warm_up_steps=2}";
    let [stage1, stage2] = ["stage1", "stage2"].map(|stage| format!("{stage}.{muon}"));
    let set = [&THIRTY[..], &["model.camera_encoding=\"gta\"", &stage1, &stage2]].concat();
    place.train("whole", &set).ok();
    place.kill_at("step/stage1/25", "parts", &set);
    place.kill_at("saved/stage2/17", "parts", &set);
    place.train("parts", &set).ok();
    place.assert_same_run("parts", "whole");
}

#[test]
fn what_killed_saves_leave_is_cleared_away() {
    let place = Place::new();
    place.copy(&UNDISTURBED, "whole");
    place.kill_at("saved/stage1/17", "parts", &THIRTY);
    let leftovers = [
        "parts/.clift-x",
        "parts/stage1/.clift-y",
        "parts/stage1/.clift-z/.tmpAb12Cd",
        "parts/stage1/checkpoints/step-000000034.tmp/model.bpk",
        "parts/stage2/checkpoints/step-000000002.tmp/model.bpk",
        // Without the inputs of the build in its first line.
        "parts/clusters.tmp/clusters.bin",
    ];
    for name in leftovers {
        place.write(name, "half");
    }
    place.train("parts", &THIRTY).ok();
    assert!(leftovers.iter().all(|name| !place.at(name).exists()));
    place.assert_same_run("parts", "whole");
}

/// A low spike factor: the loss of a random batch is often 1.1 times the median.
const SPIKES: [&str; 5] = [
    "stage1.steps=80",
    "stage1.optimizer={learning_rate=1e-3, warm_up_steps=2, spike_factor=1.1, max_bad_steps=50}",
    "stage2.steps=4",
    "eval.every=40",
    "checkpoint={every=10, keep=1}",
];

#[test]
fn spikes_are_skipped_identically_after_kills() {
    let place = Place::new();
    place.train("whole", &SPIKES).ok();
    for moment in ["step/stage1/34", "step/stage1/57", "saved/stage1/70"] {
        place.kill_at(moment, "parts", &SPIKES);
    }
    place.train("parts", &SPIKES).ok();
    place.assert_same_run("parts", "whole");
    let lines = place.json_lines("whole/bad_steps.jsonl");
    assert_eq!(place.progress("whole", "stage1")["num_bad_steps"], lines.len());
    for line in &lines {
        assert!(number(line, "step") > 20.0, "twenty steps make a median: {line}");
        let ratio = match line["reason"].as_str() {
            Some("loss_spike") => number(line, "loss") / number(line, "median_loss"),
            _ => number(line, "grad_norm") / number(line, "median_grad_norm"),
        };
        assert!(ratio > 1.1 && list(&line["scenes"]).len() == 2, "{line}");
    }
    place.train("calm --only stage1", &[&SPIKES[..1], &SPIKES[2..]].concat()).ok();
    assert!(!place.at("calm/bad_steps.jsonl").exists(), "no step is a hundred times the median");
    assert_ne!(place.weights("calm", "stage1"), place.weights("whole", "stage1"));
}
