//! Runs that stop and go on: the result is that of a run that never stopped.

use std::time::{Duration, Instant};

use crate::support::{Place, Ran, clift, files, finish, signal as send, spawn, wait_for_steps};

/// Starts a run, sends it a signal after some steps and waits for its end.
fn stop_after(place: &Place, name: &str, set: &[&str], flags: &[&str], count: usize, signal: &str) -> Ran {
    let mut child = spawn(place.train_args(name, set, flags));
    wait_for_steps(&place.at(name), &mut child, count);
    send(&child, signal);
    finish(child)
}

/// Enough steps that a run is still going when the signal comes: a step takes milliseconds.
const LONG: [&str; 4] = ["stage1.steps=120", "stage2.steps=120", "eval.every=50", "checkpoint.every=25"];

#[test]
fn an_interrupted_run_saves_exits_130_and_ends_as_if_it_had_not_been() {
    let place = Place::new();
    place.train("whole", &LONG, &[]).ok();

    let message = stop_after(&place, "parts", &LONG, &[], 10, "-INT").fails(130);
    let step = place.metrics("parts").len();
    assert!((10..120).contains(&step), "{step}");
    assert!(message.contains(&format!("error: interrupted at step {step}; the same command resumes")), "{message}");
    assert!(message.contains(&format!("saved {}", place.at("parts/stage1/checkpoints").display())), "{message}");
    assert!(place.at(&format!("parts/stage1/checkpoints/step-{step:09}")).is_dir());
    assert!(!place.at("parts/stage1/model.safetensors").exists());

    // Again, in the middle of stage 2.
    let ran = stop_after(&place, "parts", &LONG, &[], 130, "-INT");
    assert!(ran.stderr.contains(&format!("stage1: resumed after {step} of 120 steps")), "{}", ran.stderr);
    ran.fails(130);
    let message = place.train("parts", &LONG, &[]).ok().stderr;
    assert!(message.contains("stage2: resumed after"), "{message}");

    assert_eq!(place.metrics_but_time("parts"), place.metrics_but_time("whole"));
    place.assert_same_result("parts", "whole");
}

#[test]
fn a_killed_run_goes_on_from_its_last_checkpoint_to_the_same_weights() {
    let place = Place::new();
    let only = ["--only", "stage1"];
    place.train("whole", &LONG, &only).ok();
    // Past the checkpoint of step 25, with steps after it that are lost.
    assert_eq!(stop_after(&place, "parts", &LONG, &only, 35, "-KILL").code, None);
    let done = place.metrics("parts").len();
    let stderr = place.train("parts", &LONG, &only).ok().stderr;
    let resumed = format!("stage1: resumed after {} of 120 steps", done / 25 * 25);
    // A save that was not finished when the signal came leaves the checkpoint before it.
    let or_before = format!("stage1: resumed after {} of 120 steps", (done / 25 - 1) * 25);
    assert!(stderr.contains(&resumed) || stderr.contains(&or_before), "{resumed}: {stderr}");
    assert_eq!(place.metrics_but_time("parts"), place.metrics_but_time("whole"), "no step is missing or doubled");
    assert_eq!(place.weights("parts", "stage1"), place.weights("whole", "stage1"));
}

#[test]
fn half_written_folders_that_are_no_use_are_made_anew() {
    let place = Place::new();
    place.train("whole", &[], &["--only", "stage1"]).ok();
    // A folder under its temporary name that does not say what it was made from, and a save that a kill cut off.
    std::fs::create_dir(place.at("whole/clusters.tmp")).unwrap();
    std::fs::write(place.at("whole/clusters.tmp/clusters.bin"), b"half").unwrap();
    std::fs::create_dir_all(place.at("whole/stage2/checkpoints/step-000000002.tmp")).unwrap();
    place.train("whole", &[], &[]).ok();
    assert!(!place.at("whole/clusters.tmp").exists());
    place.train("other", &[], &[]).ok();
    place.assert_same_result("whole", "other");
}

