//! Scenes on disk: every layout, lens distortion, and what is broken or hostile.

mod captures;
mod files;
mod found;
mod hostile;
mod layouts;
mod left_out;
mod lenses;

use std::path::Path;

use clift_data::{DataError, DatasetRoot, OpenedSource, SourceOptions, Split, open_source};

/// Opens a split of the data set at a path.
fn open_at(root: &Path, split: Split, options: &SourceOptions) -> Result<OpenedSource, DataError> {
    open_source(&DatasetRoot::find(root)?, split, options)
}
