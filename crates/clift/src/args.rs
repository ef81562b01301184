//! What a user types.

use std::path::PathBuf;

use clap::{Parser, Subcommand};
use clift_eval::{Experiment, Selection, TokenCount};
use clift_model::TokenStorage;
use clift_model::device::DeviceName;
use clift_train::Stage;
use clift_train::bench::Work;

pub use crate::data::args::DataCommand;
pub use crate::data::bench::BenchDataArgs;
pub use crate::encode::EncodeArgs;
pub use crate::render::RenderArgs;

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
    /// Compress a posed capture into a scene file
    ///
    /// Chooses context views along the camera's path, encodes them, and keeps as many tokens as asked for. The file
    /// holds everything but the weights.
    #[command(after_help = "\
Examples:
  clift encode runs/tiny --scene synthetic-0-test-00000 -o room.clift
  clift encode runs/re10k captures/attic -o attic.clift
  clift encode runs/re10k /data/re10k --scene 5aca87f95a9412c6 --storage 1/8 -o room.clift
  clift encode runs/re10k /data/re10k/test --max-error 0.02 --tokens int8 -o room.clift")]
    Encode(EncodeArgs),
    /// Draw a scene file along a camera path
    ///
    /// Writes frame-00000.png and so on, animation.png (an animated PNG, which browsers play) and render.json (what was
    /// drawn from how many tokens, and how long it took) to a new folder.
    #[command(after_help = "\
Paths:
  interpolate   through the context views
  orbit         once around, looking at what the context views look at
  FILE.json     {\"poses\": [{\"c2w\": [[4 numbers] x 3]}, ..]}: camera to world,
                OpenCV axes, in the world of the capture; a pose may have
                \"intrinsics_norm\": [fx, fy, cx, cy], over width and height

Examples:
  clift render room.clift --path interpolate -o out
  clift render room.clift --path orbit --size 512x512 --frames 120 -o out
  clift render room.clift --path poses.json --render 256 --selection global -o out
  clift render room.clift --path orbit --budget-ms 30 -o out")]
    Render(RenderArgs),
    /// Make data, or tell what there is
    Data {
        /// What to do with data.
        #[command(subcommand)]
        command: DataCommand,
    },
    /// Tell what a run takes before it starts: parameters, memory, time per step
    ///
    /// Of both stages, the cluster cache and the evaluation. Parameters are counted exactly and memory from what the
    /// operations keep; times come from one block of each kind, timed on the device at the config's sizes. Where the
    /// data is there, a few scenes of it are read for the time that takes.
    Plan(PlanArgs),
    /// Check what this machine can train on: every device, the processor, the memory
    ///
    /// Runs one forward and backward pass of a small model on every device of this build and compares its
    /// gradient with that of the default device. Exits with 1 if the default device fails, with 0 otherwise.
    ///
    /// With --stability it instead runs the hard cases (zero baselines, extreme logits, one cluster for all, ..) on every
    /// device of the build, each against the same computation in f64, and exits with 1 if one is beyond its bound.
    Doctor(DoctorArgs),
    /// Time the parts of the method on a device, each with its error against f64
    ///
    /// Inputs and weights are drawn from the config's seed: no data is needed. A row is one part of the method at the
    /// config's sizes, with the fewest context views it allows; `encode` to `render_8_views` are of one scene,
    /// the steps of the config's batch. The table has the median and the 95th percentile of the repetitions, the peak
    /// memory of the process during them and the largest relative error of the result against the same
    /// computation in f64.
    Bench(BenchArgs),
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

/// Arguments of `clift eval`.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    /// A run directory
    pub run: PathBuf,
    /// An experiment of the paper: main, ablation, patchwise or budget
    ///
    /// Sets variants, --storage, --render and --selection; those given beside it win. main: quality against data size.
    /// ablation: random tokens, K-means, K-means and condenser. patchwise: tiles of the views against K-means, each
    /// with and without condenser; needs --with. budget: half of the tokens stored, fewer and fewer of them rendered.
    #[arg(long, value_name = "NAME")]
    pub preset: Option<Experiment>,
    /// Another run of the same stage 1 with another clusters.grouping, measured on the same views
    #[arg(long, value_name = "RUN")]
    pub with: Option<PathBuf>,
    /// Token counts to store, as numbers or shares: --storage 256,1/16
    #[arg(long, value_delimiter = ',', value_name = "COUNT")]
    pub storage: Vec<TokenCount>,
    /// Draw views from fewer tokens than are stored too, numbers or shares of those: --render 128,1/2
    #[arg(long, value_delimiter = ',', value_name = "COUNT")]
    pub render: Vec<TokenCount>,
    /// How those are chosen: paper, global, scaled or random
    #[arg(long, alias = "select", value_name = "PRESET")]
    pub selection: Option<Selection>,
    /// Round stored tokens as a scene file would: f32, f16 or int8
    #[arg(long, value_name = "FORMAT")]
    pub tokens: Option<TokenStorage>,
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

/// Arguments of `clift doctor`.
#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Run the hard cases instead
    #[arg(long)]
    pub stability: bool,
    /// At the sizes of the tests: seconds instead of minutes
    #[arg(long, requires = "stability")]
    pub small: bool,
    /// Write their table as Markdown
    #[arg(long, requires = "stability", value_name = "FILE")]
    pub markdown: Option<PathBuf>,
}