#[test]
fn the_number_of_loader_threads_does_not_change_the_weights() {
    let place = Place::new();
    place.train("none", &["data.num_threads=0"], &[]).ok();
    place.train("two", &["data.num_threads=2", "data.num_prefetch=3"], &[]).ok();
    assert_eq!(place.metrics_but_time("none"), place.metrics_but_time("two"));
    place.assert_same_result("none", "two");
}

#[test]
fn a_batch_worked_off_in_parts_gives_the_same_update() {
    let place = Place::new();
    let batches = ["stage1.batch_size=5", "stage2.batch_size=5"];
    place.train("at_once", &batches, &[]).ok();
    // Three scenes and two: parts weigh as many scenes as they have. Stage 2 on its own, because K-means may cluster
    // other tokens after the smallest change of the encoder.
    for stage in ["stage1", "stage2"] {
        let accumulate = format!("{stage}.accumulate=2");
        place.train(stage, &[&batches[..], &[accumulate.as_str()]].concat(), &[]).ok();
        let (whole, parts) = (place.weights("at_once", stage), place.weights(stage, stage));
        let moves: Vec<f64> = parts.moved_from(&whole).collect();
        // Sums in another order differ in the last bit of f32. Adam divides by the size of a gradient, so one that is
        // nearly zero may move its weight by another share of the rate of 1e-3; 2e-6 was the most, 1e-9 the mean.
        let most = moves.iter().copied().fold(0.0, f64::max);
        let mean = moves.iter().sum::<f64>() / moves.len() as f64;
        assert!(most < 1e-4 && mean < 1e-7, "{stage}: {most:e}, {mean:e}");
        for (part, whole) in place.metrics(stage).iter().zip(&place.metrics("at_once")) {
            let relative = |key: &str| (part[key].as_f64().unwrap() / whole[key].as_f64().unwrap() - 1.0).abs();
            // Eight times the rounding of one f32.
            let same = relative("loss") < 1e-6 && relative("grad_norm") < 1e-6;
            assert!(same || part["stage"] != stage, "{part} is not {whole}");
        }
    }
}

#[test]
fn a_finished_run_is_left_as_it_is() {
    let place = Place::new();
    place.train("run", &[], &[]).ok();
    let before = files(&place.at("run"));
    let summary = place.summary_but_time("run");
    let ran = place.train("run", &[], &[]).ok();
    assert!(!ran.stderr.contains("stage1: 6 steps") && !ran.stderr.contains("stage2: 4 steps"), "{}", ran.stderr);
    let after = files(&place.at("run"));
    assert!(before.keys().eq(after.keys()), "{:?}", after.keys());
    for (path, bytes) in &before {
        // The evaluation is made again; its timings differ.
        let timed =
            ["summary.json", "views.csv", "report.html"].iter().any(|name| path.ends_with(format!("eval/{name}")));
        assert!(timed || *bytes == after[path], "{} changed", path.display());
    }
    assert_eq!(place.summary_but_time("run"), summary);
}

#[test]
fn keys_that_decide_the_result_are_refused_by_name_and_others_may_change() {
    let place = Place::new();
    place.train("run", &[], &["--only", "stage1"]).ok();
    let before = files(&place.at("run"));
    for (change, expected) in [
        ("seed=1", "  seed: 0 -> 1"),
        ("stage1.steps=5", "  stage1.steps: 6 -> 5"),
        ("stage1.optimizer.learning_rate=2e-3", "  stage1.optimizer.learning_rate: 0.001 -> 0.002"),
        ("clusters.grid=[0.5]", "  clusters.grid: [\"1/2\", \"1/1\"] -> [\"1/2\"]"),
        ("stage1.init_from=other", "  stage1.init_from: not set -> \"other\""),
    ] {
        let message = place.train("run", &[change], &[]).fails(2);
        assert!(message.contains(&format!("settings:\n{expected}\nresume")), "{expected}: {message}");
        assert!(message.contains("--fresh") && message.trim_end().ends_with("/run"), "{message}");
    }
    let message = place.train("run", &["seed=1", "stage1.steps=7"], &["--overfit", "2"]).fails(2);
    let expected = "settings:\n  --overfit: off -> 2\n  seed: 0 -> 1\n  stage1.steps: 6 -> 7\nresume";
    assert!(message.contains(expected), "{message}");
    assert!(files(&place.at("run")) == before, "a refusal changes nothing");

    let free = ["data.num_threads=0", "checkpoint.every=3", "eval.num_scenes=1", "device=ndarray"];
    place.train("run", &free, &["--only", "clusters"]).ok();
}

