//! Measures the program itself: `clift bench`, `clift doctor` and `clift plan`.

mod cases;
mod data_reading;
mod doctor;
mod plan;
mod precision;
mod runner;

pub use cases::case::BenchCase;
pub use cases::options::{BenchOptions, MAX_CHECKED_TOKENS};
pub use cases::reference::module_in_f64;
pub use data_reading::{Throughput, ThroughputOptions, measure as measure_reading};
pub use doctor::probe::{DeviceCheck, Gradient, caught, probe};
pub use doctor::stability::case::{Row as StabilityRow, Size};
pub use doctor::stability::suite::{
    markdown as stability_markdown, run as run_stability, table_text as stability_text,
};
pub use plan::plan::{PartPlan, Plan, check as check_plan, plan};
pub use precision::{PrecisionReport, PrecisionRow, WORKS, compare as compare_precision};
pub use runner::{BenchEvent, Report, Row as BenchRow, run as run_bench};
