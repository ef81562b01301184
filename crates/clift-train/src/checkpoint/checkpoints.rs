//! Checkpoints of a stage: a folder per step, written under a temporary name, synced and renamed.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::optim::OptimizerRecord;
use burn::store::ModuleRecord;
use clift_core::{make_folder, publish_folder, remove_folder};
use clift_model::{ModelConfig, Network, first_not_f32};

use crate::checkpoint::progress::{Fingerprint, STATE, State, TrainingPosition, VERSION};
use crate::error::{TrainError, bad};
use crate::step::train_state::TrainState;

const MODEL: &str = "model.bpk";
const OPTIMIZER: &str = "optimizer.bpk";
const SAVING: &str = "writing a checkpoint";
const LOADING: &str = "loading a checkpoint";

/// The checkpoints of one stage.
#[derive(Clone, Debug)]
pub struct Checkpoints {
    /// Folder of the checkpoints.
    pub folder: PathBuf,
    /// Config of the network: stored in every checkpoint, and checkpoints of another network are refused.
    pub model: Option<ModelConfig>,
}

impl Checkpoints {
    /// Saves model, optimizer and progress, and removes all checkpoints but the newest `keep`.
    ///
    /// # Errors
    /// [`TrainError::Io`]; older checkpoints are then unchanged, and files of this one are removed.
    pub fn save(
        &self,
        train_state: &TrainState,
        progress: &TrainingPosition,
        keep: usize,
    ) -> Result<PathBuf, TrainError> {
        let path = self.path_of(progress.step);
        let temporary = path.with_extension("tmp");
        remove_if_present(&temporary)?;
        let written = self.write(train_state, progress, &temporary, &path);
        if written.is_err() {
            // Frees the space on a full disk. The next save removes remaining files.
            drop(std::fs::remove_dir_all(&temporary));
        }
        written?;
        self.prune(keep)?;
        Ok(path)
    }

    fn write(
        &self,
        train_state: &TrainState,
        progress: &TrainingPosition,
        temporary: &Path,
        path: &Path,
    ) -> Result<(), TrainError> {
        make_folder(temporary).map_err(TrainError::io("making a checkpoint", temporary))?;
        let [model, optimizer] = [MODEL, OPTIMIZER].map(|name| temporary.join(name));
        let saved = train_state.model.clone().into_record().save(&model);
        saved.map_err(std::io::Error::other).map_err(TrainError::io(SAVING, &model))?;
        let saved = train_state.optimizer.to_record().save(&optimizer);
        saved.map_err(std::io::Error::other).map_err(TrainError::io(SAVING, &optimizer))?;
        let mut files = BTreeMap::new();
        for name in [MODEL, OPTIMIZER] {
            let file = temporary.join(name);
            files.insert(name.to_owned(), Fingerprint::of(&file).map_err(TrainError::io(SAVING, &file))?);
        }
        let (progress, model, loss_scale) = (progress.clone(), self.model.clone(), train_state.loss_scale);
        State { version: VERSION, progress, files, model, loss_scale }.write(temporary)?;
        if path.exists() {
            // Exists only if newer checkpoints were moved away and these steps are trained again.
            std::fs::remove_dir_all(path).map_err(TrainError::io("replacing a checkpoint", path))?;
        }
        publish_folder(temporary, path).map_err(TrainError::io(SAVING, path))
    }

    /// Writes the progress after a validation to the checkpoint of its step.
    pub fn update(&self, progress: &TrainingPosition) -> Result<(), TrainError> {
        let path = self.path_of(progress.step);
        State { progress: progress.clone(), ..State::read(&path)? }.write(&path)
    }

    /// Loads the checkpoint of a step into `train_state`, and changes no file.
    ///
    /// # Errors
    /// [`TrainError::Damaged`] for a file that is missing or has another length or checksum, [`TrainError::BadConfig`] for a
    /// checkpoint of another network, [`TrainError::BadFile`] for contents that cannot be used, [`TrainError::Io`] for files
    /// that cannot be read, and if Burn panics.
    pub fn load(&self, step: u64, train_state: &mut TrainState) -> Result<TrainingPosition, TrainError> {
        let path = self.path_of(step);
        let state = verify(&path).map_err(|source| {
            match &source {
                TrainError::BadFile { .. } => {}
                TrainError::Io { source, .. } if source.kind() == std::io::ErrorKind::NotFound => {}
                _ => return source,
            }
            let is_whole = |older: &u64| *older < step && verify(&self.path_of(*older)).is_ok();
            let fix = match self.steps().unwrap_or_default().into_iter().rfind(is_whole) {
                Some(older) => format!("move {} to another folder to resume from {}", name_of(step), name_of(older)),
                None => {
                    "the stage has no undamaged checkpoint; start a new run with --fresh, which renames this one".into()
                }
            };
            TrainError::Damaged { source: Box::new(source), fix }
        })?;
        self.apply(state, &path, train_state)
    }