#[test]
fn fresh_moves_the_former_run_aside() {
    let place = Place::new();
    place.train("run", &[], &["--only", "stage1"]).ok();
    let before: Vec<_> = files(&place.at("run")).into_values().collect();
    let ran = place.train("run", &["stage1.steps=3"], &["--only", "stage1", "--fresh"]).ok();
    assert!(ran.stderr.contains("moved the former run to "), "{}", ran.stderr);
    assert!(files(&place.at("run.1")).into_values().eq(before), "every byte of it");
    assert_eq!(place.metrics("run").len(), 3);
    place.train("run", &[], &["--only", "stage1", "--fresh"]).ok();
    assert_eq!((place.metrics("run.2").len(), place.metrics("run").len()), (3, 6));
}

#[test]
fn an_evaluation_can_be_interrupted() {
    let place = Place::new();
    place.train("run", &["data.synthetic.num_scenes=400"], &[]).ok();
    let run = place.at("run").display().to_string();
    // Hundreds of scenes with rows of targets: far longer than the signal takes.
    let mut child = spawn(["eval", &run, "--set", "eval.num_scenes=0", "--set", "eval.num_sheets=400"]);
    let sheets = place.at("run/eval/sheets");
    let names = || {
        let items = std::fs::read_dir(&sheets).expect("the first evaluation's");
        items.map(|item| item.expect("an item").path()).collect::<std::collections::BTreeSet<_>>()
    };
    let (before, summary) = (names(), place.bytes("run/eval/summary.json"));
    // Sheets are made in a folder of their own, and take the place of the former ones all together.
    let new = |path: &std::path::PathBuf| std::fs::read_dir(path).map_or(0, Iterator::count);
    let started = Instant::now();
    while names().difference(&before).map(new).sum::<usize>() < 3 {
        assert!(child.try_wait().expect("a child").is_none(), "the evaluation ended before the signal");
        assert!(started.elapsed() < Duration::from_mins(1), "no sheet within a minute");
        std::thread::sleep(Duration::from_millis(2));
    }
    send(&child, "-INT");
    let message = finish(child).fails(130);
    assert!(message.contains("interrupted during the evaluation, after "), "{message}");
    assert!(message.contains(" scenes; nothing was written"), "{message}");
    assert_eq!((names(), place.bytes("run/eval/summary.json")), (before, summary));
    // A shorter evaluation leaves no sheet of a longer one, and whatever else is there.
    std::fs::write(sheets.join("mine.png"), b"").expect("writable");
    clift(["eval", &run, "--set", "eval.num_sheets=1", "--set", "eval.num_scenes=2"]).ok();
    assert_eq!(names().len(), 2);
}

#[test]
fn a_finished_run_needs_neither_its_clusters_nor_what_it_started_from() {
    let place = Place::new();
    place.train("first", &[], &["--only", "stage1"]).ok();
    let from = format!("stage1.init_from=\"{}\"", place.at("first").display());
    place.train("second", &[&from], &[]).ok();
    std::fs::remove_dir_all(place.at("first")).expect("removes");
    std::fs::remove_dir_all(place.at("second/clusters")).expect("removes");
    place.train("second", &[&from], &[]).ok();
    assert!(!place.at("second/clusters").exists(), "nothing was clustered again");
}

#[test]
fn a_resumed_stage_does_not_look_for_the_weights_it_started_from() {
    let place = Place::new();
    place.train("first", &[], &["--only", "stage1"]).ok();
    let from = format!("stage1.init_from=\"{}\"", place.at("first").display());
    let set: Vec<&str> = LONG.iter().copied().chain([from.as_str()]).collect();
    stop_after(&place, "second", &set, &["--only", "stage1"], 10, "-INT").fails(130);
    std::fs::remove_dir_all(place.at("first")).expect("removes");
    place.train("second", &set, &["--only", "stage1"]).ok();
}
