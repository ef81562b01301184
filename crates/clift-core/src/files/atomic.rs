//! Atomic writes: a file or folder is written under a temporary name, synced and renamed, so that it is complete under
//! its final name. The parent folder is synced as well; without that, a power cut may undo the rename.

use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::Path;

/// Prefix of the names of temporary files and folders; [`remove_leftovers`] finds them by it.
pub const TEMPORARY: &str = ".clift-";

/// Replaces the file at `path` atomically; after an error the former file is unchanged. The file has the permissions of
/// the umask.
pub fn replace_file(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
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

/// Renames the finished file `temporary` to `path`, with the permissions that a new file would have.
pub fn publish_file(temporary: &Path, path: &Path) -> std::io::Result<()> {
    // Windows syncs only files that are open for writing.
    let file = File::options().write(true).open(temporary)?;
    let usual = File::create(temporary.with_extension("usual"))?.metadata()?.permissions();
    file.set_permissions(usual)?;
    file.sync_all()?;
    std::fs::rename(temporary, path)?;
    sync_folder(folder_of(path))
}

/// Renames the finished folder `temporary` to `path`, which must not exist, after syncing its files. Subfolders are not
/// allowed.
pub fn publish_folder(temporary: &Path, path: &Path) -> std::io::Result<()> {
    for item in std::fs::read_dir(temporary)? {
        // Windows syncs only files that are open for writing.
        File::options().write(true).open(item?.path())?.sync_all()?;
    }
    sync_folder(temporary)?;
    std::fs::rename(temporary, path)?;
    sync_folder(folder_of(path))
}

/// Creates a folder and its missing parents, and syncs them.
pub fn make_folder(path: &Path) -> std::io::Result<()> {
    let is_new = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
    let new: Vec<&Path> = path.ancestors().take_while(is_new).collect();
    std::fs::create_dir_all(path)?;
    new.into_iter().rev().try_for_each(|folder| sync_folder(folder_of(folder)))
}

/// Removes a folder atomically: renames it first, then deletes it.
pub fn remove_folder(path: &Path) -> std::io::Result<()> {
    let doomed = path.with_extension("tmp");
    if doomed.exists() {
        std::fs::remove_dir_all(&doomed)?;
    }
    std::fs::rename(path, &doomed)?;
    std::fs::remove_dir_all(&doomed)
}

/// Removes the temporary files and folders that killed processes left in `folder` and below it. No other process may
/// write there. A missing folder is not an error.
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

/// Syncs the names in a folder, where the system supports that: Windows and some file systems do not.
pub fn sync_folder(folder: &Path) -> std::io::Result<()> {
    if cfg!(windows) {
        return Ok(());
    }
    match File::open(folder)?.sync_all() {
        Err(error) if matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        synced => synced,
    }
}

/// Returns the folder of a file: `.` for a bare name.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::names;

    #[test]
    fn replaced_files_leave_no_temporary_files_and_have_ordinary_permissions() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ours");
        replace_file(&path, b"old").unwrap();
        replace_file(&path, b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        std::fs::write(folder.path().join("plain"), b"x").unwrap();
        assert_eq!(names(folder.path()), ["ours", "plain"]);
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let mode = |name: &str| std::fs::metadata(folder.path().join(name)).unwrap().permissions().mode();
            assert_eq!(mode("ours"), mode("plain"));
        }
        assert!(replace_file(&folder.path().join("missing/a.json"), b"x").is_err());
    }

    #[test]
    fn folders_are_published_under_free_names_only() {
        let root = tempfile::tempdir().unwrap();
        let (temporary, path) = (root.path().join("step-1.tmp"), root.path().join("step-1"));
        std::fs::create_dir(&temporary).unwrap();
        std::fs::write(temporary.join("model"), b"weights").unwrap();
        publish_folder(&temporary, &path).unwrap();
        assert_eq!(std::fs::read(path.join("model")).unwrap(), b"weights");
        assert_eq!(names(root.path()), ["step-1"]);
        std::fs::create_dir(&temporary).unwrap();
        assert!(publish_folder(&temporary, &path).is_err(), "the target exists and is not empty");
        assert_eq!(names(&path), ["model"]);
    }

    #[test]
    fn folders_are_made_with_their_parents_and_removed_with_former_remains() {
        let root = tempfile::tempdir().unwrap();
        for path in ["a/b/c", "a/b/c", "a/b/d"] {
            make_folder(&root.path().join(path)).unwrap();
        }
        assert_eq!(names(&root.path().join("a/b")), ["c", "d"]);
        std::fs::create_dir(root.path().join("a.tmp")).unwrap();
        remove_folder(&root.path().join("a")).unwrap();
        assert!(names(root.path()).is_empty());
        assert!(remove_folder(&root.path().join("a")).is_err());
    }

    #[test]
    fn only_leftovers_are_removed_from_all_folders() {
        let root = tempfile::tempdir().unwrap();
        std::fs::create_dir(root.path().join("eval")).unwrap();
        std::fs::create_dir_all(root.path().join("stage2/.clift-z3")).unwrap();
        let files =
            [".clift-x1", "eval/.clift-y2", "stage2/.clift-z3/.tmpQ", "eval/report.html", ".hidden", "clift-notes"];
        for name in files {
            std::fs::write(root.path().join(name), b"x").unwrap();
        }
        remove_leftovers(root.path()).unwrap();
        assert_eq!(names(root.path()), [".hidden", "clift-notes", "eval", "stage2"]);
        assert!(names(&root.path().join("stage2")).is_empty());
        assert_eq!(names(&root.path().join("eval")), ["report.html"]);
        remove_leftovers(&root.path().join("missing")).unwrap();
    }
}
