//! The command line of clift: arguments and printing, nothing else.

pub mod terminal;

use std::process::ExitCode;

/// Runs the command line of this process and returns its exit code.
pub fn main() -> ExitCode {
    ExitCode::SUCCESS
}
