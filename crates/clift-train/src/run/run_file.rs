//! `run.json`, and the comparison of a config with the config of an existing run.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clift_core::{StagedDir, make_folder, remove_leftovers, replace_file};
use clift_data::DataConfig;
use serde::{Deserialize, Serialize};

use crate::config::config::Config;
use crate::error::{TrainError, bad};
use crate::events::{Event, RunStep, Sink, Stage};
use crate::run::lock::{FITTED_RUN, RUN, RunLock, has_other_files};
use crate::version::parse_versioned;

const FILE: &str = "run.json";
const VERSION: u32 = 3;

const FREE_KEYS: [&str; 7] =
    ["run_dir", "device", "data.num_threads", "data.num_prefetch", "model.patch_grids", "checkpoint.", "eval."];

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RunFile {
    version: u32,
}

/// Checks the version of a run directory.
pub(crate) fn check_run_file(folder: &Path) -> Result<(), TrainError> {
    let path = folder.join(FILE);
    let text = std::fs::read(&path).map_err(TrainError::io("reading the run file", &path))?;
    parse_versioned::<RunFile>(&text, VERSION).map(drop).map_err(TrainError::bad_file("run file", &path))
}

/// Options of a run beside its config.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RunOptions {
    /// Run only this step.
    pub only: Option<RunStep>,
    /// Start a new run; the existing run directory is renamed.
    pub fresh: bool,
}

const TRAINING_STEPS: [RunStep; 3] = [RunStep::Train(Stage::Stage1), RunStep::Clusters, RunStep::Train(Stage::Stage2)];

/// Locks the run directory of a config, new or existing, and writes the resolved config to it. Returns the lock.
pub(crate) fn open_folder(config: &Config, options: &RunOptions, sink: &mut dyn Sink) -> Result<RunLock, TrainError> {
    let folder = &config.run_dir;
    if options.fresh && !matches!(options.only, None | Some(RunStep::Train(Stage::Stage1))) {
        return Err(bad("--fresh", "with --only", "a new run starts with stage 1: omit --fresh or --only"));
    }
    let is_run = folder.join(FILE).exists();
    if !is_run && has_other_files(folder)? {
        let fix = "the folder has files and is not a run (it has no run.json); write the path of a new folder";
        return Err(bad("run_dir", folder.display(), fix));
    }
    if options.fresh && is_run {
        // Refuses a directory in use. Dropped before the rename, which Windows refuses otherwise.
        drop(RunLock::take(folder, RUN, sink)?);
        let moved = free_name(folder);
        std::fs::rename(folder, &moved).map_err(TrainError::io("renaming the existing run", folder))?;
        sink.event(&Event::Message(format!("renamed the existing run to {}", moved.display())));
    }
    make_folder(folder).map_err(TrainError::io("making the run directory", folder))?;
    let lock = RunLock::take(folder, RUN, sink)?;
    remove_leftovers(folder).map_err(TrainError::io("removing temporary files of a killed process", folder))?;
    // A run that failed before its first stage may get other settings.
    let has_begun = TRAINING_STEPS.iter().any(|step| folder.join(step.name()).exists());
    let written = folder.join("config.toml");
    if has_begun && !written.exists() {
        let reason = "missing from a run that has begun; restore the file, or start a new run with --fresh";
        return Err(TrainError::bad_file("config", &written)(reason));
    }
    if has_begun {
        check_run_file(folder)?;
        compare_settings(folder, config)?;
    }
    let writing = "writing the settings of the run";
    let staged = StagedDir::new(folder).map_err(TrainError::io(writing, folder))?;
    let json =
        serde_json::to_vec_pretty(&RunFile { version: VERSION }).map_err(TrainError::bad_file("run file", folder))?;
    let text = toml::to_string_pretty(config).map_err(TrainError::bad_file("config", folder))?;
    for (name, bytes) in [(FILE, json), ("config.toml", text.into_bytes())] {
        replace_file(&staged.path().join(name), &bytes).map_err(TrainError::io(writing, folder))?;
    }
    staged.commit().map_err(TrainError::io(writing, folder))?;
    Ok(lock)
}

/// Locks the run that `path` is, or is the stage folder or the weight file of; `None` for other models.
pub fn lock_run(path: &Path, sink: &mut dyn Sink) -> Result<Option<RunLock>, TrainError> {
    let run = path.ancestors().take(3).find(|folder| folder.join(FILE).is_file());
    run.map(|folder| RunLock::take(folder, FITTED_RUN, sink)).transpose()
}

