//! The state of a stage on disk: a folder per step, written under a temporary name, synced and renamed.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::optim::OptimizerRecord;
use burn::store::ModuleRecord;
use clift_data::{make_folder, publish_folder, remove_folder};
use clift_model::{ModelConfig, first_not_f32};

use crate::checkpoint::progress::{Best, Fingerprint, Progress, State, VERSION};
use crate::config::config::CheckpointConfig;
use crate::error::TrainError;
use crate::step::train_state::TrainState;

const MODEL: &str = "model.bpk";
const OPTIMIZER: &str = "optimizer.bpk";
const SAVING: &str = "writing a checkpoint";
const LISTING: &str = "listing checkpoints";

/// The checkpoints of one stage.
#[derive(Clone, Debug)]
pub struct Checkpoints {
    folder: PathBuf,
    retention: CheckpointConfig,
    model: Option<ModelConfig>,
}

impl Checkpoints {
    /// Keeps checkpoints in `folder`, and as many as `retention` says.
    pub fn new(folder: PathBuf, retention: CheckpointConfig) -> Self {
        Self { folder, retention, model: None }
    }

    /// Notes in every checkpoint which network it is, and refuses those of another.
    #[must_use]
    pub fn of(self, model: ModelConfig) -> Self {
        Self { model: Some(model), ..self }
    }

    /// Saves model, optimiser and progress, and removes the checkpoints that are kept no longer.
    ///
    /// # Errors
    /// [`TrainError::Io`]; older checkpoints are then untouched, and what was written of this one is removed.
    pub fn save(&self, learner: &TrainState, progress: &Progress) -> Result<PathBuf, TrainError> {
        let path = self.path_of(progress.step);
        let temporary = path.with_extension("tmp");
        remove_if_there(&temporary)?;
        let written = self.write(learner, progress, &temporary, &path);
        if written.is_err() {
            // A full disk needs the space; what even that leaves is removed by the next save.
            drop(std::fs::remove_dir_all(&temporary));
        }
        written?;
        self.prune(progress)?;
        Ok(path)
    }

    fn write(
        &self,
        learner: &TrainState,
        progress: &Progress,
        temporary: &Path,
        path: &Path,
    ) -> Result<(), TrainError> {
        make_folder(temporary).map_err(TrainError::io("making a checkpoint", temporary))?;
        let failed =
            |name: &str, reason: String| TrainError::io(SAVING, &temporary.join(name))(std::io::Error::other(reason));
        let record = learner.model.clone().into_record();
        record.save(temporary.join(MODEL)).map_err(|error| failed(MODEL, error.to_string()))?;
        let saved = learner.optimizer.save(temporary.join(OPTIMIZER));
        saved.map_err(|error| failed(OPTIMIZER, error.to_string()))?;
        let mut files = BTreeMap::new();
        for name in [MODEL, OPTIMIZER] {
            let file = temporary.join(name);
            files.insert(name.to_owned(), Fingerprint::of(&file).map_err(TrainError::io(SAVING, &file))?);
        }
        let (progress, model, loss_scale) = (progress.clone(), self.model.clone(), learner.loss_scale);
        State { version: VERSION, progress, files, model, loss_scale }.write(temporary)?;
        if path.exists() {
            // Only where somebody moved newer checkpoints away and trains those steps again.
            std::fs::remove_dir_all(path).map_err(TrainError::io("replacing a checkpoint", path))?;
        }
        publish_folder(temporary, path).map_err(TrainError::io(SAVING, path))
    }

    /// Writes what a validation has added to the progress into the checkpoint of its step, and removes the checkpoints
    /// that are kept no longer.
    ///
    /// # Errors
    /// [`TrainError::Io`] and [`TrainError::BadFile`]; the checkpoint is then as it was.
    pub fn update(&self, progress: &Progress) -> Result<(), TrainError> {
        let path = self.path_of(progress.step);
        State { progress: progress.clone(), ..State::read(&path)? }.write(&path)?;
        self.prune(progress)
    }

    /// Loads the newest checkpoint into a learner; `None` when there is none.
    ///
    /// # Errors
    /// [`TrainError::Damaged`] for a damaged checkpoint: nothing is started over in silence.
    pub fn resume(&self, learner: &mut TrainState) -> Result<Option<Progress>, TrainError> {
        let mut all = self.list()?;
        let Some(path) = all.pop() else { return Ok(None) };
        let loaded = load(&path, self.model.as_ref(), learner).map_err(|source| {
            let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let fix = match all.last() {
                Some(older) => format!("move {} away to go on from {}", name(&path), name(older)),
                None => "it is the only checkpoint of its stage; --fresh starts the run over".into(),
            };
            TrainError::Damaged { source: Box::new(source), fix }
        });
        loaded.map(Some)
    }

