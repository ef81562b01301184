//! `clift train`.

use clift_train::footprint::machine::available_bytes;
use clift_train::footprint::memory::memory_warning;
use clift_train::{Config, Run, RunOptions, read_checked_config};

use crate::args::TrainArgs;
use crate::terminal;

/// Trains what the config says and prints the evaluation.
pub fn run(args: &TrainArgs) -> anyhow::Result<()> {
    let (mut config, overrides) = read_checked_config(&args.config, &args.set, Config::validate)?;
    for change in overrides {
        terminal::print_note(&change.to_string());
    }
    config.device = args.device.unwrap_or(config.device);
    // Now, and not when the system ends the run after hours of other work.
    if let Ok(Some(warning)) = memory_warning(&config, available_bytes(config.device)) {
        terminal::print_note(&format!("warning: {warning}"));
    }

    let stop = crate::interrupt::flag()?;
    let options = RunOptions { only: args.only, overfit: args.overfit, fresh: args.fresh, extend: args.extend };
    let mut sink = terminal::sink();
    let folder = config.run_dir.clone();
    let run = Run::open(config, &options, sink.as_mut())?;
    let summary = run.train(args.only, &stop, sink.as_mut())?;
    drop(sink);
    if let Some(summary) = summary {
        terminal::print_evaluation(&summary, &folder.join("eval"))?;
    }
    Ok(())
}
