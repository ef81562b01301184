//! Measures the program itself: `clift bench` and `clift doctor`.
//!
//! ```
//! use std::sync::atomic::AtomicBool;
//!
//! use clift_bench::{BenchCase, BenchOptions, run_bench};
//! use clift_train::Config;
//!
//! let mut config = Config { run_dir: "run".into(), ..Config::default() };
//! (config.data.width, config.data.height) = (16, 16);
//! (config.model.dim, config.model.num_heads, config.model.feed_forward_dim) = (16, 2, 24);
//! let options = BenchOptions { repeats: 3, warmup: 1, ..BenchOptions::new(vec![BenchCase::Encode]) };
//! let report = run_bench(&config, &options, &AtomicBool::new(false), &mut |_| {})?;
//! assert_eq!(report.rows[0].samples_s.len(), 3);
//! # Ok::<(), clift_train::TrainError>(())
//! ```

mod cases;
mod data_reading;
mod doctor;
mod precision;
mod runner;

// Time and error of the parts of the method
pub use cases::case::BenchCase;
pub use cases::context::{BenchOptions, MAX_CHECKED_TOKENS};
pub use runner::{BenchEvent, BenchReport, BenchRow, run_bench};
// f16 beside f32
pub use precision::{PRECISION_CASES, PrecisionReport, PrecisionRow, compare_precision};
// Reading of clips
pub use data_reading::{ReadClip, Throughput, ThroughputOptions, measure_reading};
// Devices and numerical stability
pub use doctor::probe::{DeviceCheck, Gradient, catch_panic, probe};
pub use doctor::stability::case::{CaseSize, StabilityCase, StabilityRow};
pub use doctor::stability::suite::{outcome_text, run_stability, stability_markdown};
