//! The halves of a data folder, whatever its layout.

use std::path::Path;

use clift_data::{LayoutOptions, Opened, Split, has_halves};

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

/// The halves asked for that are there; one, whichever, for a folder that is not divided.
pub fn halves_there(root: &Path, splits: Splits) -> Vec<Split> {
    let is_there = |split: &Split| root.join(split.to_string()).is_dir();
    let there: Vec<Split> = splits.list().iter().copied().filter(is_there).collect();
    if there.is_empty() || !has_halves(root) { splits.list()[splits.list().len() - 1..].to_vec() } else { there }
}

/// How all of a folder is opened: everything is going to be read, so that chunks are looked into.
pub fn options() -> LayoutOptions {
    LayoutOptions { reads_chunks: true, ..LayoutOptions::default() }
}

/// Opens the halves asked for that are there. A folder without `train/` and `test/` counts once.
///
/// # Errors
/// The first error of opening one.
pub fn halves(root: &Path, splits: Splits) -> anyhow::Result<Vec<Half>> {
    let mut halves = Vec::new();
    for split in halves_there(root, splits) {
        let mut opened = Opened::open(root, split, &options())?;
        if !opened.has_splits {
            // Here they are no halves.
            opened.ledger.notes.retain(|note| !note.contains("both halves are the same scenes"));
        }
        halves.push(Half { split: opened.has_splits.then_some(split), opened });
    }
    Ok(halves)
}
