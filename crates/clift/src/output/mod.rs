//! Results, notes and progress for people: results go to the standard output, everything else to the standard error.
//!
//! - `units`: seconds, bytes, counts
//! - `visible`: control characters escaped
//! - `output_file`: files that are written, checked beforehand
//! - `tensorboard`: event files
//! - `stdout`: results to stdout, notes to stderr
//! - `counter`: progress of counted work
//! - `written_scene`: what `clift encode` wrote
//! - `progress`: progress of a run

pub(crate) mod counter;
pub(crate) mod output_file;
pub(crate) mod progress;
pub(crate) mod stdout;
pub(crate) mod tensorboard;
pub(crate) mod units;
pub(crate) mod visible;
pub(crate) mod written_scene;