    /// The newest checkpoint.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn newest(&self) -> Result<Option<PathBuf>, TrainError> {
        Ok(self.list()?.pop())
    }

    /// The step of the newest checkpoint.
    ///
    /// # Errors
    /// [`TrainError::Io`].
    pub fn newest_step(&self) -> Result<Option<u64>, TrainError> {
        Ok(self.newest()?.as_deref().and_then(step_of))
    }

    fn path_of(&self, step: u64) -> PathBuf {
        self.folder.join(format!("step-{step:09}"))
    }

    /// Complete checkpoints, oldest first.
    fn list(&self) -> Result<Vec<PathBuf>, TrainError> {
        if !self.folder.exists() {
            return Ok(Vec::new());
        }
        let mut found = Vec::new();
        for item in std::fs::read_dir(&self.folder).map_err(TrainError::io(LISTING, &self.folder))? {
            let path = item.map_err(TrainError::io(LISTING, &self.folder))?.path();
            found.extend(step_of(&path).map(|step| (step, path)));
        }
        found.sort();
        Ok(found.into_iter().map(|(_, path)| path).collect())
    }

    /// Removes the checkpoints that are kept no longer, and what a save that was killed has left.
    fn prune(&self, progress: &Progress) -> Result<(), TrainError> {
        for item in std::fs::read_dir(&self.folder).map_err(TrainError::io(LISTING, &self.folder))? {
            let path = item.map_err(TrainError::io(LISTING, &self.folder))?.path();
            if path.extension().is_some_and(|extension| extension == "tmp") {
                remove_if_there(&path)?;
            }
        }
        let steps: Vec<u64> = self.list()?.iter().filter_map(|path| step_of(path)).collect();
        for step in surplus(&steps, &self.retention, progress.best) {
            let path = self.path_of(step);
            remove_folder(&path).map_err(TrainError::io("removing an old checkpoint", &path))?;
        }
        Ok(())
    }
}

/// The steps, oldest first, that are neither among the last nor the best nor one of the regular ones.
fn surplus(steps: &[u64], retention: &CheckpointConfig, best: Option<Best>) -> Vec<u64> {
    let CheckpointConfig { keep, keep_every, keep_best, .. } = *retention;
    let is_kept = |step: u64| {
        let is_best = keep_best && best.is_some_and(|best| best.step == step);
        is_best || (keep_every > 0 && step.is_multiple_of(keep_every))
    };
    steps[..steps.len().saturating_sub(keep)].iter().copied().filter(|step| !is_kept(*step)).collect()
}

fn step_of(path: &Path) -> Option<u64> {
    path.file_name()?.to_str()?.strip_prefix("step-")?.parse().ok()
}

fn remove_if_there(folder: &Path) -> Result<(), TrainError> {
    if folder.exists() {
        std::fs::remove_dir_all(folder).map_err(TrainError::io("removing an unfinished save", folder))?;
    }
    Ok(())
}

fn load(folder: &Path, expected: Option<&ModelConfig>, learner: &mut TrainState) -> Result<Progress, TrainError> {
    let State { progress, files, model, loss_scale, .. } = State::read(folder)?;
    if let Some(name) = [MODEL, OPTIMIZER].into_iter().find(|name| !files.contains_key(*name)) {
        let reason = format!("it has no checksum of {name}");
        return Err(TrainError::bad_file("checkpoint", &folder.join("state.json"))(reason));
    }
    if let (Some(model), Some(expected)) = (&model, expected)
        && model != expected
    {
        let reason = format!("it holds another network ({model:?}) than the config's [model]");
        return Err(TrainError::bad_file("checkpoint", &folder.join("state.json"))(reason));
    }
    for (name, expected) in &files {
        let file = folder.join(name);
        let found = Fingerprint::of(&file).map_err(TrainError::io("reading a checkpoint", &file))?;
        if found != *expected {
            let reason = format!("{} bytes with other contents, {} expected", found.num_bytes, expected.num_bytes);
            return Err(TrainError::bad_file("checkpoint", &file)(reason));
        }
    }
    let model = folder.join(MODEL);
    let bad_model = |reason: String| TrainError::bad_file("checkpoint", &model)(reason);
    let record = ModuleRecord::load(&model).map_err(|error| bad_model(error.to_string()))?;
    // Burn 0.22 panics where a record holds integers, or optimiser tensors without parameter ids, and passes over what
    // it does not know; the clone that is half loaded is dropped.
    let loaded = catch_unwind(AssertUnwindSafe(|| learner.model.clone().try_load_record(record)));
    let loaded = loaded.map_err(|_| bad_model("it holds tensors of another type than float".into()))?;
    let loaded = loaded.map_err(|error| bad_model(format!("{error:?}")))?;
    if let Some((name, dtype)) = first_not_f32(&loaded) {
        return Err(bad_model(format!("{name} is {dtype:?}, not F32")));
    }
    learner.model = loaded;
    let optimizer = folder.join(OPTIMIZER);
    let record = OptimizerRecord::load(&optimizer).map_err(TrainError::bad_file("checkpoint", &optimizer))?;
    let num_tensors = record.len();
    let loaded = catch_unwind(AssertUnwindSafe(|| learner.optimizer.clone().load_record(record)));
    let whole = loaded.ok().filter(|loaded| loaded.to_record().len() == num_tensors);
    let foreign = || TrainError::bad_file("checkpoint", &optimizer)("it is no record of this optimiser");
    learner.optimizer = whole.ok_or_else(foreign)?;
    if loss_scale.is_some_and(|scale| !scale.is_possible()) {
        let reason = "its loss scale is no power of two from 1 to 2^32";
        return Err(TrainError::bad_file("checkpoint", &folder.join("state.json"))(reason));
    }
    // The precision is the config's, which resuming compares.
    if learner.loss_scale.is_some() && loss_scale.is_some() {
        learner.loss_scale = loss_scale;
    }
    Ok(progress)
}

