//! The output folder of an evaluation.

use std::path::{Path, PathBuf};

use clift_eval::Summary;

use crate::error::{TrainError, bad};
use crate::events::{Event, Sink};
use crate::run::lock::{LockedFolder, RunLock};

/// The file that every evaluation writes.
pub(crate) const SUMMARY: &str = "summary.json";

/// An output folder, locked until it is dropped: no other process evaluates into it.
#[derive(Debug)]
pub struct EvalFolder {
    path: PathBuf,
    _lock: Option<RunLock>,
}

impl EvalFolder {
    /// Makes and locks a folder. A folder with an evaluation is refused, unless `replace` is set.
    ///
    /// # Errors
    /// [`TrainError::BadConfig`] for an existing evaluation, [`TrainError::Locked`] if another process evaluates into the
    /// folder, [`TrainError::Io`].
    pub fn open(path: &Path, replace: bool, sink: &mut dyn Sink) -> Result<Self, TrainError> {
        std::fs::create_dir_all(path).map_err(TrainError::io("making a folder", path))?;
        let lock = RunLock::take(path, LockedFolder::Evaluation, sink)?;
        if !replace && path.join(SUMMARY).exists() {
            let fix = "the folder holds an evaluation; replace it with --force, or set another --out";
            return Err(bad("--out", path.display(), fix));
        }
        Ok(Self { path: path.into(), _lock: Some(lock) })
    }

    /// Returns the folder of a rank that does not write.
    pub(crate) fn unlocked(path: PathBuf) -> Self {
        Self { path, _lock: None }
    }

    /// Returns the path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether the folder lies in `folder`, whichever links lead there.
    pub(crate) fn is_in(&self, folder: &Path) -> bool {
        let real = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.into());
        real(&self.path).starts_with(real(folder))
    }
}

/// Reads the evaluation of a run that has no work left.
pub(crate) fn read_finished(run_dir: &Path, sink: &mut dyn Sink) -> Result<Summary, TrainError> {
    let run = run_dir.display();
    sink.event(&Event::Message(format!(
        "the run is trained and evaluated; `clift eval {run} --force` evaluates it again"
    )));
    let path = run_dir.join("eval").join(SUMMARY);
    let text = std::fs::read(&path).map_err(TrainError::io("reading the evaluation", &path))?;
    serde_json::from_slice(&text).map_err(TrainError::bad_file("evaluation", &path))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(path: &Path, replace: bool) -> Result<EvalFolder, TrainError> {
        EvalFolder::open(path, replace, &mut |_: &Event| {})
    }

    #[test]
    fn evaluations_are_replaced_only_on_request() {
        let place = tempfile::tempdir().unwrap();
        let out = place.path().join("eval");
        drop(open(&out, false).unwrap());
        std::fs::write(out.join(SUMMARY), "{}").unwrap();
        let message = open(&out, false).unwrap_err().to_string();
        assert!(message.contains("`--out` = ") && message.contains("--force"), "{message}");
        open(&out, true).unwrap();
    }

    #[test]
    fn second_evaluations_of_a_folder_are_refused_at_once() {
        let place = tempfile::tempdir().unwrap();
        let first = open(place.path(), false).unwrap();
        let message = open(place.path(), true).unwrap_err().to_string();
        let holder = format!("is in use by process {}; wait until it exits or set another --out", std::process::id());
        assert!(message.contains(&holder), "{message}");
        drop(first);
        open(place.path(), true).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn links_into_a_run_are_resolved() {
        let place = tempfile::tempdir().unwrap();
        let (run, link) = (place.path().join("run"), place.path().join("link"));
        std::fs::create_dir(&run).unwrap();
        std::os::unix::fs::symlink(&run, &link).unwrap();
        let is_in_run = |path: &Path| open(path, false).unwrap().is_in(&run);
        assert!(is_in_run(&link.join("a")) && is_in_run(&run.join("../run/b")));
        assert!(!is_in_run(&place.path().join("c")));
    }
}
