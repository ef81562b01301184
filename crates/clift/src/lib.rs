//! The command line of clift: arguments and printing, nothing else.

mod args;
mod eval;
pub mod terminal;
mod train;

use std::process::ExitCode;

use clap::Parser;
use clift_train::TrainError;

use args::{Args, Command};

/// Done.
const DONE: u8 = 0;
/// Something failed.
const FAILED: u8 = 1;
/// The command line or the config is wrong.
const WRONG_USAGE: u8 = 2;
/// Interrupted after saving: 128 + SIGINT.
const INTERRUPTED: u8 = 130;

/// Runs the command line of this process and returns its exit code: 0 done, 1 failed, 2 wrong usage
/// or config, 130 interrupted after saving.
pub fn main() -> ExitCode {
    let result = match Args::parse().command {
        Command::Train(args) => train::run(&args),
        Command::Eval(args) => eval::run(&args),
    };
    match result {
        Ok(()) => ExitCode::from(DONE),
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(exit_code(&error))
        }
    }
}

fn exit_code(error: &anyhow::Error) -> u8 {
    match error.downcast_ref::<TrainError>() {
        Some(TrainError::Interrupted { .. }) => return INTERRUPTED,
        Some(TrainError::BadConfig { .. } | TrainError::OtherRun { .. } | TrainError::Missing { .. }) => {
            return WRONG_USAGE;
        }
        Some(TrainError::Model(error)) => return model_exit_code(error),
        Some(_) => return FAILED,
        None => {}
    }
    if error.is::<clift_train::ConfigError>() { WRONG_USAGE } else { FAILED }
}

fn model_exit_code(error: &clift_model::ModelError) -> u8 {
    use clift_model::ModelError::{BadConfig, NoDevice, NotDivisible};
    if matches!(error, BadConfig { .. } | NoDevice { .. } | NotDivisible { .. }) { WRONG_USAGE } else { FAILED }
}
