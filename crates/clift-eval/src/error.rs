//! Errors of sweeps, comparisons and reports.

use std::path::{Path, PathBuf};

/// An error of this crate. Messages have the problem, the value found, and the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum EvalError {
    /// A file could not be read or written.
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io { action: &'static str, source: std::io::Error, path: PathBuf },
    /// An image has another number of values than its target or shape, is too small for a metric, or has a NaN or an
    /// infinity.
    #[error("{reason}")]
    BadImage { reason: String },
    /// The name of an external method is not allowed.
    #[error("bad method name `{name}`: {reason}")]
    BadMethodName { name: String, reason: String },
    /// An image of an external method is not comparable with its target.
    #[error("bad image: {reason}: {path}", path = path.display())]
    BadPrediction { reason: String, path: PathBuf },
    /// The folder of an external method has none of the evaluated target images.
    #[error(
        "{name} has none of the {expected} target images, such as {first}, also not in a folder `color` of the scene: \
         {path}",
        path = path.display()
    )]
    NoPredictions { name: String, expected: usize, first: String, path: PathBuf },
    /// Two evaluations are not comparable.
    #[error("{reason}: {path}", path = path.display())]
    NotComparable { reason: String, path: PathBuf },
    /// No model renders a method.
    #[error("no weights for the method `{method}`")]
    NoModel { method: String },
    /// No scene is left to evaluate.
    #[error("no usable scene: {reason}")]
    NoScenes { reason: String },
    /// The caller stopped the evaluation.
    #[error(
        "interrupted during the evaluation, after {done} of {total} scenes; no results were written: the same command evaluates again"
    )]
    Interrupted { done: usize, total: usize },
    /// Another process that shares the evaluation has failed.
    #[error("{reason}")]
    OtherProcess { reason: String },
    /// Scenes could not be read.
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    /// The model refused its input or its weights.
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
    /// A baseline or a scene file could not be made.
    #[error(transparent)]
    Scene(#[from] clift_scene::SceneError),
}

impl EvalError {
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, source, path: path.to_path_buf() }
    }

    pub(crate) fn size_mismatch(expected: usize, got: usize) -> Self {
        Self::BadImage { reason: format!("image sizes differ: expected {expected} values, got {got}") }
    }
}
