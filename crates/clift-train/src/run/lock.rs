//! One process per run directory.

use std::fs::{File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::Path;

use crate::error::TrainError;
use crate::events::{Event, Sink};

/// Holds a run directory. The lock is the operating system's: it ends with the process, however that ends, and the
/// file `lock` that stays behind means nothing.
#[derive(Debug)]
pub struct RunLock {
    file: File,
}

impl Drop for RunLock {
    fn drop(&mut self) {
        // The id of a process that is gone would mislead.
        let _ = self.file.set_len(0);
    }
}

impl RunLock {
    /// Takes the run in `folder`, which must exist.
    ///
    /// A file system without locks is used without one, and the sink is told.
    ///
    /// # Errors
    /// [`TrainError::Locked`] while another process holds it, [`TrainError::Io`] where the file cannot be opened.
    pub fn take(folder: &Path, sink: &mut dyn Sink) -> Result<Self, TrainError> {
        let path = folder.join("lock");
        let opened = File::options().read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = opened.map_err(TrainError::io("opening the lock of the run directory", &path))?;
        match file.try_lock() {
            Ok(()) => {
                // For the message of a process that is refused; the lock holds without it, on a full disk say.
                let _ = file.set_len(0).and_then(|()| write!(file, "{}", std::process::id()));
            }
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                // Windows lets nobody read a locked file.
                let _ = file.rewind().and_then(|()| file.read_to_string(&mut holder));
                let is_id = !holder.is_empty() && holder.bytes().all(|byte| byte.is_ascii_digit());
                let holder = if is_id { format!("process {holder}") } else { "another process".into() };
                return Err(TrainError::Locked { holder, path: folder.into() });
            }
            Err(TryLockError::Error(error)) => {
                let text = format!("no lock on the run directory, start no second process in it: {error}");
                sink.event(&Event::Warning(text));
            }
        }
        Ok(Self { file })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Silent;
    impl Sink for Silent {
        fn event(&mut self, _event: &Event) {}
    }

    #[test]
    fn a_second_lock_is_refused_with_the_holder_until_the_first_is_gone() {
        let folder = tempfile::tempdir().unwrap();
        let lock = RunLock::take(folder.path(), &mut Silent).unwrap();
        let error = RunLock::take(folder.path(), &mut Silent).unwrap_err();
        let TrainError::Locked { holder, path } = error else { panic!("{error}") };
        assert_eq!(holder, format!("process {}", std::process::id()));
        assert_eq!(path, folder.path());
        drop(lock);
        assert_eq!(std::fs::read(folder.path().join("lock")).unwrap(), b"");
        RunLock::take(folder.path(), &mut Silent).unwrap();
    }

    #[test]
    fn a_lock_file_that_a_dead_process_left_locks_nothing() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("lock"), "4194303").unwrap();
        let _lock = RunLock::take(folder.path(), &mut Silent).unwrap();
        let id = std::fs::read_to_string(folder.path().join("lock")).unwrap();
        assert_eq!(id, std::process::id().to_string(), "and the former id is gone");
    }
}
