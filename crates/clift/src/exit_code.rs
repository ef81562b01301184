//! Error messages and exit codes.

use std::error::Error;

use clift_core::BadConfig;
use clift_data::DataError;
use clift_eval::EvalError;
use clift_model::ModelError;
use clift_scene::SceneError;
use clift_train::{ConfigError, TrainError};
use clift_view::ViewError;

use crate::interrupt;

pub(crate) const DONE: u8 = 0;
pub(crate) const FAILED: u8 = 1;
/// The command line, the config or the model is invalid.
pub(crate) const USAGE: u8 = 2;

/// Formats an error with its causes. Causes that the text already contains are omitted.
pub(crate) fn error_message(error: &anyhow::Error) -> String {
    error
        .chain()
        .skip(1)
        .map(ToString::to_string)
        .fold(error.to_string(), |text, cause| if text.contains(&cause) { text } else { format!("{text}: {cause}") })
}

/// An invalid combination of arguments.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct UsageError(pub(crate) String);

/// A signal ended a command that continues where it was.
#[derive(Debug, thiserror::Error)]
#[error("interrupted; the same command continues")]
pub(crate) struct Interrupted;

/// Returns a [`UsageError`] with a formatted message from the function.
macro_rules! usage_bail {
    ($($message:tt)*) => {
        return Err($crate::exit_code::UsageError(format!($($message)*)).into())
    };
}
pub(crate) use usage_bail;

pub(crate) fn exit_code(error: &anyhow::Error) -> u8 {
    error.chain().find_map(code_of).unwrap_or(FAILED)
}

/// Returns the exit code of an error, or of the one that it passes on; `None` for an error of another library.
fn code_of(error: &(dyn Error + 'static)) -> Option<u8> {
    let code = if error.is::<UsageError>() || error.is::<ConfigError>() || error.is::<BadConfig>() {
        USAGE
    } else if error.is::<Interrupted>() {
        interrupt::exit_code()
    } else if let Some(error) = error.downcast_ref::<TrainError>() {
        match error {
            TrainError::Interrupted { .. } | TrainError::Abandoned { .. } => interrupt::exit_code(),
            TrainError::BadConfig(_)
            | TrainError::OtherRun { .. }
            | TrainError::Missing { .. }
            | TrainError::NoMpi { .. } => USAGE,
            TrainError::Eval(error) => code_of(error)?,
            TrainError::Scene(error) => code_of(error)?,
            TrainError::Data(error) => code_of(error)?,
            TrainError::Model(error) => code_of(error)?,
            TrainError::Stopped { source, .. } | TrainError::Damaged { source, .. } => code_of(source.as_ref())?,
            _ => FAILED,
        }
    } else if let Some(error) = error.downcast_ref::<EvalError>() {
        match error {
            EvalError::Interrupted { .. } => interrupt::exit_code(),
            EvalError::BadMethodName { .. } | EvalError::NotComparable { .. } => USAGE,
            EvalError::Data(error) => code_of(error)?,
            EvalError::Model(error) => code_of(error)?,
            EvalError::Scene(error) => code_of(error)?,
            _ => FAILED,
        }
    } else if let Some(error) = error.downcast_ref::<SceneError>() {
        match error {
            SceneError::BadRequest { .. } => USAGE,
            SceneError::Interrupted { .. } => interrupt::exit_code(),
            SceneError::Data(error) => code_of(error)?,
            SceneError::Model(error) => code_of(error)?,
            _ => FAILED,
        }
    } else if let Some(error) = error.downcast_ref::<ViewError>() {
        match error {
            ViewError::Bind { .. } => USAGE,
            ViewError::Data(error) => code_of(error)?,
            ViewError::Eval(error) => code_of(error)?,
            ViewError::Scene(error) => code_of(error)?,
            ViewError::Model(error) => code_of(error)?,
            _ => FAILED,
        }
    } else if let Some(error) = error.downcast_ref::<DataError>() {
        match error {
            DataError::BadConfig(_) | DataError::BadOutput { .. } | DataError::UnknownLayout { .. } => USAGE,
            _ => FAILED,
        }
    } else if let Some(error) = error.downcast_ref::<ModelError>() {
        match error {
            ModelError::BadConfig { .. }
            | ModelError::BadTokenCount { .. }
            | ModelError::BadWeights { .. }
            | ModelError::NoCodec { .. }
            | ModelError::NoConfig { .. }
            | ModelError::NoDevice { .. }
            | ModelError::TensorTooLarge { .. }
            | ModelError::NoModel { .. }
            | ModelError::NotDivisible { .. }
            | ModelError::NotImported { .. }
            | ModelError::OtherRenderer { .. } => USAGE,
            _ => FAILED,
        }
    } else {
        return None;
    };
    Some(code)
}
