//! Several files that appear in a folder together, once all of them are complete.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use crate::files::atomic::sync_folder;

/// Prefix of the names of temporary folders; starts with [`TEMPORARY`](crate::files::atomic::TEMPORARY).
const PREFIX: &str = ".clift-unfinished-";

/// A temporary folder inside the output folder. Dropping it without [`StagedDir::commit`] deletes its files.
#[derive(Debug)]
pub struct StagedDir {
    out: PathBuf,
    /// Whether [`StagedDir::new`] created `out`.
    is_new: bool,
    files: Option<TempDir>,
}

impl StagedDir {
    /// Creates `out` if missing, and removes what killed processes left in it. No other process may write there.
    pub fn new(out: &Path) -> std::io::Result<Self> {
        let is_new = !out.exists();
        std::fs::create_dir_all(out)?;
        for item in std::fs::read_dir(out)? {
            let item = item?;
            if is_temporary(&item.file_name()) {
                std::fs::remove_dir_all(item.path())?;
            }
        }
        let files = tempfile::Builder::new().prefix(PREFIX).tempdir_in(out)?;
        Ok(Self { out: out.into(), is_new, files: Some(files) })
    }

    /// Returns the temporary folder, in which the files are to be written.
    pub fn path(&self) -> &Path {
        self.files.as_ref().map_or(&self.out, |files| files.path())
    }

    /// Moves the files to the output folder, where they replace files of equal names. Returns the names.
    pub fn commit(mut self) -> std::io::Result<BTreeSet<OsString>> {
        let items = std::fs::read_dir(self.path())?;
        let names = items.map(|item| Ok(item?.file_name())).collect::<std::io::Result<BTreeSet<OsString>>>()?;
        for name in &names {
            std::fs::rename(self.path().join(name), self.out.join(name))?;
        }
        self.is_new = false;
        sync_folder(&self.out)?;
        Ok(names)
    }
}

impl Drop for StagedDir {
    fn drop(&mut self) {
        drop(self.files.take());
        if self.is_new {
            // Fails, as intended, if the folder is not empty.
            let _ = std::fs::remove_dir(&self.out);
        }
    }
}

/// Returns whether a folder is missing or holds only temporary folders of killed processes.
pub fn is_empty_folder(folder: &Path) -> std::io::Result<bool> {
    let items = match std::fs::read_dir(folder) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(true),
        items => items?,
    };
    for item in items {
        if !is_temporary(&item?.file_name()) {
            return Ok(false);
        }
    }
    Ok(true)
}

fn is_temporary(name: &std::ffi::OsStr) -> bool {
    name.to_string_lossy().starts_with(PREFIX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::names;

    #[test]
    fn committed_files_replace_others() {
        let root = tempfile::tempdir().unwrap();
        let out = root.path().join("a/b");
        let staged = StagedDir::new(&out).unwrap();
        for path in [staged.path().join("one"), staged.path().join("two")] {
            std::fs::write(path, "new").unwrap();
        }
        for name in ["one", "other"] {
            std::fs::write(out.join(name), "old").unwrap();
        }
        assert!(staged.commit().unwrap().into_iter().eq(["one", "two"]));
        assert_eq!(names(&out), ["one", "other", "two"]);
        assert_eq!(std::fs::read_to_string(out.join("one")).unwrap(), "new");
    }

    #[test]
    fn uncommitted_and_killed_folders_are_removed() {
        let root = tempfile::tempdir().unwrap();
        let out = root.path().join("out");
        let staged = StagedDir::new(&out).unwrap();
        std::fs::write(staged.path().join("one"), "").unwrap();
        drop(staged);
        assert!(!out.exists(), "created by StagedDir");
        std::fs::create_dir_all(out.join(".clift-unfinished-x")).unwrap();
        assert!(is_empty_folder(&out).unwrap() && is_empty_folder(&root.path().join("nowhere")).unwrap());
        drop(StagedDir::new(&out).unwrap());
        assert_eq!(names(&out), [""; 0], "existed before, and stays");
        std::fs::write(out.join("mine"), "").unwrap();
        assert!(!is_empty_folder(&out).unwrap() && is_empty_folder(&out.join("mine")).is_err());
    }
}
