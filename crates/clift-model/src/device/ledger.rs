//! The kernels that a computation launches on a GPU.

use burn::tensor::Device;
use serde::Serialize;

/// All launches of one kernel.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KernelLaunches {
    /// Path of the kernel, without the crate; `burn: ..` for kernels of Burn.
    pub kernel: String,
    /// Number of launches.
    pub count: usize,
    /// Bytes of the buffers that the launches read and write, each counted once; `None` for kernels of Burn, which do not tell.
    pub bytes: Option<u64>,
    /// Floating-point operations of matrix products and attention, without attention inside clusters; 0 for kernels of Burn.
    pub flops: u64,
    /// Time on the device; `None` if the launches were dropped, and without timestamps.
    pub seconds: Option<f64>,
}

/// Runs a computation and returns its result and its kernels, those with the most launches first. If `is_timed`, every launch is
/// timed; otherwise the kernels are compiled and not run, and all results are undefined.
#[cfg(feature = "wgpu")]
pub fn observe_kernels<T>(is_timed: bool, run: impl FnOnce() -> T) -> (T, Vec<KernelLaunches>) {
    use std::collections::BTreeMap;

    let (result, launches) = clift_cube::observe(is_timed, run);
    let mut kernels: BTreeMap<String, KernelLaunches> = BTreeMap::new();
    for launch in launches {
        let entry = kernels.entry(short_name(launch.kernel)).or_insert_with_key(|name| KernelLaunches {
            kernel: name.clone(),
            count: 0,
            bytes: (!name.starts_with("burn")).then_some(0),
            flops: 0,
            seconds: Some(0.0),
        });
        entry.count += 1;
        entry.flops += launch.flops;
        entry.bytes = entry.bytes.map(|sum| sum + launch.bytes);
        entry.seconds = entry.seconds.zip(launch.seconds).map(|(sum, seconds)| sum + seconds);
    }
    let mut kernels: Vec<_> = kernels.into_values().collect();
    kernels.sort_by_key(|kernel| std::cmp::Reverse(kernel.count));
    (result, kernels)
}

/// Runs a computation: this build has no GPU kernels.
#[cfg(not(feature = "wgpu"))]
pub fn observe_kernels<T>(_is_timed: bool, run: impl FnOnce() -> T) -> (T, Vec<KernelLaunches>) {
    (run(), Vec::new())
}

/// Returns the bytes that the allocator of an open GPU holds; `None` for a CPU.
pub fn reserved_bytes(device: &Device) -> Option<u64> {
    match device.clone().without_autodiff().as_dispatch() {
        #[cfg(feature = "wgpu")]
        burn::backend::DispatchDevice::Cube(device) => Some(clift_cube::reserved_bytes(&device.client())),
        _ => None,
    }
}

/// Returns the path of a kernel without generic arguments, the type inside its module and the crate.
#[cfg(feature = "wgpu")]
fn short_name(type_name: &str) -> String {
    let path = type_name.split('<').next().unwrap_or(type_name);
    let path = path.rsplit_once("::").map_or(path, |(module, _)| module);
    match path.strip_prefix("clift_cube::") {
        Some(own) => own.to_owned(),
        None => format!("burn: {path}"),
    }
}
