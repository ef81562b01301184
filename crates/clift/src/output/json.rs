//! Results as JSON files.

use std::path::Path;

use anyhow::Context;
use clift_core::replace_file;
use serde::Serialize;

/// Writes `value` as indented JSON, atomically.
pub fn write_json(value: &impl Serialize, path: &Path) -> anyhow::Result<()> {
    let mut text = serde_json::to_vec_pretty(value).context("serializing the results as JSON")?;
    text.push(b'\n');
    replace_file(path, &text).with_context(|| format!("writing {}", path.display()))
}
