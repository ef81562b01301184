//! `clift data index`.

use std::path::PathBuf;

use clift_core::plural;
use clift_data::{OverlapOptions, SceneSource, write_overlap_index};

use crate::commands::args::parse::{parse_distance, parse_output};
use crate::commands::args::splits::{SourceArgs, Splits};
use crate::output::output_file::OutputFile;
use crate::output::stdout::{print_note, print_result};

pub fn run(args: &IndexArgs) -> anyhow::Result<()> {
    let options = OverlapOptions {
        num_context: args.context,
        num_targets: args.targets,
        distance: args.distance,
        min_overlap: args.overlap,
        seed: args.seed,
    };
    options.validate()?;
    OutputFile::new(&args.out, args.force, &[&args.source.dir])?;
    let splits = args.source.open(args.split)?;
    for split in splits.iter().filter(|split| split.opened.report.has_content()) {
        print_note(&format!("{}: {}", split.name(), split.opened.report));
    }
    let sources: Vec<&dyn SceneSource> = splits.iter().map(|split| split.opened.source.as_ref()).collect();
    let report = write_overlap_index(&args.out, &sources, &options)?;
    let file = if report.num_used() > 0 { args.out.display().to_string() } else { "no file written".into() };
    print_result(&format!("{} of {} with views: {file}", plural(report.num_used(), "scene"), report.num_scenes))?;
    for (reason, number) in report.counts() {
        print_result(&format!("without views: {} {reason}", plural(number, "scene")))?;
    }
    if report.num_used() == 0 {
        let [near, far] = options.distance;
        anyhow::bail!("no scene has overlapping views {near} to {far} frames apart; lower --distance or --overlap");
    }
    Ok(())
}

#[derive(Debug, clap::Args)]
pub struct IndexArgs {
    #[command(flatten)]
    pub source: SourceArgs,
    /// Index file to write
    #[arg(long, short, value_name = "FILE", value_parser = parse_output)]
    pub out: PathBuf,
    /// Replace an existing file
    #[arg(long)]
    pub force: bool,
    /// Use this split, if there are two
    #[arg(long, value_enum, default_value_t = Splits::Test)]
    pub split: Splits,
    /// Context frames per scene
    #[arg(long, value_name = "N", default_value_t = 4)]
    pub context: usize,
    /// Target frames per scene
    #[arg(long, value_name = "N", default_value_t = 3)]
    pub targets: usize,
    /// Fewest and most frames from the first context to the last
    #[arg(long, value_name = "A..B", default_value = "45..135", value_parser = parse_distance)]
    pub distance: [usize; 2],
    /// Minimum overlap of the first and the last context
    #[arg(long, value_name = "SHARE", default_value_t = 0.6)]
    pub overlap: f64,
    /// Seed of the sampled frames
    #[arg(long, value_name = "S", default_value_t = 123)]
    pub seed: u64,
}
