//! `clift bench --ledger`: the kernels that every case launches on a GPU.

use std::sync::atomic::{AtomicBool, Ordering};

use clift_core::BadConfig;
use clift_model::{
    DeviceName, KernelLaunches, Precision, names, observe_kernels, parse_variant, reserved_bytes, used_adapter,
};
use clift_train::{Config, TrainError};
use serde::Serialize;
use strum::{Display, IntoStaticStr, VariantArray};

use crate::cases::case::BenchCase;
use crate::cases::context::{BenchContext, BenchOptions};
use crate::runner::prepare;

/// A card, for [`Card::bound_s`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Display, IntoStaticStr, Serialize, VariantArray)]
#[serde(into = "&'static str")]
#[strum(serialize_all = "lowercase")]
pub enum Card {
    /// NVIDIA H100 SXM.
    H100,
    /// NVIDIA RTX 4090.
    #[strum(serialize = "4090")]
    Rtx4090,
    /// Apple M3 Max with 40 cores.
    M3Max,
}

impl Card {
    /// Returns memory bandwidth in TB/s, and TFLOP/s of multiply-adds in f32 and of matrices in f16 with f32 sums, from the
    /// vendors' data sheets. Apple names the bandwidth only: 14 is 40 cores of 128 multiply-adds at 1.4 GHz; the M3 Max has no
    /// matrix instructions.
    fn limits(self) -> [f64; 3] {
        match self {
            Self::H100 => [3.35, 67.0, 989.0],
            Self::Rtx4090 => [1.008, 82.6, 165.0],
            Self::M3Max => [0.4, 14.0, 14.0],
        }
    }

    /// Returns the least time that the card needs for the launches of a kernel: the larger of bytes over bandwidth, each buffer
    /// moved once, and operations over rate. 0 for kernels of Burn.
    pub fn bound_s(self, kernel: &KernelLaunches) -> f64 {
        let [bandwidth, multiply_adds, matrices] = self.limits();
        let rate = if kernel.kernel.contains("::matrix_") { matrices } else { multiply_adds };
        let [move_s, compute_s] =
            [(kernel.bytes.unwrap_or(0), bandwidth), (kernel.flops, rate)].map(|(n, tera)| n as f64 / tera / 1e12);
        move_s.max(compute_s)
    }
}

impl std::str::FromStr for Card {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        parse_variant(name).ok_or_else(|| format!("use one of {}", names::<Self>()))
    }
}

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

    /// Returns the floating-point operations that the kernels count.
    pub fn flops(&self) -> u64 {
        self.kernels.iter().map(|kernel| kernel.flops).sum()
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