    /// Returns `model` with the weights of the checkpoint of a step, without reading the optimizer. Changes no file.
    pub(crate) fn load_model(&self, step: u64, model: Network) -> Result<Network, TrainError> {
        let path = self.path_of(step);
        self.apply_model(&verify(&path)?, &path, model)
    }

    fn apply_model(&self, state: &State, folder: &Path, model: Network) -> Result<Network, TrainError> {
        let path = folder.join(MODEL);
        if let (Some(saved), Some(expected)) = (&state.model, &self.model)
            && *expected != (ModelConfig { patch_grids: expected.patch_grids, ..saved.clone() })
        {
            let fix = format!("{} is of the network {saved:?}", folder.display());
            return Err(bad("model", format!("{expected:?}"), &fix));
        }
        let record = ModuleRecord::load(&path).map_err(TrainError::bad_file("checkpoint", &path))?;
        let loaded = caught(&path, || model.try_load_record(record))?;
        let loaded = loaded.map_err(|error| bad_file(folder, MODEL, format!("{error:?}")))?;
        if let Some((name, dtype)) = first_not_f32(&loaded) {
            return Err(bad_file(folder, MODEL, format!("{name} is {dtype:?}, not F32")));
        }
        Ok(loaded)
    }

    fn apply(&self, state: State, folder: &Path, train_state: &mut TrainState) -> Result<TrainingPosition, TrainError> {
        train_state.model = self.apply_model(&state, folder, train_state.model.clone())?;
        let State { progress, loss_scale, .. } = state;
        let path = folder.join(OPTIMIZER);
        let record = OptimizerRecord::load(&path).map_err(TrainError::bad_file("checkpoint", &path))?;
        let num_tensors = record.len();
        let loaded = caught(&path, || train_state.optimizer.clone().load_record(record))?;
        if loaded.to_record().len() != num_tensors {
            // Burn ignores unknown tensors.
            return Err(bad_file(folder, OPTIMIZER, "the file is not a record of this optimizer"));
        }
        train_state.optimizer = loaded;
        if loss_scale.is_some_and(|scale| !scale.is_possible()) {
            return Err(bad_file(folder, STATE, "the loss scale is not a power of two from 1 to 2^32"));
        }
        // The config sets the precision.
        if train_state.loss_scale.is_some() && loss_scale.is_some() {
            train_state.loss_scale = loss_scale;
        }
        Ok(progress)
    }

    pub(crate) fn newest_step(&self) -> Result<Option<u64>, TrainError> {
        Ok(self.steps()?.pop())
    }

    pub(crate) fn path_of(&self, step: u64) -> PathBuf {
        self.folder.join(name_of(step))
    }

    /// Lists the steps of the complete checkpoints, oldest first.
    fn steps(&self) -> Result<Vec<u64>, TrainError> {
        let mut steps: Vec<u64> = self.items()?.iter().filter_map(|path| step_of(path)).collect();
        steps.sort_unstable();
        Ok(steps)
    }

    fn items(&self) -> Result<Vec<PathBuf>, TrainError> {
        if !self.folder.exists() {
            return Ok(Vec::new());
        }
        let items = std::fs::read_dir(&self.folder).and_then(|items| items.map(|item| Ok(item?.path())).collect());
        items.map_err(TrainError::io("listing checkpoints", &self.folder))
    }

    /// Removes unfinished saves, and what a killed process left of a removed checkpoint.
    pub(crate) fn remove_unfinished(&self) -> Result<(), TrainError> {
        let is_unfinished = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "tmp");
        self.items()?.into_iter().filter(is_unfinished).try_for_each(|path| remove_if_present(&path))
    }

    /// Removes unfinished saves, and all checkpoints but the newest `keep`.
    fn prune(&self, keep: usize) -> Result<(), TrainError> {
        self.remove_unfinished()?;
        let steps = self.steps()?;
        for step in &steps[..steps.len().saturating_sub(keep)] {
            let path = self.path_of(*step);
            remove_folder(&path).map_err(TrainError::io("removing an old checkpoint", &path))?;
        }
        Ok(())
    }
}

fn name_of(step: u64) -> String {
    format!("step-{step:09}")
}

fn step_of(path: &Path) -> Option<u64> {
    path.file_name()?.to_str()?.strip_prefix("step-")?.parse().ok()
}

fn remove_if_present(folder: &Path) -> Result<(), TrainError> {
    if folder.exists() {
        std::fs::remove_dir_all(folder).map_err(TrainError::io("removing an unfinished save", folder))?;
    }
    Ok(())
}

