//! Results, their summaries and comparisons.
//!
//! - `view_metrics`: `EvalKey`, `ViewMetrics`, `Cost`
//! - `eval_results`: metrics of every view
//! - `pareto`: Pareto front
//! - `metric_difference`: paired differences of views, with confidence intervals
//! - `paired`: paired differences of methods
//! - `summary`: summary.json
//! - `csv_files`: views.csv and scenes.csv
//! - `text_table`: aligned columns
//! - `table`: the terminal table
//! - `compare`: two evaluations, view by view, and their terminal table

pub(crate) mod compare;
pub(crate) mod csv_files;
pub(crate) mod eval_results;
pub(crate) mod metric_difference;
pub(crate) mod paired;
pub(crate) mod pareto;
pub(crate) mod summary;
pub(crate) mod table;
pub(crate) mod text_table;
pub(crate) mod view_metrics;
