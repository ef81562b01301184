//! Error messages and exit codes.

use clift_core::BadConfig;
use clift_data::DataError;
use clift_eval::EvalError;
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
    if error.is::<UsageError>() || error.is::<ConfigError>() || error.is::<BadConfig>() {
        return USAGE;
    }
    if error.is::<Interrupted>() {
        return interrupt::exit_code();
    }
    if let Some(error) = error.downcast_ref::<DataError>() {
        return data_exit_code(error);
    }
    if let Some(error) = error.downcast_ref::<clift_model::ModelError>() {
        return model_exit_code(error);
    }
    if let Some(error) = error.downcast_ref::<EvalError>() {
        return eval_exit_code(error);
    }
    if let Some(error) = error.downcast_ref::<SceneError>() {
        return scene_exit_code(error);
    }
    if let Some(error) = error.downcast_ref::<ViewError>() {
        return view_exit_code(error);
    }
    error.downcast_ref::<TrainError>().map_or(FAILED, train_exit_code)
}

fn train_exit_code(error: &TrainError) -> u8 {
    match error {
        TrainError::Interrupted { .. } | TrainError::Abandoned { .. } => interrupt::exit_code(),
        TrainError::BadConfig(_)
        | TrainError::OtherRun { .. }
        | TrainError::Missing { .. }
        | TrainError::NoMpi { .. } => USAGE,
        TrainError::Eval(error) => eval_exit_code(error),
        TrainError::Scene(error) => scene_exit_code(error),
        TrainError::Data(error) => data_exit_code(error),
        TrainError::Model(error) => model_exit_code(error),
        TrainError::Stopped { source, .. } | TrainError::Damaged { source, .. } => train_exit_code(source),
        _ => FAILED,
    }
}

fn data_exit_code(error: &DataError) -> u8 {
    if matches!(error, DataError::BadConfig(_) | DataError::BadOutput { .. } | DataError::UnknownLayout { .. }) {
        USAGE
    } else {
        FAILED
    }
}

fn eval_exit_code(error: &EvalError) -> u8 {
    use EvalError::{BadMethodName, Interrupted, NoPredictions, NotComparable};
    match error {
        Interrupted { .. } => interrupt::exit_code(),
        BadMethodName { .. } | NoPredictions { .. } | NotComparable { .. } => USAGE,
        EvalError::Data(error) => data_exit_code(error),
        EvalError::Model(error) => model_exit_code(error),
        EvalError::Scene(error) => scene_exit_code(error),
        _ => FAILED,
    }
}

fn scene_exit_code(error: &SceneError) -> u8 {
    match error {
        SceneError::BadRequest { .. } => USAGE,
        SceneError::Interrupted { .. } => interrupt::exit_code(),
        SceneError::Data(error) => data_exit_code(error),
        SceneError::Model(error) => model_exit_code(error),
        _ => FAILED,
    }
}

fn view_exit_code(error: &ViewError) -> u8 {
    match error {
        ViewError::Bind { .. } => USAGE,
        ViewError::Data(error) => data_exit_code(error),
        ViewError::Eval(error) => eval_exit_code(error),
        ViewError::Scene(error) => scene_exit_code(error),
        ViewError::Model(error) => model_exit_code(error),
        _ => FAILED,
    }
}

fn model_exit_code(error: &clift_model::ModelError) -> u8 {
    use clift_model::ModelError::{
        BadConfig, BadTokenCount, BadWeights, NoCodec, NoConfig, NoDevice, NoModel, NotDivisible, NotImported,
        OtherRenderer,
    };
    match error {
        BadConfig { .. }
        | BadTokenCount { .. }
        | BadWeights { .. }
        | NoCodec { .. }
        | NoConfig { .. }
        | NoDevice { .. }
        | NoModel { .. }
        | NotDivisible { .. }
        | NotImported { .. }
        | OtherRenderer { .. } => USAGE,
        _ => FAILED,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cause_is_printed_once() {
        let missing = clift_train::read_config::<clift_train::Config>("no.toml".as_ref(), &[]).unwrap_err();
        let text = error_message(&anyhow::Error::from(missing).context("starting"));
        assert!(text.starts_with("starting: reading the configuration failed: "), "{text}");
        assert_eq!(text.matches("os error").count(), 1, "{text}");
    }

    #[test]
    fn user_errors_and_failures_have_distinct_codes() {
        let bad_config = || clift_data::SyntheticConfig { num_frames: 0, ..Default::default() }.validate();
        assert_eq!(exit_code(&UsageError("no".into()).into()), USAGE);
        assert_eq!(exit_code(&bad_config().unwrap_err().into()), USAGE);
        assert_eq!(exit_code(&TrainError::from(bad_config().unwrap_err()).into()), USAGE);
        let stopped = |source| TrainError::Stopped { source, stage: "stage1", step: 3, checkpoint: "none".into() };
        assert_eq!(exit_code(&stopped(Box::new(bad_config().unwrap_err().into())).into()), USAGE);
        assert_eq!(exit_code(&TrainError::Interrupted { step: 3 }.into()), 130);
        assert_eq!(exit_code(&TrainError::Abandoned { task: "timing `encode`".into() }.into()), 130);
        assert_eq!(exit_code(&DataError::NoSuchScene { scene: 1, num_scenes: 1 }.into()), FAILED);
        assert_eq!(exit_code(&anyhow::anyhow!("anything else")), FAILED);
    }
}
