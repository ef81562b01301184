//! `clift train`.

use std::path::PathBuf;

use clift_eval::available_bytes;
use clift_model::DeviceName;
use clift_train::{Config, Run, RunOptions, Stage, memory_warning, read_checked_config};

use crate::commands::parse::{parse_overfit, parse_stage};
use crate::output::{progress, stdout};

/// Trains what the config says and prints the evaluation.
pub fn run(args: &TrainArgs) -> anyhow::Result<()> {
    let (mut config, overrides) = read_checked_config(&args.config, &args.set, Config::validate)?;
    for change in overrides {
        stdout::print_note(&change.to_string());
    }
    config.device = args.device.unwrap_or(config.device);
    // Now, and not when the system ends the run after hours of other work.
    if let Ok(Some(warning)) = memory_warning(&config, available_bytes(config.device)) {
        stdout::print_note(&format!("warning: {warning}"));
    }

    let stop = crate::interrupt::flag()?;
    let options = RunOptions { only: args.only, overfit: args.overfit, fresh: args.fresh, extend: args.extend };
    let mut sink = progress::sink();
    let folder = config.run_dir.clone();
    let run = Run::open(config, &options, sink.as_mut())?;
    let summary = run.train(args.only, &stop, sink.as_mut())?;
    drop(sink);
    if let Some(summary) = summary {
        stdout::print_evaluation(&summary, &folder.join("eval"))?;
    }
    Ok(())
}

/// Arguments of `clift train`.
#[derive(Debug, clap::Args)]
pub struct TrainArgs {
    /// The experiment, a TOML file
    pub config: PathBuf,
    /// Change a key of the config: --set stage1.steps=100 --set 'data.root="/data/re10k"'
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Where tensors live: flex, ndarray or wgpu
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Do one stage alone: stage1, clusters or stage2
    #[arg(long, value_name = "STAGE", value_parser = parse_stage)]
    pub only: Option<Stage>,
    /// Train and evaluate on the first K training scenes
    #[arg(long, value_name = "K", value_parser = parse_overfit)]
    pub overfit: Option<usize>,
    /// Start over: move an existing run aside first
    #[arg(long)]
    pub fresh: bool,
    /// Train on for more steps than the run was started with, on the learning rates of the new count
    #[arg(long, conflicts_with = "fresh")]
    pub extend: bool,
}
