//! The command tree.

use clap::{Parser, Subcommand};

use crate::commands::bench::cases::BenchArgs;
use crate::commands::codec::CodecArgs;
use crate::commands::compare::CompareArgs;
use crate::commands::completions::CompletionsArgs;
use crate::commands::data::command::DataCommand;
use crate::commands::doctor::run::DoctorArgs;
use crate::commands::encode::EncodeArgs;
use crate::commands::eval::EvalArgs;
use crate::commands::export::ExportArgs;
use crate::commands::flops::FlopsArgs;
use crate::commands::import::ImportArgs;
use crate::commands::metrics::MetricsArgs;
use crate::commands::plan::PlanArgs;
use crate::commands::render::args::RenderArgs;
use crate::commands::train::TrainArgs;
use crate::commands::view::ViewArgs;
use crate::verbosity::Verbosity;

/// Train, compress, render and evaluate scenes of compressive light-field tokens
#[derive(Debug, Parser)]
#[command(
    name = "clift",
    version,
    propagate_version = true,
    after_help = "\
Exit codes:
  0    done
  1    failed, or a check found a problem
  2    invalid command line, config or model
  129  terminal closed, after the state was saved
  130  Ctrl-C, after the state was saved
  143  SIGTERM, after the state was saved

A second signal, a second or more after the first, ends the process at once."
)]
pub struct Args {
    /// Command to run.
    #[command(subcommand)]
    pub command: Command,
    /// Print results, warnings and errors only
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub quiet: bool,
    /// Print a line for every training step
    #[arg(short, long, global = true)]
    pub verbose: bool,
}

