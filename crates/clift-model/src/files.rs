//! Atomic writes of one file: a file under its final name is always complete.

use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::Path;

/// Start of every temporary name, so that the leftovers of a killed process can be recognised.
pub(crate) const TEMPORARY: &str = ".clift-";

/// The folder that holds `path`.
pub(crate) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Replaces the file at `path` with `bytes`. The umask decides who may read the file.
pub(crate) fn replace(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(TEMPORARY);
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file = builder.tempfile_in(folder_of(path))?;
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    file.persist(path)?;
    sync_folder(path)
}

/// Renames the finished file `temporary` to `path`, with the permissions that a new file would have.
pub(crate) fn publish(temporary: &Path, path: &Path) -> std::io::Result<()> {
    // Opened for writing, because Windows syncs no other file.
    let file = File::options().write(true).open(temporary)?;
    let usual = File::create(temporary.with_extension("usual"))?.metadata()?.permissions();
    file.set_permissions(usual)?;
    file.sync_all()?;
    std::fs::rename(temporary, path)?;
    sync_folder(path)
}

/// Makes the name of a file survive a power cut, on systems that can sync a folder.
fn sync_folder(path: &Path) -> std::io::Result<()> {
    if cfg!(windows) {
        return Ok(()); // Windows opens no folders
    }
    match File::open(folder_of(path))?.sync_all() {
        Err(error) if matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        synced => synced,
    }
}
