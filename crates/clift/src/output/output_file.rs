//! Files that commands write: checked before the work, written atomically after it.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clift_core::replace_file;
use serde::Serialize;

use crate::exit_code::usage_bail;

#[derive(Debug)]
pub struct OutputFile {
    path: PathBuf,
}

impl OutputFile {
    /// Checks that a file may be written. An existing file needs `force`. It is never replaced if it is one of the `inputs`
    /// of the command, or lies in one that is a folder.
    ///
    /// # Errors
    /// [`UsageError`](crate::exit_code::UsageError) for a file that is not replaced.
    pub fn new(path: &Path, force: bool, inputs: &[&Path]) -> anyhow::Result<Self> {
        if path.symlink_metadata().is_ok() {
            let real = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.into());
            if let Some(input) = inputs.iter().find(|input| real(path).starts_with(real(input))) {
                let (path, input) = (path.display(), input.display());
                usage_bail!("the file {path} exists and belongs to the input {input}; choose another name");
            }
            if !force {
                usage_bail!("the file {} exists; replace it with --force or choose another name", path.display());
            }
        }
        Ok(Self { path: path.into() })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes the file atomically, and makes missing folders.
    pub fn write(&self, content: &[u8]) -> anyhow::Result<()> {
        let folder = self.path.parent().map_or(Ok(()), std::fs::create_dir_all);
        let written = folder.and_then(|()| replace_file(&self.path, content));
        written.with_context(|| format!("writing {}", self.path.display()))
    }

    pub fn write_json(&self, value: &impl Serialize) -> anyhow::Result<()> {
        let mut text = serde_json::to_vec_pretty(value).context("serializing the results as JSON")?;
        text.push(b'\n');
        self.write(&text)
    }
}
