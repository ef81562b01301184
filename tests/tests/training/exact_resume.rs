//! A run killed at a chosen step and resumed ends with the files of an undisturbed run, bit for bit.

use crate::support::{Place, Shared, killed_at};

/// Thirty steps per stage, with a checkpoint at step 17.
const THIRTY: [&str; 4] = ["stage1.steps=30", "stage2.steps=30", "eval.every=17", "checkpoint={every=17, keep=2}"];
static UNDISTURBED: Shared = Shared::new(&THIRTY, &[]);

#[test]
fn killed_runs_end_the_same_with_any_loader_threads() {
    let place = Place::new();
    place.copy(&UNDISTURBED, "whole");
    for (name, threads) in [
        ("0", &["data.num_threads=0"][..]),
        ("1", &["data.num_threads=1"]),
        ("3", &["data.num_threads=3", "data.num_prefetch=3"]),
    ] {
        let set = [&THIRTY[..], threads].concat();
        let kill_at = |moment: &str| killed_at(moment, &place.train_args(name, &set, &[]));
        // Between the save of a step and its validation; then eight steps after the save.
        kill_at("saved/stage1/17");
        kill_at("step/stage1/25");
        assert_eq!(place.checkpoints(name, "stage1"), [17]);
        kill_at("set/4");
        let ran = place.train(name, &set, &["--only", "clusters"]).ok();
        assert!(ran.stderr.contains("clusters: resumed after 4 of 6 scenes"), "{}", ran.stderr);
        kill_at("saved/stage2/17");
        let ran = place.train(name, &set, &[]).ok();
        assert!(ran.stderr.contains("stage2: resumed after 17 of 30 steps"), "{}", ran.stderr);
        assert_eq!(place.checkpoints(name, "stage1"), [17, 30]);
        // The best validation decides which checkpoints are kept.
        assert!(place.progress(name, "stage2")["best"]["step"].is_u64());
        place.assert_same_run(name, "whole");
    }
}

#[test]
fn f16_training_resumes_with_its_loss_scale() {
    let place = Place::new();
    let set: Vec<&str> = THIRTY.iter().copied().chain(["precision=\"f16\"", "eval.precision=\"f16\""]).collect();
    place.train("whole", &set, &[]).ok();
    killed_at("step/stage1/25", &place.train_args("parts", &set, &[]));
    place.train("parts", &THIRTY, &[]).fails_with(2, &["  precision: \"f16\" -> \"f32\"\n"]);
    place.train("parts", &set, &[]).ok();
    place.assert_same_run("parts", "whole");
    let state = place.text("whole/stage2/checkpoints/step-000000030/state.json");
    let state: serde_json::Value = serde_json::from_str(&state).expect("JSON");
    assert_eq!(state["loss_scale"], serde_json::json!({"factor": 65536.0, "good_steps": 30}));

    place.copy(&UNDISTURBED, "single");
    let last_loss = |run: &str| place.metrics(run).last().expect("a step")["loss"].as_f64().expect("finite");
    let apart = (last_loss("whole") / last_loss("single") - 1.0).abs();
    assert!(apart > 0.0 && apart < 0.02, "halves round, and training goes where it went: {apart}");
    place
        .train("refused", &["precision=\"f16\""], &["--device", "ndarray"])
        .fails_with(2, &["`precision` = f16: the device has no f16"]);
}

#[test]
fn what_killed_saves_leave_is_cleared_away() {
    let place = Place::new();
    place.copy(&UNDISTURBED, "whole");
    killed_at("saved/stage1/17", &place.train_args("parts", &THIRTY, &[]));
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
        std::fs::create_dir_all(place.at(name).parent().expect("a folder")).expect("writable");
        std::fs::write(place.at(name), b"half").expect("writable");
    }
    place.train("parts", &THIRTY, &[]).ok();
    assert!(leftovers.iter().all(|name| !place.at(name).exists()));
    place.assert_same_run("parts", "whole");
}

/// A low spike factor: the loss of a random batch is often 1.1 times the median.
const SPIKES: [&str; 5] = [
    "stage1.steps=80",
    "stage1.optimizer={learning_rate=1e-3, warm_up_steps=2, spike_factor=1.1, max_bad_steps=50}",
    "stage2.steps=30",
    "eval.every=40",
    "checkpoint={every=10, keep=1}",
];

