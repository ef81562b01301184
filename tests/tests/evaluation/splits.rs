//! What the figures of an evaluation were measured on: splits, held-out frames, targets that are also contexts.

use serde_json::json;

use crate::support::{Place, STAGE_1, number, repository};

/// The test scene of `data-fixtures/re10k-mini`, of eight frames.
const KEY: &str = "00000000000000b1";

/// Target frames of an evaluation.
fn target_frames(place: &Place, eval: &str) -> Vec<usize> {
    let rows = place.text(&format!("{eval}/views.csv"));
    rows.lines().skip(1).map(|row| row.split(',').nth(1).expect("a frame").parse().expect("a number")).collect()
}

#[test]
fn runs_without_test_split_are_measured_on_held_out_frames() {
    let place = Place::new();
    let root = format!("data.root={:?}", repository("data-fixtures/re10k-mini/train"));
    let ran = place.train("run", &["data.source=\"auto\"", &root, "data.hold_out=4"]).ok();
    ran.notes("1 of 4 frames (0, 4, ..) is held out of training").prints("(held-out frames of training scenes)");
    assert_eq!(place.json("run/eval/summary.json")["split"], "held_out_frames");
    assert!(target_frames(&place, "run/eval").iter().all(|frame| frame % 4 == 0));
    assert!(place.text("run/eval/report.html").contains("held-out frames of training scenes"));

    let warning = "warning: measured on training scenes";
    place.eval("run --split train").ok().prints("(training scenes)").prints(warning).notes(warning);
    assert_eq!(place.json("run/eval-train/summary.json")["split"], "train");
    assert!(target_frames(&place, "run/eval-train").iter().all(|frame| frame % 4 != 0));
    // An index with a training frame as a target, and data that the run was not trained on.
    place.write("index.json", json!({"00000000000000a1": {"context": [0, 7], "target": [3]}}).to_string());
    place.eval("run --index DIR/index.json --out DIR/index").ok().prints(warning);
    place
        .eval("run --data REPO/data-fixtures/re10k-mini/test --out DIR/other")
        .ok()
        .prints("(data set without splits)");
    place.eval("run --data REPO/data-fixtures/re10k-mini --out DIR/test").ok().prints("(test split)");
    // What was held out is a matter of training: the evaluation does not change it.
    place.eval("run --set data.hold_out=3 --out DIR/same").ok();
    assert_eq!(target_frames(&place, "same"), target_frames(&place, "run/eval"));

    place.train("other", &["data.hold_out=1"]).fails_with(2, &["`data.hold_out` = 1: no frame would be left"]);
}

#[test]
fn targets_that_are_contexts_are_counted_and_dropped() {
    let place = Place::with(&STAGE_1);
    place.write("index.json", json!({KEY: {"context": [0, 7], "target": [0, 3]}}).to_string());
    let eval = "run --data REPO/data-fixtures/re10k-mini --index DIR/index.json --out DIR/";
    let warning = "warning: 1 target is also a context: nearest_view copies";
    let ran = place.eval(&format!("{eval}given")).ok().notes(warning).prints(warning);
    ran.prints(" 1 of 2 views identical to the target");
    place.eval(&format!("{eval}dropped --drop-context-targets")).ok();
    let [given, dropped] = ["given", "dropped"].map(|name| place.json(&format!("{name}/summary.json")));
    assert_eq!((&given["num_context_targets"], &dropped["num_context_targets"]), (&1.into(), &0.into()));
    let [given, dropped] = [given, dropped].map(|summary| summary["baselines"]["nearest_view"].clone());
    assert_eq!((&given["num_identical_views"], &dropped["num_identical_views"]), (&1.into(), &0.into()));
    assert!(number(&given, "psnr") > 50.0 && number(&dropped, "psnr") < 40.0, "{given} {dropped}");
    assert_eq!(target_frames(&place, "dropped"), [3; 6], "four points and two baselines");
    assert!(place.text("given/report.html").contains("1 target is also a context"));
}
