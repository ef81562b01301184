//! The output folder of an evaluation.

use std::path::{Path, PathBuf};

use clift_eval::Summary;

use crate::error::{TrainError, bad};
use crate::events::{Event, Sink};
use crate::run::lock::{EVALUATION, LOCK, RunLock, has_other_files};

/// The file that every evaluation writes.
pub(crate) const SUMMARY: &str = "summary.json";

/// Files that are replaced on request only.
const RESULTS: [&str; 4] = [SUMMARY, "scenes.csv", "views.csv", "report.html"];

/// An output folder, locked until it is dropped: no other process evaluates into it. A new folder without results goes again.
#[derive(Debug)]
pub struct EvalFolder {
    path: PathBuf,
    _lock: RunLock,
    is_new: bool,
}

impl Drop for EvalFolder {
    fn drop(&mut self) {
        if self.is_new && has_other_files(&self.path).is_ok_and(|has_results| !has_results) {
            drop(std::fs::remove_file(self.path.join(LOCK)).and_then(|()| std::fs::remove_dir(&self.path)));
        }
    }
}

impl EvalFolder {
    /// Makes and locks a folder. A folder with results is refused unless `replace` is set, one with files of something other
    /// than an evaluation always. A refused folder is not changed.
    ///
    /// # Errors
    /// [`TrainError::BadConfig`] for a refused folder, [`TrainError::Locked`] if another process evaluates into the
    /// folder, [`TrainError::Io`].
    pub fn open(path: &Path, replace: bool, sink: &mut dyn Sink) -> Result<Self, TrainError> {
        let has = |name: &str| path.join(name).exists();
        let refuse = |fix: &str| Err(bad("--out", path.display(), fix));
        let is_evaluation = has(SUMMARY) || (has(LOCK) && !has("run.json"));
        if !is_evaluation && has_other_files(path)? {
            return refuse("the folder has files and is not an evaluation; set another --out");
        }
        if !replace && RESULTS.into_iter().any(has) {
            return refuse("the folder holds an evaluation; replace it with --force, or set another --out");
        }
        let is_new = !path.exists();
        std::fs::create_dir_all(path).map_err(TrainError::io("making a folder", path))?;
        Ok(Self { path: path.into(), _lock: RunLock::take(path, EVALUATION, sink)?, is_new })
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
        assert!(!out.exists(), "a new folder without results goes again");
        let new = open(&out, false).unwrap();
        std::fs::write(out.join(SUMMARY), "{}").unwrap();
        drop(new);
        let message = open(&out, false).unwrap_err().to_string();
        assert!(message.contains("`--out` = ") && message.contains("--force"), "{message}");
        open(&out, true).unwrap();
        // An unfinished evaluation, and one whose summary was removed.
        std::fs::remove_file(out.join(SUMMARY)).unwrap();
        drop(open(&out, false).unwrap());
        std::fs::write(out.join("views.csv"), "").unwrap();
        assert!(open(&out, false).unwrap_err().to_string().contains("--force"));
        open(&out, true).unwrap();
    }

    #[test]
    fn folders_of_other_files_are_refused_unchanged() {
        let place = tempfile::tempdir().unwrap();
        for file in ["views.csv", "letter.txt", "run.json"] {
            let folder = place.path().join(format!("folder of {file}"));
            std::fs::create_dir(&folder).unwrap();
            std::fs::write(folder.join(file), "mine").unwrap();
            let message = open(&folder, true).unwrap_err().to_string();
            assert!(message.contains("is not an evaluation; set another --out"), "{message}");
            assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1, "no lock stays beside {file}");
        }
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