impl Args {
    /// Returns the amount of notes and progress.
    pub fn verbosity(&self) -> Verbosity {
        match (self.quiet, self.verbose) {
            (true, _) => Verbosity::Quiet,
            (_, true) => Verbosity::Verbose,
            _ => Verbosity::Normal,
        }
    }
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Train both stages and evaluate; resumes an existing run
    Train(TrainArgs),
    /// Evaluate a run or model on test views
    #[command(after_help = "\
External methods:
  --predictions DIR holds <scene key>/<target frame, six digits>.png, or
  <scene key>/color/.., as pixelSplat writes them. Characters of a key other than
  letters, digits, - _ and . are replaced by _.

Examples:
  clift eval runs/tiny --stored-tokens 8,1/4,1.0 --format f32,f16,int8 --out runs/tiny/formats
  clift eval runs/re10k --index INDEX.json --set 'eval.lpips_weights=\"lpips-vgg.safetensors\"' --out lpips
  clift eval runs/re10k --index INDEX.json --predictions out/mvsplat --name MVSplat --data-size 12MB --force")]
    Eval(EvalArgs),
    /// Compare two evaluations view by view, with confidence intervals
    ///
    /// Accepts run directories, folders of `clift eval --out` and `views.csv` files. Compares every method and count that
    /// both evaluations have, on the target views that both have, and prints the number of other views. A difference is
    /// second minus first, averaged over the views of a scene, then over scenes. Intervals are 95 % of Student's t.
    #[command(after_help = "\
Examples:
  clift compare runs/a runs/b
  clift compare runs/a runs/a --methods kmeans,clift
  clift compare runs/a runs/a --methods clift:f32,clift:int8")]
    Compare(CompareArgs),
    /// Count multiply-accumulates of rendering, encoding and condensing
    ///
    /// Uses the sizes of a config, or the paper's network with four context views of 256 x 256. `paper` counts as the
    /// paper's table: one per multiply-accumulate of a linear layer, none for attention, five per value of a norm. `macs`
    /// counts every multiply-accumulate, `flops` counts each as two.
    Flops(FlopsArgs),
    /// Compress posed images into a scene file
    ///
    /// Selects context views along the camera path, encodes them and compresses the tokens to the requested count. The
    /// file contains everything for rendering except the weights.
    #[command(after_help = "\
Examples:
  clift encode captures/attic -o attic.clift
  clift encode runs/tiny --scene synthetic-0-test-00000 -o room.clift
  clift encode runs/re10k captures/attic -o attic.clift
  clift encode runs/re10k /data/re10k --scene 5aca87f95a9412c6 --stored-tokens 1/8 -o room.clift
  clift encode runs/re10k /data/re10k/test --stored-tokens 256 --format coded -o room.clift
  clift encode runs/re10k captures/attic --size-kb 20 -o attic.clift")]
    Encode(EncodeArgs),
    /// Fit the token codec of a model, for coded scene files
    ///
    /// Training fits the codec after stage 2. This command fits that of an imported model or of an earlier run, on training
    /// scenes: transform, probabilities, and the loss of PSNR at every count and step. Writes codec.safetensors beside the
    /// weights and prints the losses.
    #[command(after_help = "\
Examples:
  clift codec runs/tiny --force
  clift codec models/re10k /data/re10k --set eval.num_context=4")]
    Codec(CodecArgs),
    /// Render a scene file along a camera path
    ///
    /// Writes frame-00000.png and so on, animation.png (an animated PNG for browsers) and render.json (token
    /// counts, times and the tokens of each frame) to a folder. --video also writes an MP4 through `ffmpeg`.
    #[command(after_help = "\
Paths:
  interpolate   through the context views
  orbit         a small ellipse about the mean context view, facing the point
                that the context views look at
  FILE.json     {\"poses\": [{\"c2w\": [[4 numbers] x 3]}, ..]}: camera to world,
                OpenCV axes, in the world of the capture; a pose may have
                \"intrinsics_norm\": [fx, fy, cx, cy], over width and height;
                the number of poses is the number of frames

Examples:
  clift render room.clift --path interpolate -o out
  clift render room.clift --path orbit --size 512x512 --frames 120 -o out
  clift render room.clift --path poses.json --render 256 --selection global -o out
  clift render room.clift --path orbit --budget-ms 30 -o out
  clift render room.clift --path orbit --video orbit.mp4 -o out")]
    Render(RenderArgs),
    /// Walk through scenes in a browser
    ///
    /// Serves one page on this machine and prints its URL, which holds the token of the session, as the first line. In the
    /// page: orbit and fly, numbers of rendered and stored tokens, a frame rate to hold, the tokens of each image on the
    /// context views, camera paths for `clift render --path` and, for a run, true images beside the renderings.
    #[command(after_help = "\
Examples:
  clift view
  clift view room.clift
  clift view runs/tiny
  clift view captures/attic
  clift view room.clift --no-open --port 8080")]
    View(ViewArgs),
    /// Create, inspect, check, convert and index data sets
    Data {
        /// Command for data sets.
        #[command(subcommand)]
        command: DataCommand,
    },
    /// Write the training curves of a run as CSV or for TensorBoard
    ///
    /// Reads metrics.jsonl and validation.jsonl. Event files have a folder per stage, for `tensorboard --logdir DIR`.
    #[command(after_help = "\
Examples:
  clift metrics runs/tiny --csv tiny.csv
  clift metrics runs/tiny --tensorboard board --force")]
    Metrics(MetricsArgs),
    /// Count parameters, memory and operations of a run
    ///
    /// Covers both stages, the cluster cache and the evaluation. Counts parameters exactly and memory from the tensors
    /// that the operations keep, and compares the largest tensor with the limit of the device. Needs no data.
    /// `clift train` prints the time of a step and the time left after step 20 of each stage.
    Plan(PlanArgs),
    /// Check devices, processor and memory of this machine
    ///
    /// Runs one forward and backward pass of a small model on every device of this build and compares the gradient with
    /// that of the default device. Exits with 1 if the default device fails.
    ///
    /// With --stability, runs hard numerical cases instead (zero baselines, extreme logits, a single cluster, ..) on every
    /// device and compares them with the same computation in f64. Exits with 1 if an error exceeds its bound.
    Doctor(DoctorArgs),
    /// Time each part of the method and its error against f64
    ///
    /// Needs no data: inputs and weights are sampled from the config's seed. A row is one part of the method at the
    /// config's sizes, with the fewest context views; `encode` to `render_8_views` have one scene, the steps the config's
    /// batch. Prints median and 95th percentile of the repetitions, the peak memory of the process and the largest
    /// relative error against the same computation in f64.
    Bench(BenchArgs),
    /// Convert a published PyTorch checkpoint to a model directory
    ///
    /// The checkpoint is parsed and never executed; content other than weights is skipped. Every parameter of the network
    /// must be present and every network key must be known, otherwise the import fails. The model directory holds
    /// model.safetensors, config.toml (network sizes and evaluation protocol) and import.json (origin of each parameter).
    #[command(after_help = "\
Examples:
  clift import last.ckpt --variant released-re10k -o models/re10k
  clift eval --checkpoint models/re10k --data /data/re10k --index evaluation_index_re10k_context4.json")]
    Import(ImportArgs),
    /// Export weights with published names, for PyTorch, or in f16
    #[command(after_help = "\
Examples:
  clift export models/re10k --format pytorch -o re10k.ckpt
  clift export runs/re10k/stage1/model.safetensors --format safetensors -o stage1.safetensors
  clift export runs/rooms --format f16 -o models/my-rooms")]
    Export(ExportArgs),
    /// Print the completion script of a shell
    #[command(after_help = "\
Examples:
  clift completions bash > ~/.local/share/bash-completion/completions/clift
  clift completions fish > ~/.config/fish/completions/clift.fish")]
    Completions(CompletionsArgs),
}

#[cfg(test)]
mod tests {
    use clap::{CommandFactory, ValueEnum};

    use super::*;
    use crate::commands::completions;

    #[test]
    fn command_tree_is_consistent() {
        Args::command().debug_assert();
    }

    #[test]
    fn completion_scripts_of_all_shells_have_the_commands() {
        for shell in clap_complete::Shell::value_variants() {
            let script = completions::script(*shell, Args::command());
            assert!(["encode", "convert", "stored-tokens"].iter().all(|word| script.contains(word)), "{shell}");
        }
    }

    #[test]
    fn wrong_command_lines_are_refused() {
        for line in [
            "train a.toml --overfit 0",
            "train a.toml -q -v",
            "eval",
            "eval --checkpoint model",
            "eval run --checkpoint model --data re10k",
            "eval run --selection nearest",
            "eval run --name MVSplat",
            "compare a b --methods kmeans",
            "flops --set model.dim=8",
            "render a.clift -o out --path orbit --frames 0",
            "render a.clift -o out --path orbit --budget-ms 30 --render 5",
            "render a.clift -o out --path orbit --selection all",
            "import a.ckpt --variant re10k -o m",
            "import a.ckpt --variant paper -o m --rename a",
            "bench",
            "bench a.toml --repeats 0",
            "data synth out --quality 101",
            "data synth out --chunk-mb 0",
            "data convert dir out --to zip",
        ] {
            assert!(Args::try_parse_from(["clift"].into_iter().chain(line.split(' '))).is_err(), "{line}");
        }
    }
}
