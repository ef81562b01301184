//! `--extend`: more steps than at the start of the run.

use std::process::Command;

use crate::support::{BINARY, Place, WHOLE, files, finish, number, start};

#[test]
fn extended_stages_follow_the_longer_schedule() {
    let place = Place::with(&WHOLE);
    let former = place.bytes("run/stage2/model.safetensors");
    let before = files(&place.at("run"));
    let more = ["stage2.steps=8"];
    place.train("run", &more).fails_with(2, &["  stage2.steps: 4 -> 8\n", "continue with --extend"]);
    assert!(files(&place.at("run")) == before, "a refusal changes nothing");
    place.train("run --extend", &more).ok().notes("stage2: resumed after 4 of 8 steps");
    assert_eq!(place.bytes("run/stage2/model-4-steps.safetensors"), former);
    assert_ne!(place.bytes("run/stage2/model.safetensors"), former);
    let expected = serde_json::json!([{"stage": "stage2", "from": 4, "to": 8, "at_step": 4}]);
    assert_eq!(place.json("run/run.json")["extended"], expected);

    // From step 5 on the rates are those of a run of eight steps; up to it they were those of one of four.
    place.train("eight", &more).ok();
    let rate = |run: &str, step: usize| number(&place.metrics(run)[6 + step - 1], "lr");
    assert_eq!(place.metrics("run").len(), 14);
    assert!((5..=8).all(|step| rate("run", step) == rate("eight", step)));
    assert!(rate("run", 3) < rate("eight", 3) && rate("run", 5) > rate("run", 4));

    // The run now has this count: the flag is not needed, and run.json keeps the record.
    place.train("run", &more).ok();
    assert_eq!(place.json("run/run.json")["extended"], expected);
    // Counts do not shrink.
    let message = place.train("run --extend", &[]).fails_with(2, &["settings:\n  stage2.steps: 8 -> 4\nresume"]);
    assert!(!message.contains("continue with --extend"), "{message}");
}

/// A limit on file sizes stops a write as a full disk does, without the right to mount one.
#[test]
fn a_full_disk_leaves_the_weights_where_they_are() {
    let place = Place::with(&WHOLE);
    let before = files(&place.at("run"));
    let mut command = Command::new("sh");
    command.args(["-c", "trap '' XFSZ; ulimit -f 0; exec \"$@\"", "sh", BINARY]);
    let args = place.train_args("run --extend", &["stage2.steps=8"]);
    finish(start(command.args(args))).fails_with(1, &["File too large"]);
    assert!(files(&place.at("run")) == before, "a file changed");
}

#[test]
fn an_extended_stage_resumes_exactly() {
    let place = Place::new();
    let (six, twelve) = (["checkpoint.every=3"], ["checkpoint.every=3", "stage1.steps=12"]);
    for name in ["whole", "parts"] {
        place.train(&format!("{name} --only stage1"), &six).ok();
    }
    place.train("whole --only stage1 --extend", &twelve).ok();
    // Killed after the weights were renamed and before the new count was written: the extension has no effect.
    let weights = place.at("parts/stage1/model.safetensors");
    std::fs::rename(&weights, place.at("parts/stage1/model-6-steps.safetensors")).expect("renames");
    place.train("parts --only stage1", &six).ok();
    assert!(weights.exists(), "written again from the last checkpoint");
    std::fs::remove_file(place.at("parts/stage1/model-6-steps.safetensors")).expect("removes");
    place.train("parts --only stage1 --extend", &twelve).ok();
    assert_eq!(place.bytes("parts/stage1/model.safetensors"), place.bytes("whole/stage1/model.safetensors"));

    // Before its end a stage is extended too, from the checkpoint it has.
    place.kill_at("saved/stage1/3", "early", &six);
    place.train("early --only stage1 --extend", &twelve).ok();
    assert_eq!(place.json("early/run.json")["extended"][0]["at_step"], 3);
    assert_ne!(place.bytes("early/stage1/model.safetensors"), place.bytes("whole/stage1/model.safetensors"));
}

#[test]
fn what_cannot_go_on_is_refused() {
    let place = Place::with(&WHOLE);
    let before = files(&place.at("run"));
    let refused = |set: &[&str], expected: &str| place.train("run --extend", set).fails_with(2, &[expected]);
    refused(&["stage1.steps=9"], "clusters/ depends on the present encoder of stage 1");
    refused(&["stage2.steps=9", "seed=1"], "settings:\n  seed: 0 -> 1\nresume");
    assert!(files(&place.at("run")) == before, "a refusal changes nothing");
    std::fs::remove_dir_all(place.at("run/stage2/checkpoints")).expect("removes");
    refused(&["stage2.steps=9"], "the stage has no checkpoint to resume from in stage2/checkpoints");
    assert!(place.at("run/stage2/model.safetensors").exists());
}
