//! `clift completions`.

use clap::Command;
use clap_complete::{Shell, generate};

use crate::output::stdout::print_result;

/// Prints the script of a shell for `command`, the command tree.
pub fn run(args: &CompletionsArgs, command: Command) -> anyhow::Result<()> {
    print_result(script(args.shell, command).trim_end())
}

/// Returns the script of a shell for a command tree.
pub fn script(shell: Shell, mut command: Command) -> String {
    let mut script = Vec::new();
    generate(shell, &mut command, "clift", &mut script);
    String::from_utf8_lossy(&script).into_owned()
}

/// Arguments of `clift completions`.
#[derive(Debug, clap::Args)]
pub struct CompletionsArgs {
    /// Shell that reads the script
    pub shell: Shell,
}
