//! The crash test in short form: SIGKILL at random moments, saving included. `scripts/check/crash_test.py` is the long form.

use std::time::{Duration, Instant};

use crate::support::{Place, finish};

/// A checkpoint after every step takes about half of the time.
const SAVING: [&str; 4] = ["stage1.steps=40", "stage2.steps=30", "eval.every=10", "checkpoint={every=1, keep=2}"];

const NUM_KILLS: usize = 8;

/// A value in [0, 1), the same in every test run (the upper bits of an LCG).
fn draw(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 33) as f64 / (1_u64 << 31) as f64
}

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
                let until = Instant::now() + whole.mul_f64(draw(&mut state));
                while Instant::now() < until && child.try_wait().expect("a child").is_none() {
                    std::thread::sleep(Duration::from_millis(1));
                }
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
