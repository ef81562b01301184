//! Errors of sweeps, comparisons and reports.

use std::path::{Path, PathBuf};

/// An error of this crate. Messages have the problem, the value found, and the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvalError {
    /// A file could not be read or written.
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io {
        /// The failed action as a verb phrase, such as "writing the summary".
        action: &'static str,
        /// Error of the operating system.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// An image has another number of values than its target or shape, is too small for a metric, or has a NaN or an
    /// infinity.
    #[error("{reason}")]
    BadImage {
        /// The problem.
        reason: String,
    },
    /// The name of an external method is not allowed.
    #[error("bad method name `{name}`: {reason}")]
    BadMethodName {
        /// The name.
        name: String,
        /// The problem.
        reason: String,
    },
    /// An image of an external method is not comparable with its target.
    #[error("bad image: {reason}: {path}", path = path.display())]
    BadPrediction {
        /// The problem.
        reason: String,
        /// The image.
        path: PathBuf,
    },
    /// The folder of an external method has none of the evaluated target images.
    #[error(
        "{name} has none of the {expected} target images, such as {first}, also not in a folder `color` of the scene: \
         {path}",
        path = path.display()
    )]
    NoPredictions {
        /// Name of the method.
        name: String,
        /// Number of target images.
        expected: usize,
        /// Path of the first target image in the folder.
        first: String,
        /// The folder.
        path: PathBuf,
    },
    /// Two evaluations are not comparable.
    #[error("{reason}: {path}", path = path.display())]
    NotComparable {
        /// The problem.
        reason: String,
        /// The evaluation.
        path: PathBuf,
    },
    /// No model renders a method.
    #[error("no weights for the method `{method}`")]
    NoModel {
        /// Name of the method.
        method: String,
    },
    /// No scene is left to evaluate.
    #[error("no usable scene: {reason}")]
    NoScenes {
        /// Reasons of the skipped scenes.
        reason: String,
    },
    /// The caller stopped the evaluation.
    #[error(
        "interrupted during the evaluation, after {done} of {total} scenes; no results were written: the same command evaluates again"
    )]
    Interrupted {
        /// Evaluated scenes.
        done: usize,
        /// All scenes of the evaluation.
        total: usize,
    },
    /// Another process that shares the evaluation has failed.
    #[error("{reason}")]
    OtherProcess {
        /// Its error.
        reason: String,
    },
    /// Scenes could not be read.
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    /// The model refused its input or its weights.
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
    /// A baseline or a scene file could not be made.
    #[error(transparent)]
    Scene(#[from] clift_scene::SceneError),
    /// A tensor could not be read back from its device.
    #[error("reading a tensor from its device failed: {reason}")]
    Tensor {
        /// Error of the device.
        reason: String,
    },
}

impl EvalError {
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, source, path: path.to_path_buf() }
    }

    pub(crate) fn size_mismatch(expected: usize, got: usize) -> Self {
        Self::BadImage { reason: format!("image sizes differ: expected {expected} values, got {got}") }
    }

    pub(crate) fn tensor(reason: impl std::fmt::Debug) -> Self {
        Self::Tensor { reason: format!("{reason:?}") }
    }
}
