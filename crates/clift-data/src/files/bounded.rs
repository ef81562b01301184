//! Reading whole files with a size limit, and JSON.

use std::io::Read;
use std::path::Path;

use serde::Deserialize;

use crate::error::DataError;

/// Reads a file of at most `limit` bytes. Folders, pipes and devices are refused before they are opened.
pub(crate) fn read_bounded(path: &Path, limit: u64, action: &'static str) -> Result<Vec<u8>, DataError> {
    let bad = |what: String| DataError::BadFile { what, path: path.to_owned() };
    let metadata = std::fs::metadata(path).map_err(DataError::io(action, path))?;
    if !metadata.is_file() {
        return Err(bad("expected a regular file".into()));
    }
    if metadata.len() > limit {
        return Err(bad(format!("the file has {} bytes, more than the limit of {limit}", metadata.len())));
    }
    let mut bytes = Vec::with_capacity(metadata.len() as usize);
    let file = std::fs::File::open(path).map_err(DataError::io(action, path))?;
    // A file that grows in the meantime is read up to its former size.
    file.take(metadata.len()).read_to_end(&mut bytes).map_err(DataError::io(action, path))?;
    Ok(bytes)
}

/// Reads the first `limit` bytes of a regular file; `None` for other objects and unreadable files.
pub(crate) fn read_start(path: &Path, limit: u64) -> Option<Vec<u8>> {
    let mut start = Vec::new();
    std::fs::metadata(path).ok()?.is_file().then_some(())?;
    std::fs::File::open(path).ok()?.take(limit).read_to_end(&mut start).ok()?;
    Some(start)
}

/// Parses JSON. A byte order mark in front, which editors on Windows write, is skipped.
pub(crate) fn parse_json<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, serde_json::Error> {
    serde_json::from_slice(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_files_and_other_objects_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        std::fs::write(&path, [7; 10]).unwrap();
        let read = |path: &Path, limit| read_bounded(path, limit, "reading it").map_err(|error| error.to_string());
        assert_eq!(read(&path, 10), Ok(vec![7; 10]));
        assert!(read(&path, 9).unwrap_err().contains("the file has 10 bytes, more than the limit of 9"));
        assert!(read(folder.path(), 10).unwrap_err().contains("expected a regular file"));
        assert!(read(&folder.path().join("b"), 10).unwrap_err().starts_with("reading it failed: "));
        #[cfg(unix)] // endless, with a length of 0
        assert!(read(Path::new("/dev/zero"), 10).unwrap_err().contains("expected a regular file"));
    }
}