#[test]
fn spikes_are_skipped_identically_after_kills() {
    let place = Place::new();
    place.train("whole", &SPIKES, &[]).ok();
    for moment in ["step/stage1/34", "step/stage1/57", "saved/stage1/70"] {
        killed_at(moment, &place.train_args("parts", &SPIKES, &[]));
    }
    place.train("parts", &SPIKES, &[]).ok();
    place.assert_same_run("parts", "whole");

    let text = place.text("whole/bad_steps.jsonl");
    let lines: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    assert_eq!(place.progress("whole", "stage1")["num_bad_steps"], lines.len());
    let metrics = place.metrics("whole");
    for line in &lines {
        let step = line["step"].as_u64().expect("a number");
        assert!(step > 20, "twenty steps make a median: {line}");
        let loss = |value: &serde_json::Value, name: &str| value[name].as_f64().expect("finite");
        let ratio = match line["reason"].as_str() {
            Some("loss_spike") => loss(line, "loss") / loss(line, "median_loss"),
            _ => loss(line, "grad_norm") / loss(line, "median_grad_norm"),
        };
        assert!(ratio > 1.1, "{line}");
        assert_eq!(metrics[step as usize - 1]["loss"], line["loss"]);
        let scenes = line["scenes"].as_array().expect("a list");
        assert_eq!(scenes.len(), 2, "a batch of two");
        let is_clip = |scene: &serde_json::Value| {
            let is_key = scene["key"].as_str().is_some_and(|key| key.starts_with("synthetic-0-train-"));
            is_key && scene["context"].as_array().is_some_and(|frames| frames.len() == 2)
        };
        assert!(scenes.iter().all(is_clip), "{line}");
    }
    // A step is compared with the median of its own window.
    let first = lines[0]["step"].as_u64().expect("a number") as usize;
    let mut losses: Vec<f64> = metrics[..first - 1].iter().map(|line| line["loss"].as_f64().expect("finite")).collect();
    losses.sort_by(f64::total_cmp);
    assert_eq!(lines[0]["median_loss"].as_f64(), Some(losses[losses.len() / 2]));

    place.train("calm", &[&SPIKES[..1], &SPIKES[2..]].concat(), &[]).ok();
    assert!(!place.at("calm/bad_steps.jsonl").exists(), "no step is a hundred times the median");
    assert_ne!(place.weights("calm", "stage1"), place.weights("whole", "stage1"));
}

#[test]
fn consecutive_spikes_stop_the_run() {
    let place = Place::new();
    // One batch in three is a spike, so three follow each other soon.
    let spikes = "stage1.optimizer={learning_rate=1e-3, warm_up_steps=2, spike_factor=1.01, max_bad_steps=3}";
    let set = ["stage1.steps=400", "eval.every=0", "checkpoint={every=5, keep=1}", spikes];
    let message = place.train("run", &set, &["--only", "stage1"]).fails(1);
    assert!(message.contains("error: skipped 3 consecutive steps, the last at step "), "{message}");
    assert!(message.contains(" is a spike (scenes synthetic-0-train-"), "{message}");
    let step = *place.checkpoints("run", "stage1").last().expect("a checkpoint");
    let checkpoint = place.at(&format!("run/stage1/checkpoints/step-{step:09}"));
    assert!(
        message.trim_end().ends_with(&format!("the last good checkpoint is {}", checkpoint.display())),
        "{message}"
    );
    // A second try meets the same spikes and ends with the same message.
    let again = place.train("run", &set, &["--only", "stage1"]).fails(1);
    let told = |message: &str| message.lines().find(|line| line.starts_with("error: ")).map(str::to_owned);
    assert_eq!(told(&again), told(&message));
}

#[test]
fn last_best_and_every_mth_checkpoints_are_kept() {
    let place = Place::new();
    let set = ["stage1.steps=22", "eval.every=4", "checkpoint={every=2, keep=2, keep_every=8}"];
    place.train("run", &set, &["--only", "stage1"]).ok();
    let best = place.progress("run", "stage1")["best"]["step"].as_u64().expect("a step");
    let expected: std::collections::BTreeSet<u64> = [8, 16, 20, 22, best].into();
    assert!(place.checkpoints("run", "stage1").into_iter().eq(expected), "the best is {best}");
    place
        .train("other", &["checkpoint={every=2, keep_every=3}"], &[])
        .fails_with(2, &["checkpoint.keep_every", "a multiple of checkpoint.every"]);
}
