//! Measures the program itself: `clift bench` and `clift doctor`.

mod cases;
mod doctor;
mod ledger;
mod runner;

// Time and error of the parts of the method
pub use cases::case::BenchCase;
pub use cases::context::{BenchOptions, MAX_CHECKED_TOKENS};
pub use runner::{BenchReport, BenchRow, run_bench};
// Kernels of the parts on a GPU
pub use ledger::{Card, Ledger, LedgerRow, run_ledger};
// Devices and numerical stability
pub use doctor::probe::{DeviceCheck, catch_panic, probe};
pub use doctor::stability::case::{CaseSize, StabilityCase, StabilityRow};
pub use doctor::stability::suite::{outcome_text, run_stability, stability_markdown};
