//! The halves of a data folder, whatever its layout.

use std::path::Path;

use clift_data::{LayoutOptions, Opened, Split};

use super::args::Splits;

/// A half of a folder, or all of one that is not divided.
pub struct Half {
    /// Name of its folder; `None` for a folder that is not divided.
    pub split: Option<Split>,
    /// Its scenes.
    pub opened: Opened,
}

impl Half {
    /// What to call it.
    pub fn name(&self) -> String {
        self.split.map_or_else(|| "scenes".into(), |split| split.to_string())
    }
}

/// Opens the halves asked for that are there. A folder without `train/` and `test/` counts once.
///
/// # Errors
/// The first error of opening one.
pub fn halves(root: &Path, splits: Splits) -> anyhow::Result<Vec<Half>> {
    let is_there = |split: &Split| root.join(split.to_string()).is_dir();
    let there: Vec<Split> = splits.list().iter().copied().filter(is_there).collect();
    let wanted = if there.is_empty() { &splits.list()[splits.list().len() - 1..] } else { &there[..] };
    let mut halves = Vec::new();
    for &split in wanted {
        let mut opened = Opened::open(root, split, &LayoutOptions::default())?;
        if !opened.has_splits {
            // Here they are no halves.
            opened.ledger.notes.retain(|note| !note.contains("both halves are the same scenes"));
        }
        let is_whole = !opened.has_splits;
        halves.push(Half { split: opened.has_splits.then_some(split), opened });
        if is_whole {
            break;
        }
    }
    Ok(halves)
}
