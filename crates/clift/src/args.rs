//! What a user types.

use std::path::PathBuf;

use clap::{Parser, Subcommand};
use clift_eval::compare::Side;
use clift_eval::{Experiment, Selection};
use clift_model::device::DeviceName;
use clift_model::{Convention, TokenCount, TokenStorage};
use clift_train::Stage;
use clift_train::bench::Work;

pub use crate::bench::half::BenchHalfArgs;
pub use crate::data::args::DataCommand;
pub use crate::data::bench::BenchDataArgs;
pub use crate::encode::EncodeArgs;
pub use crate::export::ExportArgs;
pub use crate::import::ImportArgs;
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
    /// Measure a run on held-out views, and other systems' pictures of the same views
    #[command(after_help = "\
Other systems:
  DIR holds <scene key>/<target frame, six digits>.png, or <scene key>/color/..,
  as pixelSplat writes them; what is no letter, digit, - _ or . in a key is _.

Examples:
  clift eval runs/tiny --storage 8,1/4,1.0 --tokens f32,f16,int8
  clift eval runs/re10k --index INDEX.json --set 'eval.lpips_weights=\"lpips-vgg.safetensors\"'
  clift eval runs/re10k --index INDEX.json --predictions out/mvsplat --name MVSplat --data-size 12MB")]
    Eval(EvalArgs),
    /// Compare two evaluations view by view: mean differences of scenes with a confidence interval
    ///
    /// Takes run directories, folders of `clift eval --out`, or `views.csv` files. Every setting that both have is
    /// compared over the target views that both have; views of one alone are left out and counted. Differences are
    /// second minus first, averaged over the views of a scene and then over scenes; the interval is 95 % of Student's t.
    #[command(after_help = "\
Examples:
  clift compare runs/a runs/b
  clift compare runs/a runs/a --variants kmeans,clift
  clift compare runs/a runs/a --variants clift:f32,clift:int8")]
    Compare(CompareArgs),
    /// Count the work of drawing a view, of encoding and of condensing a scene
    ///
    /// By the sizes of a config, or of the paper's network with four context views of 256 x 256. `paper` counts as the
    /// paper's table comes out: a multiply-accumulate of a linear layer is one, attention is left out, five for each
    /// value a norm normalises. `macs` counts every multiply-accumulate, `flops` twice as many.
    Flops(FlopsArgs),
    /// Compress a posed capture into a scene file
    ///
    /// Chooses context views along the camera's path, encodes them, and keeps as many tokens as asked for. The file
    /// holds everything but the weights.
    #[command(after_help = "\
Examples:
  clift encode runs/tiny --scene synthetic-0-test-00000 -o room.clift
  clift encode runs/re10k captures/attic -o attic.clift
  clift encode runs/re10k /data/re10k --scene 5aca87f95a9412c6 --storage 1/8 -o room.clift
  clift encode runs/re10k /data/re10k/test --storage 256 --tokens int8 -o room.clift")]
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
    /// Read a published PyTorch checkpoint into a model directory
    ///
    /// The file is read, never run: what stands beside the weights is passed over. Every parameter must be there, every
    /// key of the network must be used, or nothing is written. The directory holds model.safetensors, config.toml (the
    /// network's sizes, and the protocol it is evaluated under) and import.json (what came from where).
    #[command(after_help = "\
Examples:
  clift import last.ckpt --variant released-re10k -o models/re10k
  clift eval --checkpoint models/re10k --data /data/re10k --index evaluation_index_re10k_context4.json")]
    Import(ImportArgs),
    /// Write a model's weights for PyTorch, under the keys of published checkpoints
    #[command(after_help = "\
Examples:
  clift export models/re10k --format pytorch -o re10k.ckpt
  clift export runs/tiny/stage1/model.safetensors --format safetensors -o tiny.safetensors")]
    Export(ExportArgs),
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
    #[arg(required_unless_present = "checkpoint", conflicts_with = "checkpoint")]
    pub run: Option<PathBuf>,
    /// Measure the model of a directory, as `clift import` writes, instead of a run
    #[arg(long, value_name = "MODEL", requires = "data")]
    pub checkpoint: Option<PathBuf>,
    /// Folder of the data: with --checkpoint, or where a run's data has moved
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// The first-stage model of --checkpoint: adds random and K-means tokens, drawn by it
    #[arg(long, value_name = "MODEL", requires = "checkpoint")]
    pub stage1: Option<PathBuf>,
    /// An experiment of the paper: main, ablation, patchwise or budget
    ///
    /// Sets variants, --storage, --render and --selection; those given beside it win. main: quality against data size.
    /// ablation: random tokens, K-means, K-means and condenser. patchwise: tiles of the views against K-means, each
    /// with and without condenser; needs --with. budget: half of the tokens stored, fewer and fewer of them rendered.
    #[arg(long, value_name = "NAME")]
    pub preset: Option<Experiment>,
    /// Another run of the same stage 1 with another clusters.grouping, measured on the same views
    #[arg(long, value_name = "RUN", conflicts_with = "checkpoint")]
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
    /// Round stored tokens as a scene file would, in each of these formats in turn: f32, f16, int8
    #[arg(long, value_delimiter = ',', value_name = "FORMAT")]
    pub tokens: Vec<TokenStorage>,
    /// Score another system's pictures of the targets too; repeatable
    #[arg(long, value_name = "DIR")]
    pub predictions: Vec<PathBuf>,
    /// What it is called, once per --predictions in their order; the folder's name by default
    #[arg(long, value_name = "NAME", requires = "predictions")]
    pub name: Vec<String>,
    /// What it keeps of a scene, such as 12.5MB, once per --predictions in their order
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes, requires = "predictions")]
    pub data_size: Vec<u64>,
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
    /// Time f16 products beside f32 ones, in turn, with what they change: loss, PSNR and gradient
    Half(BenchHalfArgs),
}

