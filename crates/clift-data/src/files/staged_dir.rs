//! Files that appear in a folder when all of them are made: an error before leaves none.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use crate::files::atomic::sync_folder;

/// Start of the names of temporary folders: what a kill leaves behind can be told from everything else, and
/// [`crate::files::atomic::remove_leftovers`] takes it away too.
const PREFIX: &str = ".clift-unfinished-";

/// A folder inside the one that its files are for. Dropped, it leaves nothing behind.
#[derive(Debug)]
pub struct StagedDir {
    out: PathBuf,
    /// Whether `out` was made for it.
    is_new: bool,
    files: Option<TempDir>,
}

impl StagedDir {
    /// Makes `out` if it is not there, and removes what kills have left in it. Nobody else may be writing there.
    ///
    /// # Errors
    /// The operating system's.
    pub fn new(out: &Path) -> std::io::Result<Self> {
        let is_new = !out.exists();
        std::fs::create_dir_all(out)?;
        for item in std::fs::read_dir(out)? {
            let item = item?;
            if is_unfinished(&item.file_name()) {
                std::fs::remove_dir_all(item.path())?;
            }
        }
        let files = tempfile::Builder::new().prefix(PREFIX).tempdir_in(out)?;
        Ok(Self { out: out.into(), is_new, files: Some(files) })
    }

    /// Where files are to be written.
    pub fn path(&self) -> &Path {
        self.files.as_ref().map_or(&self.out, |files| files.path())
    }

    /// Moves the files to where they are for, over those of the same names, one after the other. Returns the names.
    ///
    /// # Errors
    /// The operating system's.
    pub fn keep(mut self) -> std::io::Result<BTreeSet<OsString>> {
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
            // Only while nothing else is in it.
            let _ = std::fs::remove_dir(&self.out);
        }
    }
}

/// Whether a folder holds nothing but what kills have left in it; one that is not there does not.
///
/// # Errors
/// The operating system's.
pub fn is_empty(folder: &Path) -> std::io::Result<bool> {
    match std::fs::read_dir(folder) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(true),
        Err(error) => Err(error),
        Ok(items) => {
            for item in items {
                if !is_unfinished(&item?.file_name()) {
                    return Ok(false);
                }
            }
            Ok(true)
        }
    }
}

fn is_unfinished(name: &std::ffi::OsStr) -> bool {
    name.to_string_lossy().starts_with(PREFIX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let items = std::fs::read_dir(folder).unwrap();
        let mut names: Vec<String> = items.map(|item| item.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn files_appear_together_and_over_others() {
        let place = tempfile::tempdir().unwrap();
        let out = place.path().join("a/b");
        let work = StagedDir::new(&out).unwrap();
        std::fs::write(work.path().join("one"), "new").unwrap();
        std::fs::write(work.path().join("two"), "new").unwrap();
        std::fs::write(out.join("one"), "old").unwrap();
        std::fs::write(out.join("other"), "old").unwrap();
        let kept: Vec<OsString> = work.keep().unwrap().into_iter().collect();
        assert_eq!(kept, ["one", "two"]);
        assert_eq!(names(&out), ["one", "other", "two"]);
        assert_eq!(std::fs::read_to_string(out.join("one")).unwrap(), "new");
    }

    #[test]
    fn nothing_stays_of_what_was_not_kept_and_of_what_was_killed() {
        let place = tempfile::tempdir().unwrap();
        let out = place.path().join("out");
        let work = StagedDir::new(&out).unwrap();
        std::fs::write(work.path().join("one"), "").unwrap();
        drop(work);
        assert!(!out.exists(), "was made for it");

        std::fs::create_dir_all(out.join(".clift-unfinished-x")).unwrap();
        std::fs::write(out.join(".clift-unfinished-x/one"), "").unwrap();
        assert!(is_empty(&out).unwrap());
        drop(StagedDir::new(&out).unwrap());
        assert_eq!(names(&out), [""; 0], "was there, and stays");
        std::fs::write(out.join("mine"), "").unwrap();
        assert!(!is_empty(&out).unwrap());
        assert!(is_empty(&place.path().join("nowhere")).unwrap());
        assert!(is_empty(&out.join("mine")).is_err(), "a file");
    }
}
