//! Results as JSON files.

use std::path::Path;

use anyhow::Context;
use clift_data::replace_file;
use serde::Serialize;

/// Writes a file, under a temporary name first.
///
/// # Errors
/// The operating system's.
pub fn write(value: &impl Serialize, path: &Path) -> anyhow::Result<()> {
    let mut text = serde_json::to_vec_pretty(value).context("writing the results as JSON")?;
    text.push(b'\n');
    replace_file(path, &text).with_context(|| format!("writing {}", path.display()))
}
