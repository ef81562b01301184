//! The crash test in short form: SIGKILL at random moments, saving included. `scripts/check/crash_test.py` is the long form.

use std::time::Instant;

use crate::support::{Place, draw, finish, wait_at_most};

/// A checkpoint after every step takes about half of the time.
const SAVING: [&str; 4] = ["stage1.steps=20", "stage2.steps=15", "eval.every=5", "checkpoint={every=1, keep=2}"];

const NUM_KILLS: usize = 8;

#[test]
fn runs_killed_at_random_end_the_same() {
    let place = Place::new();
    let started = Instant::now();
    place.train("whole", &SAVING).ok();
    let whole = started.elapsed();
    let (mut state, mut num_kills) = (7, 0);
    for run in 0.. {
        let name = format!("run{run}");
        loop {
            let mut child = place.start_train(&name, &SAVING);
            if num_kills < NUM_KILLS {
                wait_at_most(whole.mul_f64(draw(&mut state)), &mut child);
                child.kill().expect("a child");
            }
            let ran = finish(child);
            if ran.code.is_some() {
                ran.ok();
                break;
            }
            num_kills += 1;
        }
        place.assert_same_run(&name, "whole");
        if num_kills == NUM_KILLS {
            break;
        }
    }
}
