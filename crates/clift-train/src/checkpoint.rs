//! The state of a stage on disk: a folder per step, written under a temporary name and renamed.

use std::path::PathBuf;

use burn::module::Module;
use burn::store::ModuleRecord;
use clift_data::files::replace;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::step::Learner;

const VERSION: u32 = 1;

/// What `state.json` of a checkpoint holds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    version: u32,
    /// Updates made.
    step: u64,
    /// Updates in a row that were left out just before.
    bad_steps: u32,
}

/// The checkpoints of one stage.
#[derive(Clone, Debug)]
pub struct Checkpoints {
    folder: PathBuf,
    keep: usize,
}

/// Where training goes on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Progress {
    /// Updates made.
    pub step: u64,
    /// Updates in a row that were left out just before.
    pub bad_steps: u32,
}

impl Checkpoints {
    /// Keeps the newest `keep` checkpoints in `folder`.
    pub fn new(folder: PathBuf, keep: usize) -> Self {
        Self { folder, keep }
    }

    /// Saves model, optimiser and progress, and removes checkpoints beyond the newest.
    ///
    /// # Errors
    /// [`TrainError::Io`] and [`TrainError::BadFile`]; older checkpoints are then untouched.
    pub fn save(&self, learner: &Learner, progress: Progress) -> Result<PathBuf, TrainError> {
        let path = self.folder.join(format!("step-{:09}", progress.step));
        let temporary = path.with_extension("tmp");
        if temporary.exists() {
            std::fs::remove_dir_all(&temporary).map_err(TrainError::io("removing an unfinished save", &temporary))?;
        }
        std::fs::create_dir_all(&temporary).map_err(TrainError::io("making a checkpoint", &temporary))?;
        let model = temporary.join("model.bpk");
        learner.model.clone().into_record().save(&model).map_err(TrainError::bad_file("checkpoint", &model))?;
        let optimizer = temporary.join("optimizer.bpk");
        learner.optimizer.save(&optimizer).map_err(TrainError::bad_file("checkpoint", &optimizer))?;
        let state = State { version: VERSION, step: progress.step, bad_steps: progress.bad_steps };
        let text = serde_json::to_vec(&state).map_err(TrainError::bad_file("checkpoint", &temporary))?;
        let state = temporary.join("state.json");
        replace(&state, &text).map_err(TrainError::io("writing a checkpoint", &state))?;
        for file in [&model, &optimizer] {
            let synced = std::fs::File::open(file).and_then(|file| file.sync_all());
            synced.map_err(TrainError::io("syncing a checkpoint", file))?;
        }
        if path.exists() {
            std::fs::remove_dir_all(&path).map_err(TrainError::io("replacing a checkpoint", &path))?;
        }
        std::fs::rename(&temporary, &path).map_err(TrainError::io("renaming a checkpoint", &path))?;
        self.prune()?;
        Ok(path)
    }

    /// Loads the newest checkpoint into a learner; `None` when there is none.
    ///
    /// # Errors
    /// [`TrainError::BadFile`] for a damaged checkpoint: nothing is started over in silence.
    pub fn resume(&self, learner: &mut Learner) -> Result<Option<Progress>, TrainError> {
        let Some(path) = self.list()?.pop() else { return Ok(None) };
        let state_path = path.join("state.json");
        let text = std::fs::read(&state_path).map_err(TrainError::io("reading a checkpoint", &state_path))?;
        let state: State = serde_json::from_slice(&text).map_err(TrainError::bad_file("checkpoint", &state_path))?;
        if state.version != VERSION {
            let reason = format!("it has version {}, this program reads {VERSION}", state.version);
            return Err(TrainError::bad_file("checkpoint", &state_path)(reason));
        }
        let model = path.join("model.bpk");
        let record = ModuleRecord::load(&model).map_err(TrainError::bad_file("checkpoint", &model))?;
        let loaded = learner.model.clone().try_load_record(record);
        learner.model = loaded.map_err(|error| TrainError::bad_file("checkpoint", &model)(format!("{error:?}")))?;
        let optimizer = path.join("optimizer.bpk");
        let loaded = learner.optimizer.clone().load(&optimizer);
        learner.optimizer = loaded.map_err(TrainError::bad_file("checkpoint", &optimizer))?;
        Ok(Some(Progress { step: state.step, bad_steps: state.bad_steps }))
    }

    /// The newest checkpoint.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn newest(&self) -> Result<Option<PathBuf>, TrainError> {
        Ok(self.list()?.pop())
    }

    /// Complete checkpoints, oldest first.
    fn list(&self) -> Result<Vec<PathBuf>, TrainError> {
        if !self.folder.exists() {
            return Ok(Vec::new());
        }
        let mut found = Vec::new();
        for item in std::fs::read_dir(&self.folder).map_err(TrainError::io("listing checkpoints", &self.folder))? {
            let path = item.map_err(TrainError::io("listing checkpoints", &self.folder))?.path();
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            if let Some(step) = name.strip_prefix("step-").and_then(|step| step.parse::<u64>().ok()) {
                found.push((step, path));
            }
        }
        found.sort();
        Ok(found.into_iter().map(|(_, path)| path).collect())
    }

    /// Removes checkpoints beyond the newest, and what a save that was killed has left.
    fn prune(&self) -> Result<(), TrainError> {
        let listing = "listing checkpoints";
        for item in std::fs::read_dir(&self.folder).map_err(TrainError::io(listing, &self.folder))? {
            let path = item.map_err(TrainError::io(listing, &self.folder))?.path();
            if path.extension().is_some_and(|extension| extension == "tmp") {
                std::fs::remove_dir_all(&path).map_err(TrainError::io("removing an unfinished save", &path))?;
            }
        }
        let all = self.list()?;
        for path in &all[..all.len().saturating_sub(self.keep)] {
            std::fs::remove_dir_all(path).map_err(TrainError::io("removing an old checkpoint", path))?;
        }
        Ok(())
    }
}
