//! `clift data index`.

use std::path::PathBuf;

use clift_data::{OverlapOptions, SceneSource, write_overlap_index};

use crate::commands::data::text::count;
use crate::commands::parse::parse_distance;
use crate::commands::splits::{SplitSource, Splits, files, splits};
use crate::exit_code::UsageError;
use crate::output::stdout::{print_note, print_result};

/// Writes the index of a half, or of both, and says what has no views.
pub fn run(args: &IndexArgs) -> anyhow::Result<()> {
    let options = OverlapOptions {
        num_context: args.context,
        num_targets: args.targets,
        distance: args.distance,
        min_overlap: args.overlap,
        seed: args.seed,
    };
    options.validate()?;
    if args.out.exists() {
        let message = format!("{} is there already, and nothing is written over", args.out.display());
        return Err(UsageError(message).into());
    }
    let halves = splits(&args.dir, args.split, &files(&args.set)?.0)?;
    halves.iter().for_each(SplitSource::print_news);
    let sources: Vec<&dyn SceneSource> = halves.iter().map(|half| half.opened.source.as_ref()).collect();
    let ledger = write_overlap_index(&args.out, &sources, &options)?;
    ledger.notes.iter().for_each(|note| print_note(&format!("note: {note}")));
    let used = count(ledger.num_used(), "scene");
    print_result(&format!("{used} of {} with views: {}", ledger.num_scenes, args.out.display()))?;
    for (reason, number) in ledger.counts() {
        print_result(&format!("null: {number} {reason}"))?;
    }
    if ledger.num_used() == 0 {
        let [near, far] = options.distance;
        anyhow::bail!("no scene has views; frames {near} to {far} apart are asked for: change --distance or --overlap");
    }
    Ok(())
}

/// Arguments of `clift data index`.
#[derive(Debug, clap::Args)]
pub struct IndexArgs {
    /// Scenes in any layout
    pub dir: PathBuf,
    /// Where to write
    #[arg(long, short, value_name = "FILE")]
    pub out: PathBuf,
    /// Which half, where there are two
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
    /// Least overlap of the first and the last context
    #[arg(long, value_name = "SHARE", default_value_t = 0.6)]
    pub overlap: f64,
    /// Decides which of the possible frames are taken
    #[arg(long, value_name = "S", default_value_t = 123)]
    pub seed: u64,
    /// Say where parts of the layout are, as in a config: `--set data.files.image_folder=images_4`
    #[arg(long, value_name = "data.files.KEY=TOML")]
    pub set: Vec<String>,
}
