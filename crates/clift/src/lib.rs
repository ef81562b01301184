//! The command line of clift: arguments and printing, nothing else.

mod cli;
mod commands;
mod exit_code;
mod interrupt;
mod output;

use std::process::ExitCode;

use clap::Parser;

use crate::cli::{Args, Command};
use crate::commands::bench::cases::{BenchArgs, BenchCommand};
use crate::commands::data::command::DataCommand;
use crate::commands::{bench, compare, data, doctor, encode, eval, export, flops, import, plan, render, train};
use crate::exit_code::{DONE, exit_code, message};
use crate::output::stdout;

/// Runs the command line of this process and returns its exit code: 0 done, 1 failed, 2 wrong usage
/// or config, 130 (Ctrl-C), 143 (SIGTERM) or 129 (a closed terminal) interrupted after saving.
pub fn main() -> ExitCode {
    let result = match Args::parse().command {
        Command::Train(args) => train::run(&args),
        Command::Eval(args) => eval::run(&args),
        Command::Compare(args) => compare::run(&args),
        Command::Flops(args) => flops::run(&args),
        Command::Encode(args) => encode::run(&args),
        Command::Render(args) => render::run::run(&args),
        Command::Data { command: DataCommand::Synth(args) } => data::synth::run(&args),
        Command::Data { command: DataCommand::Info(args) } => data::info::run(&args),
        Command::Data { command: DataCommand::Check(args) } => data::check::run(&args),
        Command::Data { command: DataCommand::Index(args) } => data::index::run(&args),
        Command::Data { command: DataCommand::Convert(args) } => data::convert::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Doctor(args) => doctor::run::run(&args),
        Command::Bench(BenchArgs { command: Some(BenchCommand::Data(args)), .. }) => bench::data::run(&args),
        Command::Bench(BenchArgs { command: Some(BenchCommand::Half(args)), .. }) => bench::precision::run(&args),
        Command::Bench(args) => bench::cases::run(&args),
        Command::Import(args) => import::run(&args),
        Command::Export(args) => export::run(&args),
    };
    match result {
        Ok(()) => ExitCode::from(DONE),
        Err(error) => {
            stdout::print_note(&format!("error: {}", message(&error)));
            ExitCode::from(exit_code(&error))
        }
    }
}

/// Compiles the code of the README.
#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
struct Readme;
