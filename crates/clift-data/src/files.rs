//! Files that are whole or absent, and files that are read up to a limit.

use std::io::{Read, Write};
use std::path::Path;

use crate::error::DataError;

/// Replaces `path` with `bytes`. No reader ever sees half a file, and after an error the former one is untouched.
///
/// Unlike other temporary files, the result may be read by everyone whom the umask lets: it is meant to be kept.
///
/// # Errors
/// The operating system's.
pub fn replace(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file = builder.tempfile_in(folder)?;
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    file.persist(path)?;
    Ok(())
}

/// Reads a file of at most `limit` bytes. Anything but a file (a folder, a pipe that never ends) is refused before it
/// is opened.
pub(crate) fn read_bounded(path: &Path, limit: u64, action: &'static str) -> Result<Vec<u8>, DataError> {
    let bad = |what: String| DataError::BadScene { what, path: path.to_owned() };
    let metadata = std::fs::metadata(path).map_err(DataError::io(action, path))?;
    if !metadata.is_file() {
        return Err(bad("expected a file, and it is none".into()));
    }
    if metadata.len() > limit {
        return Err(bad(format!("the file has {} bytes, more than the limit of {limit}", metadata.len())));
    }
    let mut bytes = Vec::with_capacity(metadata.len() as usize);
    let file = std::fs::File::open(path).map_err(DataError::io(action, path))?;
    // A file that grows meanwhile is cut off at its former size.
    file.take(metadata.len()).read_to_end(&mut bytes).map_err(DataError::io(action, path))?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_and_nothing_else_is_left_behind() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        replace(&path, b"old").unwrap();
        replace(&path, b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        assert!(replace(&folder.path().join("missing/a.json"), b"x").is_err());
    }

    #[test]
    fn a_file_above_the_limit_and_what_is_no_file_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        std::fs::write(&path, [7; 10]).unwrap();
        let read = |path: &Path, limit| read_bounded(path, limit, "reading it").map_err(|error| error.to_string());
        assert_eq!(read(&path, 10), Ok(vec![7; 10]));
        assert!(read(&path, 9).unwrap_err().contains("the file has 10 bytes, more than the limit of 9"));
        assert!(read(folder.path(), 10).unwrap_err().contains("expected a file, and it is none"));
        assert!(read(&folder.path().join("b"), 10).unwrap_err().starts_with("reading it failed: "));
        #[cfg(unix)] // endless, and says it has no bytes
        assert!(read(Path::new("/dev/zero"), 10).unwrap_err().contains("expected a file"));
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
}