/// Arguments of `clift plan`.
#[derive(Debug, clap::Args)]
pub struct PlanArgs {
    /// The experiment, a TOML file
    pub config: PathBuf,
    /// Change a key of the config: `--set stage1.accumulate=4`
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Where tensors live: flex, ndarray or wgpu
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Leave out the times, which take some seconds to find
    #[arg(long)]
    pub no_time: bool,
    /// Write the plan as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// What is timed instead of the parts of the method.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Time how fast clips are read from a folder, in order and at random
    Data(BenchDataArgs),
}

/// Arguments of `clift bench`.
#[derive(Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct BenchArgs {
    /// Something else to time.
    #[command(subcommand)]
    pub command: Option<BenchCommand>,
    /// The experiment whose sizes are used, a TOML file
    #[arg(required = true)]
    pub config: Option<PathBuf>,
    /// The rows; all of them by default
    #[arg(long, value_delimiter = ',', value_name = "WORK", help = works_help())]
    pub work: Vec<Work>,
    /// Repetitions that count
    #[arg(long, value_name = "COUNT", default_value = "5", value_parser = parse_repeats)]
    pub repeats: usize,
    /// Repetitions before them that do not
    #[arg(long, value_name = "COUNT", default_value = "1")]
    pub warmup: usize,
    /// Leave out the comparison with f64
    #[arg(long)]
    pub no_error: bool,
    /// Where tensors live: flex, ndarray or wgpu
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Change a key of the config: `--set stage1.batch_size=1`
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Tokens that are stored, as a number or a share: clusters of K-means, condenser and stage 2
    #[arg(long, value_name = "COUNT", default_value = "1/4")]
    pub storage: TokenCount,
    /// Let K-means cluster the tensor `features`, [N, D] in f32, of a safetensors file
    #[arg(long, value_name = "FILE")]
    pub features: Option<PathBuf>,
    /// Write the figures, with every repetition, as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
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

fn works_help() -> String {
    format!("Time these works alone: {}", Work::ALL.map(Work::name).join(", "))
}

fn parse_repeats(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if count > 0 => Ok(count),
        _ => Err("write how often, at least 1".into()),
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
        assert!(parse(&["eval", "run", "--render", "16,1/2", "--selection", "random"]).is_ok());
        assert!(parse(&["eval", "run", "--selection", "nearest"]).is_err());
    }

    #[test]
    fn works_are_named_and_repeated_at_least_once() {
        let parse = |words: &[&str]| Args::try_parse_from(["clift", "bench", "a.toml"].iter().chain(words));
        let Ok(Args { command: Command::Bench(args) }) = parse(&["--work", "encode,stage1_step_tiny"]) else {
            panic!("valid arguments");
        };
        assert_eq!(args.work, [Work::Encode, Work::Stage1StepTiny]);
        assert_eq!((args.repeats, args.warmup, args.storage), (5, 1, TokenCount::Share(0.25)));
        let message = parse(&["--work", "incode"]).unwrap_err().to_string();
        assert!(message.contains("'incode'") && message.contains("the works are encode, kmeans"), "{message}");
        assert!(parse(&["--repeats", "0"]).is_err());
    }
}
