//! `clift import`.

use std::path::PathBuf;

use clift_model::CliftVariant;
use clift_train::{ImportRecord, import};

use crate::interrupt::{self, Ending};
use crate::output::stdout::print_result;

#[derive(Debug, clap::Args)]
pub struct ImportArgs {
    /// Checkpoint written by PyTorch
    #[arg(value_name = "CKPT")]
    pub file: PathBuf,
    /// Network of the checkpoint: paper, released-re10k or released-dl3dv
    #[arg(long, value_name = "VARIANT")]
    pub variant: CliftVariant,
    /// Model directory to write
    #[arg(long, short, value_name = "DIR")]
    pub out: PathBuf,
    /// Number of attention heads [default: 8 for the published width 768]
    ///
    /// Tensor shapes do not determine the number of heads, except for released-dl3dv.
    #[arg(long, value_name = "COUNT")]
    pub num_heads: Option<usize>,
}

pub fn run(args: &ImportArgs) -> anyhow::Result<()> {
    let stop = interrupt::flag(Ending::WITHOUT_RESULTS)?;
    let (config, record) = import(&args.file, &args.out, (args.variant, args.num_heads), &stop)?;
    let model = &config.model;
    let mut lines: Vec<String> =
        record.parameters.iter().map(|(key, paths)| format!("{key} -> {}", paths.join(", "))).collect();
    lines.extend(skipped(&record));
    lines.push(format!(
        "{}: {}, width {}, {} heads, {} + {} layers, {}; {} tensors, the network is complete",
        args.out.display(),
        record.variant,
        model.dim,
        model.num_heads,
        model.num_encoder_blocks,
        model.num_renderer_blocks,
        if record.has_condenser { "with condenser" } else { "without condenser (a stage-1 checkpoint)" },
        record.parameters.len(),
    ));
    print_result(&lines.join("\n"))
}

fn skipped(record: &ImportRecord) -> Vec<String> {
    let ignored =
        record.ignored.iter().map(|(first, count)| format!("skipped, other networks: {count} keys {first}.*"));
    let unknown = record.outside.iter().map(|(pattern, count)| format!("skipped, unknown keys: {count} x {pattern}"));
    let mut lines: Vec<String> = ignored.chain(unknown).collect();
    if !record.passed_over.is_empty() {
        let names: Vec<&str> = record.passed_over.iter().map(String::as_str).collect();
        lines.push(format!("skipped, Python objects (never executed): {}", names.join(", ")));
    }
    if record.num_converted > 0 {
        lines.push(format!("converted to f32: {} tensors", record.num_converted));
    }
    lines
}