fn bad_file(folder: &Path, name: &str, reason: impl std::fmt::Display) -> TrainError {
    TrainError::bad_file("checkpoint", &folder.join(name))(reason)
}

/// Reads the state of a checkpoint and compares the lengths and checksums of its files.
fn verify(folder: &Path) -> Result<State, TrainError> {
    let state = State::read(folder)?;
    if let Some(name) = [MODEL, OPTIMIZER].into_iter().find(|name| !state.files.contains_key(*name)) {
        return Err(bad_file(folder, STATE, format!("the checksum of {name} is missing")));
    }
    for (name, expected) in &state.files {
        let file = folder.join(name);
        let found = Fingerprint::of(&file).map_err(TrainError::io(LOADING, &file))?;
        if found != *expected {
            let reason = format!("{} bytes with other contents, {} expected", found.num_bytes, expected.num_bytes);
            return Err(bad_file(folder, name, reason));
        }
    }
    Ok(state)
}

/// Returns a panic of `load` as an error. Burn 0.22 panics for integer tensors, for optimizer tensors without parameter ids,
/// and if a device fails: a panic does not show that the file is damaged.
fn caught<T>(file: &Path, load: impl FnOnce() -> T) -> Result<T, TrainError> {
    catch_unwind(AssertUnwindSafe(load)).map_err(|panic| {
        let text = panic.downcast_ref::<&str>().map(ToString::to_string);
        let text = text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default();
        TrainError::io(LOADING, file)(std::io::Error::other(format!("Burn panicked: {text}")))
    })
}

#[cfg(test)]
mod tests {
    use burn::module::{ModuleMapper, Param};
    use burn::tensor::{DType, Tensor};

    use super::*;

    fn saved(root: &Path) -> (TrainState, Checkpoints, PathBuf) {
        let config = ModelConfig { dim: 8, num_heads: 2, feed_forward_dim: 8, ..ModelConfig::default() };
        let device = burn::tensor::Device::flex().autodiff();
        let model = clift_model::Network::new(&config, 0, &device);
        let train_state = TrainState::new(model, &crate::config::config::OptimizerConfig::default(), device);
        let checkpoints = Checkpoints { folder: root.into(), model: None };
        let step =
            checkpoints.save(&train_state, &TrainingPosition { step: 1, ..TrainingPosition::default() }, 1).unwrap();
        (train_state, checkpoints, step)
    }

    fn update_checksum(step: &Path, name: &str) {
        let mut state = State::read(step).unwrap();
        state.files.insert(name.into(), Fingerprint::of(&step.join(name)).unwrap());
        state.write(step).unwrap();
    }

    #[test]
    fn a_panic_is_not_called_damage() {
        let error = caught(Path::new(OPTIMIZER), || panic!("no adapter")).map(|(): ()| ()).unwrap_err();
        assert!(
            matches!(error, TrainError::Io { .. }) && error.to_string().contains("Burn panicked: no adapter"),
            "{error}"
        );
    }

    struct ToF64;
    impl ModuleMapper for ToF64 {
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            param.map(|tensor| tensor.cast(DType::F64))
        }
    }

    #[test]
    fn wrong_files_with_right_checksums_and_missing_checksums_are_refused() {
        let place = tempfile::tempdir().unwrap();
        let (mut train_state, checkpoints, step) = saved(place.path());
        let wide = train_state.model.valid().map(&mut ToF64);
        let mut message = || checkpoints.load(1, &mut train_state).unwrap_err().to_string();
        // Weights of the model in the file of the optimizer.
        std::fs::copy(step.join(MODEL), step.join(OPTIMIZER)).unwrap();
        update_checksum(&step, OPTIMIZER);
        assert!(message().contains("optimizer.bpk") && !message().contains("damaged"), "{}", message());

        wide.into_record().save(step.join(MODEL)).unwrap();
        update_checksum(&step, MODEL);
        assert!(message().contains("is F64, not F32"), "{}", message());

        let mut state = State::read(&step).unwrap();
        state.files.remove(MODEL);
        state.write(&step).unwrap();
        assert!(message().contains("the checksum of model.bpk is missing"), "{}", message());
    }

    #[test]
    fn newest_checkpoints_are_kept() {
        let place = tempfile::tempdir().unwrap();
        let checkpoints = Checkpoints { folder: place.path().into(), model: None };
        for step in [10, 20, 30, 40] {
            std::fs::create_dir(checkpoints.path_of(step)).unwrap();
        }
        for (keep, kept) in [(9, &[10, 20, 30, 40][..]), (2, &[30, 40]), (1, &[40])] {
            checkpoints.prune(keep).unwrap();
            assert_eq!(checkpoints.steps().unwrap(), kept);
        }
    }
}