/// Arguments of `clift compare`.
#[derive(Debug, clap::Args)]
pub struct CompareArgs {
    /// The first evaluation
    pub a: PathBuf,
    /// The second
    pub b: PathBuf,
    /// Compare a variant of the first with another of the second, at equal counts: kmeans,clift or clift:f32,clift:int8
    #[arg(long, value_name = "A,B", value_parser = parse_sides)]
    pub variants: Option<[Side; 2]>,
    /// Write the differences as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Arguments of `clift flops`.
#[derive(Debug, clap::Args)]
pub struct FlopsArgs {
    /// The experiment whose sizes are used, a TOML file; the paper's sizes by default
    pub config: Option<PathBuf>,
    /// How to count: paper, macs or flops
    #[arg(long, default_value = "macs")]
    pub convention: Convention,
    /// Numbers of rendered tokens, or shares of a scene's; those of the paper's table, or of the config, by default
    #[arg(long, value_delimiter = ',', value_name = "COUNT")]
    pub render: Vec<TokenCount>,
    /// Change a key of the config: `--set model.dim=512`
    #[arg(long, value_name = "KEY=TOML", requires = "config")]
    pub set: Vec<String>,
    /// Write the counts as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
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
    /// Tokens that `render` and `render_8_views` draw from, as a number or a share; all by default
    #[arg(long, value_name = "COUNT")]
    pub render: Option<TokenCount>,
    /// Let K-means cluster the tensor `features`, [N, D] in f32, of a safetensors file
    #[arg(long, value_name = "FILE")]
    pub features: Option<PathBuf>,
    /// Write the figures, with every repetition, as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

fn parse_sides(text: &str) -> Result<[Side; 2], String> {
    let parts: Vec<&str> = text.split(',').map(str::trim).filter(|part| !part.is_empty()).collect();
    let [a, b] = parts[..] else { return Err("write two variants, such as kmeans,clift".into()) };
    Ok([Side::parse(a), Side::parse(b)])
}

/// Bytes, or so many kB, MB, GB of a thousand each.
fn parse_bytes(text: &str) -> Result<u64, String> {
    let text = text.trim();
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic()).trim();
    let factor = match text[text.trim_end_matches(|c: char| c.is_ascii_alphabetic()).len()..].to_lowercase().as_str() {
        "" | "b" => 1.0,
        "k" | "kb" => 1e3,
        "m" | "mb" => 1e6,
        "g" | "gb" => 1e9,
        _ => return Err("write a number of bytes, or of kB, MB or GB".into()),
    };
    match digits.parse::<f64>() {
        Ok(number) if number > 0.0 && number * factor < 1e15 => Ok((number * factor).round() as u64),
        _ => Err("write a positive number of bytes, or of kB, MB or GB".into()),
    }
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

pub(crate) fn parse_repeats(text: &str) -> Result<usize, String> {
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
        assert!(parse(&["eval"]).is_err());
        assert!(parse(&["eval", "--checkpoint", "model"]).is_err());
        assert!(parse(&["eval", "--checkpoint", "model", "--data", "re10k"]).is_ok());
        assert!(parse(&["eval", "run", "--checkpoint", "model", "--data", "re10k"]).is_err());
        assert!(parse(&["import", "a.ckpt", "--variant", "released-re10k", "-o", "m", "--rename", "a=b"]).is_ok());
        assert!(parse(&["import", "a.ckpt", "--variant", "re10k", "-o", "m"]).is_err());
        assert!(parse(&["import", "a.ckpt", "--variant", "paper", "-o", "m", "--rename", "a"]).is_err());
        assert!(parse(&["export", "m", "--format", "pytorch", "-o", "a.ckpt"]).is_ok());
        assert!(parse(&["eval", "run", "--storage", "0"]).is_err());
        assert!(parse(&["eval", "run", "--render", "16,1/2", "--selection", "random"]).is_ok());
        assert!(parse(&["eval", "run", "--selection", "nearest"]).is_err());
        assert!(parse(&["eval", "run", "--tokens", "f32,int8", "--predictions", "a", "--predictions", "b"]).is_ok());
        assert!(parse(&["eval", "run", "--name", "MVSplat"]).is_err(), "a name of nothing");
        assert!(parse(&["compare", "a", "b", "--variants", "kmeans,clift:int8"]).is_ok());
        assert!(parse(&["compare", "a", "b", "--variants", "kmeans"]).is_err());
        assert!(parse(&["flops", "--convention", "paper"]).is_ok());
        assert!(parse(&["flops", "--convention", "flop"]).is_err());
        assert!(parse(&["flops", "--set", "model.dim=8"]).is_err(), "of which config");
    }

    #[test]
    fn sizes_are_bytes_or_thousands_of_them() {
        let sizes = ["12", "1.5kB", "3 MB", "2g"].map(|text| parse_bytes(text).unwrap());
        assert_eq!(sizes, [12, 1500, 3_000_000, 2_000_000_000]);
        for text in ["", "MB", "-1", "0", "1TB", "1e99GB", "nan"] {
            assert!(parse_bytes(text).is_err(), "{text}");
        }
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
