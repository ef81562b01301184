//! What a user types.

use clap::{Parser, Subcommand};

use crate::commands::bench::cases::BenchArgs;
use crate::commands::compare::CompareArgs;
use crate::commands::data::command::DataCommand;
use crate::commands::doctor::args::DoctorArgs;
use crate::commands::encode::EncodeArgs;
use crate::commands::eval::EvalArgs;
use crate::commands::export::ExportArgs;
use crate::commands::flops::FlopsArgs;
use crate::commands::import::ImportArgs;
use crate::commands::plan::PlanArgs;
use crate::commands::render::args::RenderArgs;
use crate::commands::train::TrainArgs;

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

#[cfg(test)]
mod tests {
    use clift_bench::BenchCase;
    use clift_model::TokenCount;

    use clap::CommandFactory;

    use super::*;
    use crate::commands::parse::parse_bytes;

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
        assert_eq!(args.work, [BenchCase::Encode, BenchCase::Stage1StepTiny]);
        assert_eq!((args.repeats, args.warmup, args.storage), (5, 1, TokenCount::Share(0.25)));
        let message = parse(&["--work", "incode"]).unwrap_err().to_string();
        assert!(message.contains("'incode'") && message.contains("the cases are encode, kmeans"), "{message}");
        assert!(parse(&["--repeats", "0"]).is_err());
    }
}
