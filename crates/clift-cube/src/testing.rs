//! Devices of tests, and computations that they check.

pub(crate) mod cases;
pub(crate) mod row_cases;

use std::io::Write;

use cubecl::device::{Device, RuntimeId, WgpuDeviceKind};
use cubecl::prelude::*;
use cubecl::wgpu::{WgpuServer, WgslCompiler};

use crate::adapter::{AdapterClass, MatrixShape};
use crate::buffers::buffer::Buffer;
use crate::testing::cases::{Case, read};

/// Returns a client of the default adapter, with kernels in SPIR-V if `CLIFT_CUBE_SPIRV` is set, in WGSL otherwise. Without an
/// adapter prints that the test is skipped, or fails if `CLIFT_REQUIRE_WGPU` is set.
pub(crate) fn client() -> Option<Client> {
    let device = match Device::wgpu(WgpuDeviceKind::DefaultDevice) {
        Ok(device) => device,
        Err(error) => return skipped("WGPU", &error.to_string()),
    };
    Some(if std::env::var_os("CLIFT_CUBE_SPIRV").is_some() {
        device.client()
    } else {
        Client::load::<WgpuServer<WgslCompiler>>(RuntimeId::strip(device.to_id()))
    })
}

/// Returns a client of an adapter with cooperative matrices, and their shape, as [`client`].
pub(crate) fn matrix_client() -> Option<(Client, MatrixShape)> {
    let client = client()?;
    match AdapterClass::of(&client) {
        AdapterClass::Matrices(shape) => Some((client, shape)),
        AdapterClass::Registers => skipped("MATRICES", "the adapter has no cooperative matrices"),
    }
}

/// Prints that this test is skipped; fails if `CLIFT_REQUIRE_TOOL` is set.
fn skipped<T>(tool: &str, reason: &str) -> Option<T> {
    let variable = format!("CLIFT_REQUIRE_{tool}");
    assert!(std::env::var_os(&variable).is_none(), "{variable} is set: {reason}");
    let thread = std::thread::current();
    let test = thread.name().filter(|name| *name != "main").unwrap_or(tool);
    let line = format!("skipped: {test}: {reason}\n");
    // Not `eprintln`, whose output the harness hides.
    std::io::stderr().write_all(line.as_bytes()).expect("the standard error is open");
    None
}

/// Expects results within a tolerance of those in f64, and the same bytes at a second run.
#[track_caller]
pub(crate) fn check(client: &Client, case: &Case, tolerance: f64) {
    let inputs = case.upload(client);
    let results = (case.run)(client, &inputs);
    let errors = case.errors(client, &results).expect("kernels that run");
    assert!(errors.iter().all(|error| *error < tolerance), "{errors:?}, at most {tolerance}");
    let values = |results: &[Buffer]| results.iter().map(|x| read(client, x).expect("runs")).collect::<Vec<_>>();
    assert!(values(&(case.run)(client, &inputs)) == values(&results), "other results at a second run");
}
