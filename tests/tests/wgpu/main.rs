//! Results of a GPU (or Mesa's software Vulkan) against the CPU:
//! `cargo test --release --workspace --features wgpu --test wgpu_suite -- --nocapture` prints a table.
//!
//! Without an adapter the tests are skipped; with `CLIFT_REQUIRE_WGPU` set they fail.

mod clusters;
mod condenser;
mod modules;
mod no_adapter;
mod place;
mod reads;
mod scene;
#[allow(dead_code)]
#[path = "../support.rs"]
mod support;
mod table;
mod updates;

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use burn::tensor::Device;
use clift_model::DeviceName;
use place::Place;
use table::{Case, Difference};

/// The GPU, for one test at a time; `None` where there is none and none is required.
fn gpu() -> Option<(Device, MutexGuard<'static, ()>)> {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    match DeviceName::Wgpu.open() {
        Ok(device) => Some((device, ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner))),
        Err(error) => {
            support::skip("wgpu", &error.to_string());
            None
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
fn every_operation_gives_what_the_cpu_gives() {
    let Some((gpu, _guard)) = gpu() else { return };
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
    assert!(failures.is_empty(), "{}", failures.join("\n"));
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
