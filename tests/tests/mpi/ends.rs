//! A rank that ends early ends all, with one message; a finished run is reported once.

use std::process::Command;
use std::time::{Duration, Instant};

use crate::engine::{is_running, one_at_a_time, ranks_of, signal, start_train};
use crate::support::{BINARY, Place, Ran, finish, start};

const LONG: [&str; 4] = ["stage1.steps=4000", "stage2.steps=10", "eval.every=0", "checkpoint={every=50, keep=2}"];

fn num_errors(ran: &Ran) -> usize {
    ran.stderr.lines().filter(|line| line.starts_with("error: ")).count()
}

#[test]
fn a_killed_rank_ends_the_others_within_seconds() {
    let _one = one_at_a_time();
    let place = Place::new();
    let mut child = start_train(&place, 3, "run", &LONG);
    place.wait_for_steps("run", &mut child, 60);
    let ids = ranks_of(child.id());
    assert_eq!(ids.len(), 3);
    let killed = Instant::now();
    signal(ids[2], "-KILL");
    let ran = finish(child);
    assert!(killed.elapsed() < Duration::from_secs(10), "{:?}", killed.elapsed());
    assert!(ran.code != Some(0) && ran.stderr.contains("signal 9 (Killed)"), "{}", ran.stderr);
    // The launcher may end before the last rank is gone.
    while ids.iter().any(|id| is_running(*id)) {
        assert!(killed.elapsed() < Duration::from_secs(10), "no rank is left");
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn a_signal_to_one_rank_saves_the_run() {
    let _one = one_at_a_time();
    let place = Place::new();
    let mut child = start_train(&place, 2, "run", &LONG);
    place.wait_for_steps("run", &mut child, 60);
    signal(ranks_of(child.id())[1], "-TERM");
    let ran = finish(child);
    assert_eq!(num_errors(&ran), 1, "{}", ran.stderr);
    assert!(ran.stderr.contains("error: interrupted at step "), "{}", ran.stderr);
    let steps = place.metrics("run").len() as u64;
    assert_eq!(place.checkpoints("run", "stage1").last(), Some(&steps), "the step is finished and saved");
}

#[test]
fn a_wrong_config_is_reported_once() {
    let _one = one_at_a_time();
    let place = Place::new();
    let ran = finish(start_train(&place, 2, "run", &["stage1.batch_size=0"]));
    assert_eq!(ran.code, Some(2), "{}", ran.stderr);
    assert_eq!(num_errors(&ran), 1, "{}", ran.stderr);
}

#[test]
fn a_launcher_that_mpi_does_not_know_is_named() {
    let place = Place::new();
    let step = [("SLURM_STEP_NUM_TASKS", "2"), ("SLURM_PROCID", "0")];
    let mut command = Command::new(BINARY);
    let ran = finish(start(command.envs(step).args(place.train_args("run", &[]))));
    ran.fails_with(2, &["a launcher started 2 processes, and MPI connects 1 of them", "srun --mpi=pmix"]);
}

#[test]
fn a_finished_run_is_reported_by_rank_0_alone() {
    let _one = one_at_a_time();
    let place = Place::new();
    place.train("run", &[]).ok();
    let ran = finish(start_train(&place, 2, "run", &[])).ok();
    assert_eq!(ran.stderr.matches("the run is trained and evaluated").count(), 1, "{}", ran.stderr);
    assert_eq!(ran.stdout.matches("report: ").count(), 1, "{}", ran.stdout);
}
