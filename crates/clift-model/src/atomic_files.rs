//! Atomic writes of one file: a file under its final name is always complete.

use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::Path;

/// Prefix of temporary file names, which identifies files left by a killed process.
pub(crate) const TEMPORARY: &str = ".clift-";

pub(crate) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Replaces the file at `path` with `bytes`. Permissions follow the umask.
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
    // Windows syncs only files that are open for writing.
    let file = File::options().write(true).open(temporary)?;
    let usual = File::create(temporary.with_extension("usual"))?.metadata()?.permissions();
    file.set_permissions(usual)?;
    file.sync_all()?;
    std::fs::rename(temporary, path)?;
    sync_folder(path)
}

/// Syncs the folder of a file, so that the file's name survives a power failure, on systems that can sync folders.
fn sync_folder(path: &Path) -> std::io::Result<()> {
    if cfg!(windows) {
        return Ok(()); // Windows does not open folders
    }
    match File::open(folder_of(path))?.sync_all() {
        Err(error) if matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        synced => synced,
    }
}
