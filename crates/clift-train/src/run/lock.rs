//! One process per run directory.

use std::fs::{File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::Path;

use crate::error::TrainError;
use crate::events::{Event, Sink};

/// Lock of a run directory. The operating system releases the lock when the process ends; a remaining file `lock` has no
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
    /// Locks the run in the existing `folder`. A file system without locks gives a warning only.
    pub fn take(folder: &Path, sink: &mut dyn Sink) -> Result<Self, TrainError> {
        let path = folder.join("lock");
        let opened = File::options().read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = opened.map_err(TrainError::io("opening the lock of the run directory", &path))?;
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
                return Err(TrainError::Locked { holder, path: folder.into() });
            }
            Err(TryLockError::Error(error)) => {
                let text = format!("the run directory cannot be locked, do not start a second process in it: {error}");
                sink.event(&Event::Warning(text));
            }
        }
        Ok(Self { file })
    }
}
