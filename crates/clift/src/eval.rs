//! `clift eval`.

use clift_train::{Config, Run, read_config};

use crate::args::EvalArgs;
use crate::terminal;

/// Evaluates a run and prints the table.
pub fn run(args: &EvalArgs) -> anyhow::Result<()> {
    let (mut config, overrides) = read_config::<Config>(&args.run.join("config.toml"), &args.set)?;
    for change in overrides {
        terminal::print_note(&format!("--set {change}"));
    }
    // A run may have been moved since it was trained.
    config.run_dir.clone_from(&args.run);
    config.device = args.device.unwrap_or(config.device);
    if let Some(experiment) = args.preset {
        experiment.apply(&mut config.eval);
    }
    if !args.storage.is_empty() {
        config.eval.storage.clone_from(&args.storage);
    }
    if !args.render.is_empty() {
        config.eval.render.clone_from(&args.render);
    }
    config.eval.selection = args.selection.unwrap_or(config.eval.selection);
    config.eval.tokens = args.tokens.unwrap_or(config.eval.tokens);
    if args.index.is_some() {
        config.eval.index.clone_from(&args.index);
    }
    let folder = args.out.clone().unwrap_or_else(|| args.run.join("eval"));
    let beside = args.with.as_ref().map(|run| -> anyhow::Result<Config> {
        let (mut other, _) = read_config::<Config>(&run.join("config.toml"), &[])?;
        other.run_dir.clone_from(run);
        Ok(other)
    });
    let beside = beside.transpose()?;
    let mut sink = terminal::sink();
    let stop = crate::interrupt::flag()?;
    let summary = Run::reopen(config)?.evaluate(&folder, beside.as_ref(), &stop, sink.as_mut())?;
    drop(sink);
    terminal::print_evaluation(&summary, &folder)
}