#[cfg(test)]
mod tests {
    use burn::module::{ModuleMapper, Param};
    use burn::tensor::{DType, Tensor};

    use super::*;

    /// A learner and its first checkpoint below `root`.
    fn saved(root: &Path) -> (TrainState, Checkpoints, PathBuf) {
        let config = ModelConfig { dim: 8, num_heads: 2, feed_forward_dim: 8, ..ModelConfig::default() };
        let device = burn::tensor::Device::flex().autodiff();
        let optimizer = crate::step::optimizer::adamw(&crate::config::config::OptimizerConfig::default());
        let learner = TrainState {
            model: clift_model::Clift::new(&config, 0, &device),
            optimizer,
            device,
            loss: crate::step::loss::Loss::default(),
            activation_checkpointing: false,
            loss_scale: None,
        };
        let checkpoints = Checkpoints::new(root.into(), CheckpointConfig::default());
        let step = checkpoints.save(&learner, &Progress { step: 1, ..Progress::default() }).expect("it can be saved");
        (learner, checkpoints, step)
    }

    /// Says in `state.json` that the file is as it is now.
    fn sign(step: &Path, name: &str) {
        let mut state = State::read(step).expect("it is well");
        state.files.insert(name.into(), Fingerprint::of(&step.join(name)).expect("it can be read"));
        state.write(step).expect("it can be written");
    }

    #[test]
    fn an_optimizer_that_is_none_is_refused_and_so_is_a_file_without_checksum() {
        let place = tempfile::tempdir().expect("a temporary folder");
        let (mut learner, checkpoints, step) = saved(place.path());

        // The weights of a model under the optimiser's name, with a checksum that fits: found by damaging files.
        std::fs::copy(step.join(MODEL), step.join(OPTIMIZER)).expect("it can be copied");
        sign(&step, OPTIMIZER);
        let refused = checkpoints.resume(&mut learner);
        assert!(refused.is_err(), "{refused:?}");

        let mut state = State::read(&step).expect("it is well");
        state.files.remove(MODEL);
        state.write(&step).expect("it can be written");
        let message = checkpoints.resume(&mut learner).unwrap_err().to_string();
        assert!(message.contains("it has no checksum of model.bpk"), "{message}");
    }

    #[test]
    fn weights_of_another_type_are_refused() {
        let place = tempfile::tempdir().expect("a temporary folder");
        let (mut learner, checkpoints, step) = saved(place.path());
        let path = step.join(MODEL);

        // The type in the header of the first tensor, with a checksum that fits: found by damaging files.
        let mut bytes = std::fs::read(&path).expect("it can be read");
        let at = bytes.windows(3).position(|window| window == b"F32").expect("a type");
        bytes[at] = b'I';
        std::fs::write(&path, bytes).expect("it can be written");
        sign(&step, MODEL);
        let message = checkpoints.resume(&mut learner).unwrap_err().to_string();
        assert!(message.contains("tensors of another type than float"), "{message}");

        struct ToF64;
        impl ModuleMapper for ToF64 {
            fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
                param.map(|tensor| tensor.cast(DType::F64))
            }
        }
        let wide = learner.model.valid().map(&mut ToF64);
        wide.into_record().save(&path).expect("it can be written");
        sign(&step, MODEL);
        let message = checkpoints.resume(&mut learner).unwrap_err().to_string();
        assert!(message.contains("is F64, not F32"), "{message}");
    }

    #[test]
    fn the_last_the_best_and_every_mth_are_kept() {
        let steps = [10, 20, 30, 40, 50, 60];
        let gone = |keep, keep_every, keep_best, best: u64| {
            let retention = CheckpointConfig { every: 10, keep, keep_every, keep_best };
            surplus(&steps, &retention, Some(Best { step: best, psnr: 20.0 }))
        };
        assert_eq!(gone(2, 0, false, 20), [10, 20, 30, 40]);
        assert_eq!(gone(2, 0, true, 20), [10, 30, 40]);
        assert_eq!(gone(1, 30, true, 20), [10, 40, 50]);
        assert_eq!(gone(1, 30, true, 60), [10, 20, 40, 50], "the best is the last");
        assert_eq!(gone(9, 0, false, 20), [0; 0]);
        let none = CheckpointConfig { keep: 1, ..CheckpointConfig::default() };
        assert_eq!(surplus(&steps, &none, None).len(), 5);
    }

    #[test]
    fn only_whole_checkpoints_have_a_step() {
        let step = |name: &str| step_of(Path::new(name));
        assert_eq!((step("a/step-000000017"), step("a/step-1000000000")), (Some(17), Some(1_000_000_000)));
        assert_eq!((step("a/step-000000017.tmp"), step("a/best")), (None, None));
    }
}
