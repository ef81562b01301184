//! Files and folders that are whole or absent: written under a temporary name, synced, renamed.
//!
//! A rename is on the disk once the folder it happened in is synced; until then a power cut may undo it.

use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::Path;

/// Start of every temporary file's name: what a kill leaves behind can be told from everything else.
pub const TEMPORARY: &str = ".clift-";

/// Replaces `path` with `bytes`. No reader ever sees half a file, and after an error the former one is untouched.
///
/// Unlike other temporary files, the result may be read by everyone whom the umask lets: it is meant to be kept.
///
/// # Errors
/// The operating system's.
pub fn replace(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let folder = folder_of(path);
    let mut builder = tempfile::Builder::new();
    builder.prefix(TEMPORARY);
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file = builder.tempfile_in(folder)?;
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    file.persist(path)?;
    sync_folder(folder)
}

/// Gives the finished folder `temporary` the name `path`, which must be free: syncs its files, then the folder, renames,
/// and syncs the rename. Folders inside it are not looked into.
///
/// # Errors
/// The operating system's.
pub fn publish(temporary: &Path, path: &Path) -> std::io::Result<()> {
    for item in std::fs::read_dir(temporary)? {
        // Opened for writing, because Windows syncs no other file.
        File::options().write(true).open(item?.path())?.sync_all()?;
    }
    sync_folder(temporary)?;
    std::fs::rename(temporary, path)?;
    sync_folder(folder_of(path))
}

/// Makes a folder, with those above it, that survives a power cut.
///
/// # Errors
/// The operating system's.
pub fn make_folder(path: &Path) -> std::io::Result<()> {
    let is_new = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
    let new: Vec<&Path> = path.ancestors().take_while(is_new).collect();
    std::fs::create_dir_all(path)?;
    new.into_iter().rev().try_for_each(|folder| sync_folder(folder_of(folder)))
}

/// Removes a folder so that a kill in the middle leaves no half of it under its name: it is renamed first.
///
/// # Errors
/// The operating system's.
pub fn remove_folder(path: &Path) -> std::io::Result<()> {
    let doomed = path.with_extension("tmp");
    if doomed.exists() {
        std::fs::remove_dir_all(&doomed)?;
    }
    std::fs::rename(path, &doomed)?;
    std::fs::remove_dir_all(&doomed)
}

/// Removes what kills in the middle of [`replace`], of saving weights or of [`crate::files::staged_dir::StagedDir`] have left in
/// a folder and in those below it. Nobody may be writing there.
///
/// # Errors
/// The operating system's; a folder that is not there holds nothing.
pub fn remove_leftovers(folder: &Path) -> std::io::Result<()> {
    let items = match std::fs::read_dir(folder) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        items => items?,
    };
    for item in items {
        let item = item?;
        let kind = item.file_type()?;
        let is_temporary = item.file_name().to_string_lossy().starts_with(TEMPORARY);
        match (is_temporary, kind.is_dir()) {
            (true, true) => std::fs::remove_dir_all(item.path())?,
            (true, false) if kind.is_file() => std::fs::remove_file(item.path())?,
            (false, true) => remove_leftovers(&item.path())?,
            _ => {}
        }
    }
    Ok(())
}

/// Makes renames and new names in a folder survive a power cut.
///
/// # Errors
/// The operating system's. A file system that syncs no folders is taken at its word, and so is Windows, which cannot
/// open one.
pub fn sync_folder(folder: &Path) -> std::io::Result<()> {
    if cfg!(windows) {
        return Ok(());
    }
    match File::open(folder)?.sync_all() {
        Err(error) if matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        synced => synced,
    }
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let items = std::fs::read_dir(folder).unwrap();
        let mut names: Vec<_> = items.map(|item| item.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_is_replaced_and_nothing_else_is_left_behind() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        replace(&path, b"old").unwrap();
        replace(&path, b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert_eq!(names(folder.path()), ["a.json"]);
        assert!(replace(&folder.path().join("missing/a.json"), b"x").is_err());
    }

    #[cfg(unix)]
    #[test]
    fn the_file_has_the_permissions_of_other_files() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let mode = |name: &str| std::fs::metadata(folder.path().join(name)).unwrap().permissions().mode();
        replace(&folder.path().join("ours"), b"x").unwrap();
        std::fs::write(folder.path().join("plain"), b"x").unwrap();
        assert_eq!(mode("ours"), mode("plain"));
    }

    #[test]
    fn a_folder_is_published_whole_and_only_under_a_free_name() {
        let place = tempfile::tempdir().unwrap();
        let (temporary, path) = (place.path().join("step-1.tmp"), place.path().join("step-1"));
        std::fs::create_dir(&temporary).unwrap();
        std::fs::write(temporary.join("model"), b"weights").unwrap();
        publish(&temporary, &path).unwrap();
        assert_eq!(std::fs::read(path.join("model")).unwrap(), b"weights");
        assert_eq!(names(place.path()), ["step-1"]);
        std::fs::create_dir(&temporary).unwrap();
        assert!(publish(&temporary, &path).is_err(), "the folder that is there is not empty");
        assert_eq!(names(&path), ["model"]);
    }

    #[test]
    fn folders_are_made_with_those_above_them_and_may_be_there_already() {
        let place = tempfile::tempdir().unwrap();
        for path in ["a/b/c", "a/b/c", "a/b/d"] {
            make_folder(&place.path().join(path)).unwrap();
        }
        assert_eq!(names(&place.path().join("a/b")), ["c", "d"]);
        std::fs::write(place.path().join("file"), b"x").unwrap();
        assert!(make_folder(&place.path().join("file/a")).is_err());
    }

    #[test]
    fn a_folder_is_removed_with_what_an_earlier_removal_left() {
        let place = tempfile::tempdir().unwrap();
        for name in ["step-1", "step-1.tmp"] {
            std::fs::create_dir(place.path().join(name)).unwrap();
            std::fs::write(place.path().join(name).join("model"), b"weights").unwrap();
        }
        remove_folder(&place.path().join("step-1")).unwrap();
        assert!(names(place.path()).is_empty());
        assert!(remove_folder(&place.path().join("step-1")).is_err());
    }

    #[test]
    fn leftovers_are_removed_from_every_folder_and_nothing_else() {
        let place = tempfile::tempdir().unwrap();
        std::fs::create_dir(place.path().join("eval")).unwrap();
        std::fs::create_dir_all(place.path().join("stage2/.clift-z3")).unwrap();
        let files =
            [".clift-x1", "eval/.clift-y2", "stage2/.clift-z3/.tmpQ", "eval/report.html", ".hidden", "clift-notes"];
        for name in files {
            std::fs::write(place.path().join(name), b"x").unwrap();
        }
        remove_leftovers(place.path()).unwrap();
        assert_eq!(names(place.path()), [".hidden", "clift-notes", "eval", "stage2"]);
        assert!(names(&place.path().join("stage2")).is_empty());
        assert_eq!(names(&place.path().join("eval")), ["report.html"]);
        remove_leftovers(&place.path().join("missing")).unwrap();
    }

    /// What `replace` leaves when the process is killed before the rename is found by its name.
    #[test]
    fn temporary_files_have_the_name_that_leftovers_are_known_by() {
        let place = tempfile::tempdir().unwrap();
        let file = tempfile::Builder::new().prefix(TEMPORARY).tempfile_in(place.path()).unwrap();
        let (_, path) = file.keep().unwrap();
        remove_leftovers(place.path()).unwrap();
        assert!(!path.exists());
    }
}
