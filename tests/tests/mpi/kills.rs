//! A run whose ranks are killed at random moments, and that resumes with other numbers of ranks, ends in the same bytes.

use std::process::Child;
use std::time::{Duration, Instant};

use crate::engine::{end_within_a_minute, one_at_a_time, ranks_of, signal, start_train};
use crate::support::{Place, finish};

/// Three parts, for up to three ranks; a checkpoint after every second step.
const SAVING: [&str; 8] = [
    "stage1.steps=20",
    "stage2.steps=15",
    "stage1.batch_size=3",
    "stage2.batch_size=3",
    "stage1.accumulate=3",
    "stage2.accumulate=3",
    "eval.every=5",
    "checkpoint={every=2, keep=2}",
];

const NUM_KILLS: usize = 10;

/// A value in [0, 1), the same in every test run (the upper bits of an LCG).
fn draw(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 33) as f64 / (1_u64 << 31) as f64
}

/// Waits for a time, or until the child has ended.
fn wait_at_most(time: Duration, child: &mut Child) {
    let until = Instant::now() + time;
    while Instant::now() < until && child.try_wait().expect("a child").is_none() {
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn runs_with_killed_ranks_end_the_same_on_any_number_of_ranks() {
    let _one = one_at_a_time();
    let place = Place::new();
    place.train("whole", &SAVING).ok();
    let started = Instant::now();
    let ran = finish(start_train(&place, 2, "two", &SAVING)).ok();
    let whole = started.elapsed();
    let shared = ran.stderr.matches("2 ranks share batches of 3 scenes in 3 parts").count();
    assert_eq!(shared, 2, "once in each stage, by rank 0: {}", ran.stderr);
    assert!(ran.stderr.contains("rank 1: flex with 1 thread"), "{}", ran.stderr);
    place.assert_same_run("two", "whole");
    let (mut state, mut num_kills, mut num_runs) = (7, 0, 0);
    while num_kills < NUM_KILLS {
        let name = format!("run{num_runs}");
        num_runs += 1;
        for num_ranks in [2, 1, 2, 3].into_iter().cycle() {
            let mut child = start_train(&place, num_ranks, &name, &SAVING);
            if num_ranks == 2 && num_kills < NUM_KILLS {
                wait_at_most(whole.mul_f64(draw(&mut state)), &mut child);
                let ids = ranks_of(child.id());
                if !ids.is_empty() {
                    signal(ids[(draw(&mut state) * ids.len() as f64) as usize], "-KILL");
                }
            } else if num_kills < NUM_KILLS {
                // One or three ranks make a few steps of the rest.
                wait_at_most(whole.mul_f64(0.3 * draw(&mut state)), &mut child);
                ranks_of(child.id()).into_iter().take(1).for_each(|id| signal(id, "-KILL"));
            }
            if num_kills < NUM_KILLS {
                end_within_a_minute(&child);
            }
            let ran = finish(child);
            if ran.code == Some(0) {
                break;
            }
            num_kills += usize::from(num_ranks == 2);
        }
        place.assert_same_run(&name, "whole");
    }
}
