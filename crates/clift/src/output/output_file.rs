//! Files that commands write: checked before the work, written atomically after it.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clift_core::replace_file;
use serde::Serialize;

use crate::exit_code::usage_bail;

/// A file that a command may write.
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

    /// Writes `value` as indented JSON.
    pub fn write_json(&self, value: &impl Serialize) -> anyhow::Result<()> {
        let mut text = serde_json::to_vec_pretty(value).context("serializing the results as JSON")?;
        text.push(b'\n');
        self.write(&text)
    }
}

/// Whether two paths name one file, which need not exist.
pub fn is_same_file(a: &Path, b: &Path) -> bool {
    let real = |path: &Path| {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        path.canonicalize().ok().or_else(|| Some(folder.canonicalize().ok()?.join(path.file_name()?)))
    };
    a == b || real(a).is_some_and(|a| real(b) == Some(a))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_the_same_by_any_path() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        std::fs::create_dir(at("folder")).unwrap();
        assert!(is_same_file(&at("a"), &at("folder/../a")) && is_same_file(Path::new("a"), Path::new("./a")));
        assert!(!is_same_file(&at("a"), &at("b")) && !is_same_file(&at("a"), &at("folder/a")));
    }

    #[test]
    fn existing_files_need_force_and_inputs_are_kept() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        std::fs::create_dir_all(at("photos/images")).unwrap();
        for name in ["a.json", "photos/images/1.png"] {
            std::fs::write(at(name), "old").unwrap();
        }
        let message = |path: &str, force, inputs: &[&Path]| {
            OutputFile::new(&at(path), force, inputs).err().map(|error| error.to_string())
        };
        assert_eq!(message("new.json", false, &[]), None);
        assert!(
            message("a.json", false, &[])
                .unwrap()
                .ends_with("a.json exists; replace it with --force or choose another name")
        );
        assert_eq!(message("a.json", true, &[&at("photos")]), None);
        for (path, input) in [("photos/../a.json", "a.json"), ("photos/images/1.png", "photos")] {
            let message = message(path, true, &[&at("other"), &at(input)]).unwrap();
            assert!(message.contains("exists and belongs to the input "), "{message}");
        }
        assert_eq!(message("photos/images/2.png", false, &[&at("photos")]), None, "new files replace nothing");
        OutputFile::new(&at("a.json"), true, &[]).unwrap().write_json(&[1]).unwrap();
        assert_eq!(std::fs::read_to_string(at("a.json")).unwrap(), "[\n  1\n]\n");
    }
}
