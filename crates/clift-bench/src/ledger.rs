//! `clift bench --ledger`: the kernels that every case launches on a GPU.

use std::sync::atomic::{AtomicBool, Ordering};

use clift_core::BadConfig;
use clift_model::{DeviceName, KernelLaunches, Precision, observe_kernels, reserved_bytes, used_adapter};
use clift_train::{Config, TrainError};
use serde::Serialize;

use crate::cases::case::BenchCase;
use crate::cases::context::{BenchContext, BenchOptions};
use crate::runner::prepare;

/// The kernels of every case.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Ledger {
    /// The adapter.
    pub adapter: String,
    /// Operands of matrix products.
    pub precision: Precision,
    /// Whether the kernels ran. On a software adapter they are compiled only: a full network would take minutes.
    pub is_timed: bool,
    /// One row per case.
    pub rows: Vec<LedgerRow>,
}

/// The kernels of a case.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LedgerRow {
    /// The case.
    pub case: BenchCase,
    /// Kernels, those with the most launches first.
    pub kernels: Vec<KernelLaunches>,
    /// Memory of the device that the process holds after the case, with what the cases before it left.
    pub reserved_bytes: Option<u64>,
}

impl LedgerRow {
    /// Returns the number of launches.
    pub fn count(&self) -> usize {
        self.kernels.iter().map(|kernel| kernel.count).sum()
    }

    /// Returns the bytes of the kernels that tell them.
    pub fn bytes(&self) -> u64 {
        self.kernels.iter().filter_map(|kernel| kernel.bytes).sum()
    }

    /// Returns the time on the device; `None` if a kernel has none.
    pub fn seconds(&self) -> Option<f64> {
        self.kernels.iter().map(|kernel| kernel.seconds).sum()
    }
}

/// Runs the cases of `options` once, after the warm-up, and lists their kernels. Passes finished rows to `report`.
pub fn run_ledger(
    config: &Config,
    options: &BenchOptions,
    stop: &AtomicBool,
    report: &mut dyn FnMut(&LedgerRow),
) -> Result<Ledger, TrainError> {
    if config.device != DeviceName::Wgpu {
        let fix = "--ledger counts the kernels of a GPU; add --device wgpu";
        return Err(BadConfig::new("device", config.device, fix).into());
    }
    let context = BenchContext::new(config, options)?;
    let adapter = used_adapter();
    let is_timed = adapter.as_ref().is_some_and(|adapter| adapter.kind != "software");
    let _precision = config.precision.scope();
    let mut rows = Vec::new();
    for case in context.cases() {
        // Weights and inputs are made on the device.
        let prepared = observe_kernels(is_timed, || prepare(case, &context));
        let mut task = prepared.0?;
        // The first update also makes the state of the optimizer.
        for _ in 0..options.warmup.max(1) {
            observe_kernels(is_timed, || context.time(task.as_mut())).0?;
        }
        let (result, kernels) = observe_kernels(is_timed, || context.time(task.as_mut()));
        result?;
        let row = LedgerRow { case, kernels, reserved_bytes: reserved_bytes(&context.device) };
        report(&row);
        rows.push(row);
        if stop.load(Ordering::Relaxed) {
            return Err(TrainError::Abandoned { task: format!("counting `{case}`") });
        }
    }
    let adapter = adapter.map_or_else(|| "unknown".into(), |adapter| adapter.to_string());
    Ok(Ledger { adapter, precision: config.precision, is_timed, rows })
}
