//! The command tree.

use clap::{Parser, Subcommand};

use crate::commands::bench::BenchArgs;
use crate::commands::codec::CodecArgs;
use crate::commands::compare::CompareArgs;
use crate::commands::data::command::DataCommand;
use crate::commands::doctor::run::DoctorArgs;
use crate::commands::encode::EncodeArgs;
use crate::commands::eval::EvalArgs;
use crate::commands::export::ExportArgs;
use crate::commands::flops::FlopsArgs;
use crate::commands::import::ImportArgs;
use crate::commands::metrics::MetricsArgs;
use crate::commands::plan::PlanArgs;
use crate::commands::render::RenderArgs;
use crate::commands::train::TrainArgs;
use crate::commands::view::ViewArgs;

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
    #[arg(short, long, global = true)]
    pub quiet: bool,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Train both stages and evaluate; resumes an existing run
    Train(TrainArgs),
    /// Evaluate a run or model on test views
    #[command(after_help = "\
Examples:
  clift eval runs/tiny --stored-tokens 8,1/4,1.0 --format f32,f16,coded --out runs/tiny/formats
  clift eval runs/re10k --index INDEX.json --set 'eval.lpips_weights=\"lpips-vgg.safetensors\"' --out lpips")]
    Eval(EvalArgs),
    /// Compare two evaluations view by view, with confidence intervals
    ///
    /// Accepts run directories, folders of `clift eval --out` and `views.csv` files. Compares every method and count that
    /// both evaluations have, on the target views that both have, and prints the number of other views. A difference is
    /// second minus first, averaged over the views of a scene, then over scenes. Intervals are 95 % of Student's t.
    Compare(CompareArgs),
    /// Count multiply-accumulates of rendering, encoding and condensing
    ///
    /// Uses the sizes of a config, or the paper's network with four context views of 256 x 256. `paper` counts as the
    /// paper's table: one per multiply-accumulate of a linear layer, none for attention, five per value of a norm. `macs`
    /// counts every multiply-accumulate, `flops` counts each as two.
    Flops(FlopsArgs),
    /// Compress posed images into a scene file
    ///
    /// Encodes context views (photos in groups of neighbours) and compresses their tokens to the requested count. The file
    /// contains everything for rendering except the weights.
    #[command(after_help = "\
Examples:
  clift encode captures/attic -o attic.clift
  clift encode runs/tiny --scene synthetic-0-test-00000 -o room.clift
  clift encode runs/re10k /data/re10k/test --stored-tokens 256 --format coded -o room.clift")]
    Encode(EncodeArgs),
    /// Fit the token codec of a model, for coded scene files
    ///
    /// Training fits the codec after stage 2. This command fits that of an imported model or of an earlier run, on training
    /// scenes: transform, probabilities, and the loss of PSNR at every count and step. Writes codec.safetensors beside the
    /// weights.
    Codec(CodecArgs),
    /// Render a scene file along a camera path
    ///
    /// Writes frame-00000.png and so on, animation.png (an animated PNG for browsers) and render.json (token
    /// counts, times and the tokens of each frame) to a folder.
    #[command(after_help = "\
Paths:
  interpolate   through the context views
  orbit         a small ellipse about the mean context view, facing the point
                that the context views look at
  FILE.json     {\"poses\": [{\"c2w\": [[4 numbers] x 3]}, ..]}: camera to world,
                OpenCV axes, in the world of the capture; a pose may have
                \"intrinsics_norm\": [fx, fy, cx, cy], over width and height;
                the number of poses is the number of frames")]
    Render(RenderArgs),
    /// Walk through scenes in a browser
    ///
    /// Serves one page on this machine and prints its URL, which holds the token of the session, as the first line. In the
    /// page: orbit and fly, numbers of rendered and stored tokens, a frame rate to hold, the tokens of each image on the
    /// context views, camera paths for `clift render --path` and, for a run, true images beside the renderings.
    View(ViewArgs),
    /// Create, inspect, check and index data sets
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
    /// Count parameters and memory of a run
    ///
    /// Covers both stages, the cluster cache and the evaluation. Counts parameters exactly and memory from the tensors
    /// that the operations keep. Needs no data.
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
    Import(ImportArgs),
    /// Write a model directory with the weights in f16
    Export(ExportArgs),
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn command_tree_is_consistent() {
        Args::command().debug_assert();
    }

    #[test]
    fn wrong_command_lines_are_refused() {
        for line in [
            "eval",
            "eval --checkpoint model",
            "eval run --checkpoint model --data re10k",
            "eval run --selection nearest",
            "eval run --name MVSplat",
            "flops --set model.dim=8",
            "render a.clift -o out --path orbit --frames 0",
            "render a.clift -o out --path orbit --selection all",
            "import a.ckpt --variant re10k -o m",
            "bench",
            "bench a.toml --repeats 0",
        ] {
            assert!(Args::try_parse_from(["clift"].into_iter().chain(line.split(' '))).is_err(), "{line}");
        }
    }
}
