//! Scenes on disk: every layout, lens distortion, broken and hostile files.

mod captures;
mod detection;
mod files;
mod hostile;
mod layouts;
mod lenses;
mod masks;
mod skipped;

use std::path::Path;

use clift_data::{DatasetRoot, FileOptions, OpenedSource, SkipReport, SourceOptions, Split, open_source};

fn open(root: &Path, split: Split, options: &SourceOptions) -> Result<OpenedSource, String> {
    let opened = DatasetRoot::find(root).and_then(|root| open_source(&root, split, options, &mut |_, _| ()));
    opened.map_err(|error| error.to_string())
}

fn open_test(root: &Path) -> Result<OpenedSource, String> {
    open(root, Split::Test, &SourceOptions::default())
}

fn open_with(root: &Path, files: FileOptions) -> Result<OpenedSource, String> {
    open(root, Split::Test, &SourceOptions { files, ..SourceOptions::default() })
}

fn skipped_frames(report: &SkipReport) -> Vec<(&str, &str)> {
    report.frames.iter().map(|skip| (skip.frame.as_str(), skip.reason.as_str())).collect()
}
