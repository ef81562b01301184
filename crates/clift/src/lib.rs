//! The command line of clift: parses the arguments, calls the library crates, prints results and returns the exit code.
//!
//! The binary has one line:
//!
//! ```no_run
//! fn main() -> std::process::ExitCode {
//!     clift::main()
//! }
//! ```

mod cli;
mod commands;
mod exit_code;
mod interrupt;
mod output;
#[cfg(test)]
mod reference_pages;
mod threads;
mod verbosity;

use std::process::ExitCode;

use clap::Parser;
use clift_eval::keep_freed_memory;
use clift_train::Launched;

use crate::cli::{Args, Command};
use crate::commands::data::command::DataCommand;
use crate::commands::{
    bench, codec, compare, data, doctor, encode, eval, export, flops, import, metrics, plan, render, train, view,
};
use crate::exit_code::{DONE, error_message, exit_code};
use crate::output::stdout;
use crate::verbosity::Verbosity;

/// Runs the command line of this process and returns the exit code: 0 done, 1 failed, 2 invalid command line, config or
/// model, 129 (closed terminal), 130 (Ctrl-C) or 143 (SIGTERM) interrupted.
pub fn main() -> ExitCode {
    quiet_mesa();
    let args = Args::parse();
    if args.quiet {
        Verbosity::Quiet.choose();
    }
    keep_freed_memory();
    threads::flush_subnormals(|| run(args))
}

/// Turns off a Vulkan layer of Mesa where no desktop runs. It only reorders adapters, and asks Wayland for the one in use, which
/// prints `error: XDG_RUNTIME_DIR is invalid or not set` several times.
fn quiet_mesa() {
    if cfg!(target_os = "linux") && std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // SAFETY: no other thread runs yet.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}

fn run(args: Args) -> ExitCode {
    if Launched::find().num_ranks == 1 {
        threads::start(None);
    }
    let result = match args.command {
        Command::Train(args) => train::run(&args),
        Command::Eval(args) => eval::run(&args),
        Command::Compare(args) => compare::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Flops(args) => flops::run(&args),
        Command::Codec(args) => codec::run(&args),
        Command::Encode(args) => encode::run(&args),
        Command::Render(args) => render::run(&args),
        Command::View(args) => view::run(&args),
        Command::Data { command: DataCommand::Synth(args) } => data::synth::run(&args),
        Command::Data { command: DataCommand::Poses(args) } => data::poses::run(&args),
        Command::Data { command: DataCommand::Info(args) } => data::info::run(&args),
        Command::Data { command: DataCommand::Check(args) } => data::check::run(&args),
        Command::Data { command: DataCommand::Index(args) } => data::index::run(&args),
        Command::Metrics(args) => metrics::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Doctor(args) => doctor::run::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::Import(args) => import::run(&args),
    };
    match result {
        Ok(()) => ExitCode::from(DONE),
        Err(error) => {
            stdout::print_problem(&format!("error: {}", error_message(&error)));
            ExitCode::from(exit_code(&error))
        }
    }
}

/// Compiles the code of the README.
#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
struct Readme;
