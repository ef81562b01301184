//! What a user types.

use std::path::PathBuf;

use clap::{Parser, Subcommand};
use clift_eval::TokenCount;
use clift_model::device::DeviceName;
use clift_train::Stage;

pub use crate::data::args::DataCommand;

/// Trains, compresses, renders and measures compressive light-field tokens.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
pub struct Args {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Train both stages of a config, or go on where its run stands, and evaluate the result
    Train(TrainArgs),
    /// Measure a run on held-out views
    Eval(EvalArgs),
    /// Make data, or tell what there is
    Data {
        /// What to do with data.
        #[command(subcommand)]
        command: DataCommand,
    },
    /// Check what this machine can train on: every device, the processor, the memory
    ///
    /// Runs one forward and backward pass of a small model on every device of this build and compares its
    /// gradient with that of the default device. Exits with 1 if the default device fails, with 0 otherwise.
    Doctor,
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
}

/// Arguments of `clift eval`.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    /// A run directory
    pub run: PathBuf,
    /// Token counts to store, as numbers or shares: --storage 256,1/16
    #[arg(long, value_delimiter = ',', value_name = "COUNT")]
    pub storage: Vec<TokenCount>,
    /// An evaluation index (JSON) with the context and target frames of every scene
    #[arg(long, value_name = "FILE")]
    pub index: Option<PathBuf>,
    /// Change a key of the run's config: `--set eval.num_scenes=10`
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Where tensors live: flex, ndarray or wgpu
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Where to write; `eval` inside the run by default
    #[arg(long, short, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

fn parse_stage(text: &str) -> Result<Stage, String> {
    let stages = [Stage::Stage1, Stage::Clusters, Stage::Stage2];
    stages.into_iter().find(|stage| stage.name() == text).ok_or_else(|| "write stage1, clusters or stage2".into())
}

fn parse_overfit(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if count > 0 => Ok(count),
        _ => Err("write how many scenes, at least 1".into()),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Args::command().debug_assert();
    }

    #[test]
    fn stages_and_counts_are_checked() {
        let parse = |words: &[&str]| Args::try_parse_from(["clift"].iter().chain(words));
        assert!(parse(&["train", "a.toml", "--only", "stage2", "--overfit", "3"]).is_ok());
        assert!(parse(&["train", "a.toml", "--only", "stage3"]).is_err());
        assert!(parse(&["train", "a.toml", "--overfit", "0"]).is_err());
        assert!(parse(&["eval", "run", "--storage", "256,1/16"]).is_ok());
        assert!(parse(&["eval", "run", "--storage", "0"]).is_err());
    }
}
