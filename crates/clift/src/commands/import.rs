//! `clift import`.

use std::path::PathBuf;

use clift_model::CliftVariant;
use clift_train::{ImportOptions, ImportRecord, import};

use crate::output::stdout;

/// Arguments of `clift import`.
#[derive(Debug, clap::Args)]
pub struct ImportArgs {
    /// A checkpoint that PyTorch wrote
    #[arg(value_name = "CKPT")]
    pub file: PathBuf,
    /// The network it holds: paper, released-re10k or released-dl3dv
    #[arg(long, value_name = "VARIANT")]
    pub variant: CliftVariant,
    /// The model directory to write
    #[arg(long, short, value_name = "DIR")]
    pub out: PathBuf,
    /// Attention heads [default: 8 for the published width 768]
    ///
    /// No shape shows them but in released-dl3dv. What `clift export` writes says them.
    #[arg(long, value_name = "COUNT")]
    pub num_heads: Option<usize>,
    /// Take parameters in f16, bf16 or f64 as well, converted to f32
    #[arg(long)]
    pub convert: bool,
    /// Replace a part of every key as messages print it, repeatedly: `--rename attn.qn=attn.q_norm`
    #[arg(long, value_name = "FROM=TO", value_parser = parse_rename)]
    pub rename: Vec<(String, String)>,
}

/// Imports a checkpoint and prints what became what.
pub fn run(args: &ImportArgs) -> anyhow::Result<()> {
    let options = ImportOptions {
        variant: args.variant,
        num_heads: args.num_heads,
        convert: args.convert,
        renames: args.rename.clone(),
    };
    let stop = crate::interrupt::flag()?;
    let (config, imported) = import(&args.file, &args.out, &options, &stop)?;
    let model = &config.model;
    let mut lines: Vec<String> =
        imported.parameters.iter().map(|(key, paths)| format!("{key} -> {}", paths.join(", "))).collect();
    lines.extend(told(&imported));
    lines.push(format!(
        "{}: {} of width {}, {} heads, {} + {} layers, {}; {} tensors, all of the network's",
        args.out.display(),
        imported.variant,
        model.dim,
        model.num_heads,
        model.num_encoder_blocks,
        model.num_renderer_blocks,
        if imported.has_condenser { "with its condenser" } else { "without condenser (a first-stage checkpoint)" },
        imported.parameters.len(),
    ));
    stdout::print_result(&lines.join("\n"))
}

/// What was not taken over.
fn told(imported: &ImportRecord) -> Vec<String> {
    let mut lines = Vec::new();
    for (first, count) in &imported.ignored {
        lines.push(format!("not of the network: {count} keys {first}.*"));
    }
    for (pattern, count) in &imported.outside {
        lines.push(format!("passed over, neither the network's nor known otherwise: {count} x {pattern}"));
    }
    if !imported.passed_over.is_empty() {
        let names: Vec<&str> = imported.passed_over.iter().map(String::as_str).collect();
        lines.push(format!("passed over, not run: {}", names.join(", ")));
    }
    if imported.num_converted > 0 {
        lines.push(format!("converted to f32: {} tensors", imported.num_converted));
    }
    lines
}

fn parse_rename(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((from, to)) if !from.is_empty() => Ok((from.into(), to.into())),
        _ => Err("write FROM=TO".into()),
    }
}
