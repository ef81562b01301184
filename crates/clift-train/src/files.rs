//! Files that are whole or absent: written under a temporary name, synced, renamed.

use std::path::Path;

use crate::TrainError;

/// Replaces `path` with `bytes`.
///
/// # Errors
/// [`TrainError::Io`]; the former file is then untouched.
pub fn write(path: &Path, bytes: &[u8]) -> Result<(), TrainError> {
    use std::io::Write;
    let folder = path.parent().unwrap_or(Path::new("."));
    let write = || {
        let mut file = tempfile::NamedTempFile::new_in(folder)?;
        file.write_all(bytes)?;
        file.as_file().sync_all()?;
        file.persist(path).map_err(|error| error.error)
    };
    write().map(|_| ()).map_err(TrainError::io("writing", path))
}