/// Checks that a run directory is still at its path: a process that has it open must not make a second one there.
pub(crate) fn require_run(folder: &Path) -> Result<(), TrainError> {
    if folder.join(FILE).exists() { Ok(()) } else { Err(TrainError::Moved { path: folder.into() }) }
}

/// Reads the config of the run in `folder`.
pub(crate) fn read_run_config(folder: &Path) -> Result<Config, TrainError> {
    let path = folder.join("config.toml");
    let text = std::fs::read_to_string(&path).map_err(TrainError::io("reading the run's config", &path))?;
    let bad = |error: toml::de::Error| TrainError::bad_file("config", &path)(error.message().to_owned());
    toml::from_str(&text).map_err(bad)
}

/// Whether data may have frames that a run was trained on: from the same folder, from one inside the other, or, where the
/// folder of the training is gone, from any, because the data may have moved.
pub(crate) fn is_of_training(trained: &DataConfig, data: &DataConfig) -> bool {
    let (Some(trained), Some(read)) = (&trained.root, &data.root) else { return trained.root == data.root };
    let Ok(trained) = trained.canonicalize() else { return true };
    read.canonicalize().is_ok_and(|read| read.starts_with(&trained) || trained.starts_with(&read))
}

/// Compares a config with the config of the run in `folder`.
fn compare_settings(folder: &Path, config: &Config) -> Result<(), TrainError> {
    let table = |config: &Config| {
        toml::Table::try_from(config).map_err(TrainError::bad_file("config", &folder.join("config.toml")))
    };
    let (old, new) = (table(&read_run_config(folder)?)?, table(config)?);
    let (old, new) = (flatten(old), flatten(new));
    let keys: std::collections::BTreeSet<_> = old.keys().chain(new.keys()).collect();
    let free = |key: &str| FREE_KEYS.iter().any(|free| key == *free || (free.ends_with('.') && key.starts_with(free)));
    let changed = keys.into_iter().filter(|key| !free(key) && old.get(*key) != new.get(*key));
    let show = |value: Option<&String>| value.cloned().unwrap_or_else(|| "not set".into());
    let differences: Vec<String> =
        changed.map(|key| format!("  {key}: {} -> {}", show(old.get(key)), show(new.get(key)))).collect();
    if differences.is_empty() {
        return Ok(());
    }
    Err(TrainError::OtherRun { differences: differences.join("\n"), path: config.run_dir.clone() })
}

fn flatten(table: toml::Table) -> BTreeMap<String, String> {
    let mut flat = BTreeMap::new();
    let mut pending: Vec<(String, toml::Value)> = table.into_iter().collect();
    while let Some((key, value)) = pending.pop() {
        match value {
            toml::Value::Table(inner) => pending.extend(inner.into_iter().map(|(k, v)| (format!("{key}.{k}"), v))),
            other => {
                flat.insert(key, other.to_string());
            }
        }
    }
    flat
}

/// Returns the first free name of `runs/tiny.1`, `runs/tiny.2`, .. for `runs/tiny`.
fn free_name(folder: &Path) -> PathBuf {
    let name = folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let mut names = (1..).map(|number: u64| folder.with_file_name(format!("{name}.{number}")));
    names.find(|moved| !moved.exists()).expect("a free number")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_inside_the_folder_of_the_training_is_training_data() {
        let folder = tempfile::tempdir().unwrap();
        let [inner, other] = ["inner", "other"].map(|name| folder.path().join(name));
        std::fs::create_dir(&inner).and_then(|()| std::fs::create_dir(&other)).unwrap();
        let of = |root: &Path| DataConfig { root: Some(root.into()), ..DataConfig::default() };
        assert!(!is_of_training(&of(folder.path()), &DataConfig::default()));
        assert!(is_of_training(&of(folder.path()), &of(&folder.path().join("."))), "the same folder by another path");
        assert!(is_of_training(&of(folder.path()), &of(&inner)), "a part of it");
        assert!(!is_of_training(&of(&other), &of(&inner)));
        std::fs::remove_dir(&other).unwrap();
        assert!(is_of_training(&of(&other), &of(&inner)), "it may have moved");
    }
}
