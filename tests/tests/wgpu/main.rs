//! Results of a GPU (or Mesa's software Vulkan) against the CPU:
//! `cargo test --release --workspace --features wgpu --test wgpu_suite -- --nocapture` prints a table.
//!
//! Without an adapter the tests print a line and pass; with `CLIFT_REQUIRE_WGPU` set they fail.

mod clusters;
mod condenser;
mod modules;
mod no_adapter;
mod place;
mod reads;
mod scene;
mod table;
mod updates;

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use burn::tensor::Device;
use clift_model::DeviceName;
use place::Place;
use table::{Case, Difference};

/// Environment variable that makes a missing adapter a failure.
const REQUIRED: &str = "CLIFT_REQUIRE_WGPU";

/// Reason of a failure, printed without quotes.
struct Failure(String);

impl std::fmt::Debug for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

/// The GPU, for one test at a time; `None` where there is none and none is required.
fn gpu() -> Result<Option<(Device, MutexGuard<'static, ()>)>, Failure> {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    match DeviceName::Wgpu.open() {
        Ok(device) => Ok(Some((device, ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner)))),
        Err(error) if std::env::var_os(REQUIRED).is_some() => {
            Err(Failure(format!("{REQUIRED} is set and the suite cannot run: {error}")))
        }
        Err(error) => {
            eprintln!("not run: {error}");
            Ok(None)
        }
    }
}

fn cpu() -> Device {
    DeviceName::Flex.open().expect("the CPU device")
}

fn cases() -> impl Iterator<Item = &'static Case> {
    [modules::CASES, condenser::CASES, clusters::CASES, updates::CASES, scene::CASES].into_iter().flatten()
}

#[test]
fn every_operation_gives_what_the_cpu_gives() -> Result<(), Failure> {
    let Some((gpu, _guard)) = gpu()? else { return Ok(()) };
    println!("{}", table::header());
    let mut failures = Vec::new();
    for case in cases() {
        let expected = (case.run)(&Place::new(&cpu()));
        let started = Instant::now();
        let got = (case.run)(&Place::new(&gpu));
        let difference = Difference::of(&got, &expected);
        println!("{}", case.row(&difference, started.elapsed()));
        failures.extend(case.complaints(&difference));
    }
    if failures.is_empty() { Ok(()) } else { Err(Failure(failures.join("\n"))) }
}

/// Every tolerance is tight enough to fail on slightly wrong inputs.
#[test]
fn every_tolerance_detects_slightly_wrong_inputs() {
    let mut passed = Vec::new();
    for case in cases() {
        let place = Place::new(&cpu());
        let expected = (case.run)(&place);
        assert!(Difference::of(&(case.run)(&place), &expected).is_zero(), "{}: not the same twice", case.operation);
        let wrong = Difference::of(&(case.run)(&place.wrong()), &expected);
        if case.complaints(&wrong).len() < case.num_directions() {
            passed.push(format!("{}: {wrong:?}", case.operation));
        }
    }
    assert!(passed.is_empty(), "these pass:\n{}", passed.join("\n"));
}
