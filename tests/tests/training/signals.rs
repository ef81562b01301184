//! Signals and second processes.

use std::os::unix::process::ExitStatusExt;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::support::{BINARY, Place, finish, signal, skip, start, wait_until};

/// A run that lasts until the signal arrives.
const LONG: [&str; 5] =
    ["stage1.steps=20000", "stage2.steps=120", "eval.every=0", "checkpoint.every=10000", "data.num_threads=0"];

/// Whether these tests run under `nohup`, which their runs inherit.
fn is_hang_up_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    ignored.is_some_and(|mask| u64::from_str_radix(mask.trim(), 16).is_ok_and(|mask| mask & 1 == 1))
}

#[test]
fn signals_save_and_runs_resume_to_the_same_result() {
    // A stage lasts until the signal arrives: a step takes milliseconds.
    let set = ["stage1.steps=120", "stage2.steps=120", "eval.every=50", "checkpoint.every=25"];
    let place = Place::new();
    place.train("whole", &set).ok();
    for (name, code, count) in [("-INT", 130, 10), ("-HUP", 129, 60), ("-TERM", 143, 130)] {
        if name == "-HUP" && is_hang_up_ignored() {
            skip("sighup", "the tests run under nohup");
            continue;
        }
        let mut child = place.start_train("run", &set);
        place.wait_for_steps("run", &mut child, count);
        // GNU `timeout` signals the process and its group.
        signal(&child, name);
        signal(&child, name);
        let ran = finish(child);
        let last = place.metrics("run").pop().expect("a step");
        let (stage, step) = (last["stage"].as_str().expect("text"), last["step"].as_u64().expect("a number"));
        let saved = format!("saved {}", place.at(&format!("run/{stage}/checkpoints")).display());
        let waits = "finishing this step and saving; Ctrl-C again ends without saving\n";
        let text =
            ran.fails_with(code, &[&format!("error: interrupted at step {step}; the same command resumes"), &saved]);
        assert_eq!(text.matches(waits).count(), 1, "{text}");
        assert_eq!(place.checkpoints("run", stage).last(), Some(&step));
        assert!(!place.at(&format!("run/{stage}/model.safetensors")).exists());
    }
    place.train("run", &set).ok().notes("stage2: resumed after");
    place.assert_same_run("run", "whole");
}

#[test]
fn second_signals_end_runs_after_a_second() {
    let place = Place::new();
    // The first batch takes far longer than two signals.
    let set = [&LONG[..], &["stage1.batch_size=50000"]].concat();
    let mut child = place.start_train("run", &set);
    // The handler is installed before the lock is taken.
    let id = child.id().to_string();
    wait_until(&mut child, "the lock", || std::fs::read_to_string(place.at("run/lock")).unwrap_or_default() == id);
    signal(&child, "-TERM");
    signal(&child, "-TERM");
    std::thread::sleep(Duration::from_millis(1500));
    assert!(child.try_wait().expect("a child").is_none(), "two signals at once wait for the step");
    signal(&child, "-TERM");
    let started = Instant::now();
    let ran = finish(child);
    assert!(started.elapsed() < Duration::from_secs(5) && ran.code == Some(143), "{:?}: {}", ran.code, ran.stderr);
    let ended = "ended without saving; the same command resumes from the last checkpoint\n";
    assert!(ran.stderr.ends_with(ended), "{}", ran.stderr);
    assert!(!ran.stderr.contains("saved ") && !place.at("run/stage1/checkpoints").exists(), "{}", ran.stderr);
}

#[test]
fn a_run_that_is_moved_stops_and_resumes_elsewhere() {
    let place = Place::new();
    let set = [&LONG[..3], &["checkpoint.every=20", "data.num_threads=0"]].concat();
    let mut child = place.start_train("run", &set);
    place.wait_for_steps("run", &mut child, 25);
    std::fs::rename(place.at("run"), place.at("moved")).expect("renames");
    let moved = "the run directory was moved or removed during training; resume at its new place";
    finish(child).fails_naming(1, &[moved], "/run");
    assert!(!place.at("run").exists(), "no second run directory without a config is made");
    assert!(place.checkpoints("moved", "stage1").last().is_some_and(|step| step % 20 == 0));
    // Removed, since the next wait counts lines.
    std::fs::remove_file(place.at("moved/metrics.jsonl")).expect("removes");
    let mut child = place.start_train("moved", &set);
    place.wait_for_steps("moved", &mut child, 5);
    signal(&child, "-INT");
    finish(child).fails_with(130, &[]);
}

#[test]
fn second_processes_are_refused_while_the_first_lives() {
    let place = Place::new();
    let mut first = place.start_train("run", &LONG);
    place.wait_for_steps("run", &mut first, 5);
    let holder = format!(" is in use by process {}; wait until it exits", first.id());
    for words in ["run", "run --fresh", "run --only clusters"] {
        place.train(words, &LONG).fails_with(1, &[&holder, "/run is in use"]);
    }
    assert!(!place.at("run.1").exists(), "nothing was moved from under it");
    place.eval("run").fails_with(1, &[&holder]);
    place.clift("codec DIR/run").fails_with(1, &[&holder, "or set another model"]);
    // Elsewhere an evaluation may write; there are no weights yet.
    place.eval("run --out DIR/elsewhere").fails_with(2, &["the weights of stage 1"]);

    assert!(first.try_wait().expect("a child").is_none(), "the first goes on");
    signal(&first, "-KILL");
    let status = first.wait().expect("a child");
    assert_eq!(status.signal(), Some(9));
    // The lock of the killed process is void. Its metrics are removed, since the next wait counts lines.
    std::fs::remove_file(place.at("run/metrics.jsonl")).expect("removes");
    let mut next = place.start_train("run", &LONG);
    place.wait_for_steps("run", &mut next, 5);
    signal(&next, "-INT");
    finish(next).fails(130);
}

#[test]
fn a_run_started_by_nohup_outlives_its_terminal() {
    let place = Place::new();
    let mut command = Command::new("sh");
    command.args(["-c", "trap '' HUP; exec \"$@\"", "sh", BINARY]).args(place.train_args("run", &LONG));
    let mut child = start(&mut command);
    place.wait_for_steps("run", &mut child, 5);
    signal(&child, "-HUP");
    let steps = place.metrics("run").len();
    place.wait_for_steps("run", &mut child, steps + 20);
    signal(&child, "-TERM");
    finish(child).fails_with(143, &[]);
}
