//! One process per run directory, and per output folder of an evaluation.

use std::fs::{File, TryLockError};
use std::io::{ErrorKind, Read, Seek, Write};
use std::path::Path;

use clift_core::TEMPORARY;

use crate::error::TrainError;
use crate::events::{Event, Sink};

/// What a locked folder is, and where else to write.
pub(crate) type LockedFolder = (&'static str, &'static str);

/// The directory of a run that is trained.
pub(crate) const RUN: LockedFolder = ("run directory", "another `run_dir`");
/// The directory of a run that is evaluated into it.
pub(crate) const EVALUATED_RUN: LockedFolder = ("run directory", "an --out outside of it");
/// The directory of a run whose codec is fitted.
pub(crate) const FITTED_RUN: LockedFolder = ("run directory", "another model");
/// The output folder of an evaluation.
pub(crate) const EVALUATION: LockedFolder = ("output folder", "another --out");

/// Name of the lock in its folder.
pub(crate) const LOCK: &str = "lock";

/// Whether a folder has files besides a lock and the temporary files of killed processes. A missing folder, and a
/// path that is not a folder, have none.
pub(crate) fn has_other_files(folder: &Path) -> Result<bool, TrainError> {
    let items = match std::fs::read_dir(folder) {
        Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => return Ok(false),
        items => items.and_then(Iterator::collect::<Result<Vec<_>, _>>),
    };
    let items = items.map_err(TrainError::io("reading the folder", folder))?;
    let is_other = |name: &str| name != LOCK && !name.starts_with(TEMPORARY);
    Ok(items.iter().any(|item| is_other(&item.file_name().to_string_lossy())))
}

/// Lock of a folder. The operating system releases the lock when the process ends; a remaining file `lock` has no
/// effect.
#[derive(Debug)]
pub struct RunLock {
    file: File,
}

impl Drop for RunLock {
    fn drop(&mut self) {
        // Removes the process id.
        let _ = self.file.set_len(0);
    }
}

impl RunLock {
    /// Locks the existing `folder`. A file system without locks gives a warning only.
    pub(crate) fn take(
        folder: &Path,
        (what, elsewhere): LockedFolder,
        sink: &mut dyn Sink,
    ) -> Result<Self, TrainError> {
        let path = folder.join(LOCK);
        let opened = File::options().read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = opened.map_err(TrainError::io("opening the lock of the folder", &path))?;
        match file.try_lock() {
            Ok(()) => {
                // The process id is for error messages; the lock also works without it.
                let _ = file.set_len(0).and_then(|()| write!(file, "{}", std::process::id()));
            }
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                // Windows refuses to read a locked file.
                let _ = file.rewind().and_then(|()| file.read_to_string(&mut holder));
                let is_id = !holder.is_empty() && holder.bytes().all(|byte| byte.is_ascii_digit());
                let holder = if is_id { format!("process {holder}") } else { "another process".into() };
                return Err(TrainError::Locked { what, holder, elsewhere, path: folder.into() });
            }
            Err(TryLockError::Error(error)) => {
                let text = format!("the {what} cannot be locked, do not start a second process in it: {error}");
                sink.event(&Event::Warning(text));
            }
        }
        Ok(Self { file })
    }
}
