//! Scenes on disk: every layout, lens distortion, broken and hostile files.

mod captures;
mod detection;
mod files;
mod hostile;
mod layouts;
mod lenses;
mod skipped;

use std::path::Path;

use clift_data::{DataError, DatasetRoot, OpenedSource, SourceOptions, Split, open_source};

/// Opens a split of the data set at a path.
fn open_at(root: &Path, split: Split, options: &SourceOptions) -> Result<OpenedSource, DataError> {
    open_source(&DatasetRoot::find(root)?, split, options)
}
