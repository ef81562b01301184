//! Devices and tensors of tests.

use std::io::Write;

use cubecl::device::{Device, RuntimeId, WgpuDeviceKind};
use cubecl::prelude::*;
use cubecl::wgpu::{WgpuServer, WgslCompiler};

use crate::adapter::AdapterClass;
use crate::adapter::MatrixShape;
use crate::buffers::buffer::{Buffer, Values};

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

/// Returns values in [-1, 1].
pub(crate) fn random(len: usize, seed: u64) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(0x1234_5678_9abc_def1);
    let next = |_| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..len).map(next).collect()
}

/// Copies values to a device.
pub(crate) fn upload(client: &Client, x: &[f32], values: Values) -> Buffer {
    let bytes: Vec<u8> = match values {
        Values::F32 => x.iter().flat_map(|value| value.to_le_bytes()).collect(),
        Values::F16 => x.iter().flat_map(|&value| half::f16::from_f32(value).to_le_bytes()).collect(),
    };
    Buffer { handle: client.create_from_slice(&bytes), len: x.len(), values }
}

/// Copies values from a device.
pub(crate) fn read(client: &Client, x: &Buffer) -> Vec<f32> {
    let bytes = client.read_one(x.handle.clone()).expect("kernels that ran");
    let values: Vec<f32> = match x.values {
        Values::F32 => bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
        Values::F16 => bytes.chunks_exact(2).map(|b| half::f16::from_le_bytes([b[0], b[1]]).to_f32()).collect(),
    };
    values[..x.len].to_vec()
}

/// Rounds to f16.
pub(crate) fn rounded(x: f32) -> f32 {
    half::f16::from_f32(x).to_f32()
}

/// Returns the complementary error function, by Simpson's rule.
pub(crate) fn erfc(x: f64) -> f64 {
    let (steps, density) = (2000, |t: f64| (-t * t).exp());
    let step = x / f64::from(steps);
    let term = |i: i32| {
        let middle = (f64::from(i) + 0.5) * step;
        density(f64::from(i) * step) + 4.0 * density(middle) + density(f64::from(i + 1) * step)
    };
    1.0 - std::f64::consts::FRAC_2_SQRT_PI * step / 6.0 * (0..steps).map(term).sum::<f64>()
}

/// Returns the largest difference, relative to the expected value where that is above one.
pub(crate) fn worst(computed: &[f32], expected: &[f64]) -> f64 {
    assert_eq!(computed.len(), expected.len());
    let error = |(&x, &y): (&f32, &f64)| (f64::from(x) - y).abs() / (1.0 + y.abs());
    computed.iter().zip(expected).map(error).fold(0.0, |a, b| if b.is_nan() { f64::INFINITY } else { a.max(b) })
}
