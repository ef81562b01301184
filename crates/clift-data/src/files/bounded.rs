//! Reading of whole files with a size limit.

use std::io::Read;
use std::path::Path;

use crate::error::DataError;

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
}
