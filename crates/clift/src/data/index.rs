//! `clift data index`.

use clift_data::{OverlapOptions, SceneSource, write_overlap_index};

use super::args::IndexArgs;
use super::open::{Half, files, halves};
use super::text::count;
use crate::WrongUsage;
use crate::terminal::{print_note, print_result};

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
        return Err(WrongUsage(message).into());
    }
    let halves = halves(&args.dir, args.split, &files(&args.set)?.0)?;
    halves.iter().for_each(Half::print_news);
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
