//! `clift completions`.

use clap::CommandFactory;
use clap_complete::{Shell, generate};

use crate::cli::Args;
use crate::output::stdout::print_result;

/// Prints the script of a shell.
pub fn run(args: &CompletionsArgs) -> anyhow::Result<()> {
    print_result(script(args.shell).trim_end())
}

fn script(shell: Shell) -> String {
    let mut script = Vec::new();
    generate(shell, &mut Args::command(), "clift", &mut script);
    String::from_utf8_lossy(&script).into_owned()
}

/// Arguments of `clift completions`.
#[derive(Debug, clap::Args)]
pub struct CompletionsArgs {
    /// Shell that reads the script
    pub shell: Shell,
}

#[cfg(test)]
mod tests {
    use clap::ValueEnum;

    use super::*;

    #[test]
    fn scripts_of_all_shells_know_the_commands() {
        for shell in Shell::value_variants() {
            let script = script(*shell);
            assert!(["encode", "convert", "storage"].iter().all(|word| script.contains(word)), "{shell}");
        }
    }
}
