//! Errors of sweeps, comparisons and reports.

use std::path::{Path, PathBuf};

/// An error of this crate. Messages have the problem, the value found, and the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum EvalError {
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io { action: &'static str, source: std::io::Error, path: PathBuf },
    /// An image has another number of values than its target or shape, is too small for a metric, or has a NaN or an
    /// infinity.
    #[error("{reason}")]
    BadImage { reason: String },
    #[error("unknown method `{name}`; write one of {names}")]
    BadMethodName { name: String, names: String },
    #[error("{reason}: {path}", path = path.display())]
    NotComparable { reason: String, path: PathBuf },
    #[error("no weights for the method `{method}`")]
    NoModel { method: String },
    #[error("no usable scene: {reason}")]
    NoScenes { reason: String },
    #[error(
        "interrupted during the evaluation, after {done} of {total} scenes; no results were written: the same command evaluates again"
    )]
    Interrupted { done: usize, total: usize },
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
    #[error(transparent)]
    Scene(#[from] clift_scene::SceneError),
}

impl EvalError {
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, source, path: path.to_path_buf() }
    }
}
