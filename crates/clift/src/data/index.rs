//! `clift data index`.

use clift_data::{OverlapOptions, write_overlap_index};

use super::args::IndexArgs;
use super::open::halves;
use super::text::count;
use crate::WrongUsage;
use crate::terminal::{print_note, print_result};

/// Writes the index of one half and says what has no views.
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
    let Some(half) = halves(&args.dir, args.split)?.pop() else {
        return Err(WrongUsage(format!("{} holds no scenes", args.dir.display())).into());
    };
    if half.opened.ledger.has_gaps() {
        print_note(&format!("{}: {}", half.name(), half.opened.ledger));
    }
    let ledger = write_overlap_index(&args.out, half.opened.source.as_ref(), &options)?;
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
