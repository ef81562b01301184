//! What can go wrong between a rendering and a report, one documented variant per failure.

use std::path::{Path, PathBuf};

/// A failure of this crate. A message says what, where, expected and got, with the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvalError {
    /// A file could not be read or written.
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io {
        /// What was being done, as a verb phrase ("writing the summary").
        action: &'static str,
        /// The operating system's reason.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// Two images that are to be compared do not hold the same number of values.
    #[error("the images differ in size: expected {expected} values like the target, got {got} in the prediction")]
    SizeMismatch {
        /// Values of the target, or of the shape that was given.
        expected: usize,
        /// Values of the other image.
        got: usize,
    },
    /// An image holds a NaN or an infinity, so a metric of it means nothing.
    #[error("the {image} is not finite: value {index} is {value}")]
    NotFinite {
        /// `"prediction"` or `"target"`.
        image: &'static str,
        /// Where, counted in values.
        index: usize,
        /// The NaN or infinity.
        value: f32,
    },
    /// An image is smaller than a metric allows.
    #[error("{metric} needs at least {min} x {min} pixels, got {width} x {height}")]
    ImageTooSmall {
        /// Name of the metric.
        metric: &'static str,
        /// Smallest side, in pixels.
        min: usize,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// A file with the weights of a network that measures pictures cannot be used.
    #[error("bad weights for {what}: {reason}; `{command}` makes them: {path}", path = path.display())]
    BadWeights {
        /// What they are for.
        what: &'static str,
        /// What is wrong with them.
        reason: String,
        /// What to run.
        command: &'static str,
        /// The file.
        path: PathBuf,
    },
    /// A name that another system cannot have.
    #[error("`{name}` cannot be the name of a system: {reason}")]
    BadSystemName {
        /// What was written.
        name: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A picture of another system cannot be compared with its target.
    #[error("bad picture: {reason}: {path}", path = path.display())]
    BadPrediction {
        /// What is wrong with it.
        reason: String,
        /// The picture.
        path: PathBuf,
    },
    /// Another system's folder holds none of the pictures that are evaluated.
    #[error(
        "{name} has none of the {expected} target pictures; the first would be {first}, or the same in a folder \
         `color` of its scene: {path}",
        path = path.display()
    )]
    NoPredictions {
        /// The system.
        name: &'static str,
        /// How many there could be.
        expected: usize,
        /// The first that was looked for.
        first: String,
        /// The folder.
        path: PathBuf,
    },
    /// Two evaluations cannot be compared.
    #[error("{reason}: {path}", path = path.display())]
    NotComparable {
        /// Why not.
        reason: String,
        /// The evaluation.
        path: PathBuf,
    },
    /// A baseline was asked for a scene that has no context view.
    #[error("a baseline needs at least one context view, got none")]
    NoContext,
    /// A view was reported twice, which would count it twice in every mean.
    #[error("{view} was already measured: a view counts once")]
    DuplicateView {
        /// Scene, frame, variant and token counts.
        view: String,
    },
    /// A method was asked for without weights that render it.
    #[error("there are no weights that render the variant `{variant}`")]
    NoModel {
        /// The name of the method.
        variant: &'static str,
    },
    /// No scene can be evaluated.
    #[error("no usable scene: {reason}")]
    NoScenes {
        /// Why every scene was skipped.
        reason: String,
    },
    /// The evaluation was asked to stop.
    #[error("interrupted during the evaluation, after {done} of {total} scenes; nothing was written")]
    Interrupted {
        /// Scenes done.
        done: usize,
        /// Scenes in all.
        total: usize,
    },
    /// Scenes could not be read.
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    /// The model refused its input or its weights.
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
    /// A tensor could not be read back from its device.
    #[error("reading a rendering from its device failed: {reason}")]
    Tensor {
        /// The device's reason.
        reason: String,
    },
}

impl EvalError {
    /// Wraps an operating-system error; for `map_err`.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, source, path: path.to_path_buf() }
    }

    /// Wraps a device's error; for `map_err`.
    pub(crate) fn tensor(reason: impl std::fmt::Debug) -> Self {
        Self::Tensor { reason: format!("{reason:?}") }
    }
}
