//! `run.json`, and the comparison of a config with the config of an existing run.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clift_core::{StagedDir, make_folder, remove_leftovers, replace_file};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::config::config::Config;
use crate::error::{TrainError, bad};
use crate::events::{Event, RunStep, Sink, Stage};
use crate::run::extend::{ExtensionRecord, StepExtension};
use crate::run::lock::{LockedFolder, RunLock, has_other_files};
use crate::version::check_version;

const FILE: &str = "run.json";
const VERSION: u32 = 2;

/// Keys that may change when a run is resumed.
const FREE_KEYS: [&str; 9] = [
    "run_dir",
    "device",
    "activation_checkpointing",
    "data.num_threads",
    "data.num_prefetch",
    "data.image_cache.",
    "model.patch_grids",
    "checkpoint.",
    "eval.",
];

/// Keys that `--extend` may increase.
const STEP_COUNTS: [(&str, Stage); 2] = [("stage1.steps", Stage::Stage1), ("stage2.steps", Stage::Stage2)];

/// Content of `run.json`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RunFile {
    version: u32,
    /// Number of scenes of `--overfit`.
    pub overfit: Option<usize>,
    /// Extensions by `--extend`, in order.
    pub extended: Vec<ExtensionRecord>,
}

impl RunFile {
    pub fn new(overfit: Option<usize>) -> Self {
        Self { version: VERSION, overfit, extended: Vec::new() }
    }

    pub fn read(folder: &Path) -> Result<Self, TrainError> {
        let path = folder.join(FILE);
        let text = std::fs::read(&path).map_err(TrainError::io("reading the run file", &path))?;
        let run: Value = serde_json::from_slice(&text).map_err(TrainError::bad_file("run file", &path))?;
        check_version(&run, VERSION).map_err(TrainError::bad_file("run file", &path))?;
        serde_json::from_value(run).map_err(TrainError::bad_file("run file", &path))
    }

    pub fn write(&self, folder: &Path) -> Result<(), TrainError> {
        let path = folder.join(FILE);
        let json = serde_json::to_vec_pretty(self).map_err(TrainError::bad_file("run file", &path))?;
        replace_file(&path, &json).map_err(TrainError::io("writing the run file", &path))
    }
}

/// Options of a run beside its config.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RunOptions {
    /// Run only this step.
    pub only: Option<RunStep>,
    /// Train and evaluate on this number of training scenes.
    pub overfit: Option<usize>,
    /// Start a new run; the existing run directory is renamed.
    pub fresh: bool,
    /// Allow larger step counts than the existing run has.
    pub extend: bool,
}

/// Steps of training, each of which has a folder.
const TRAINING_STEPS: [RunStep; 3] = [RunStep::Train(Stage::Stage1), RunStep::Clusters, RunStep::Train(Stage::Stage2)];

/// Locks the run directory of a config, new or existing, and writes the resolved config to it. Returns the lock.
///
/// # Errors
/// [`TrainError::BadConfig`] for a folder with files that is not a run, [`TrainError::OtherRun`], [`TrainError::Locked`] and
/// [`TrainError::Io`].
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
        drop(RunLock::take(folder, LockedFolder::Run, sink)?);
        let moved = free_name(folder);
        std::fs::rename(folder, &moved).map_err(TrainError::io("renaming the existing run", folder))?;
        sink.event(&Event::Message(format!("renamed the existing run to {}", moved.display())));
    }
    make_folder(folder).map_err(TrainError::io("making the run directory", folder))?;
    let lock = RunLock::take(folder, LockedFolder::Run, sink)?;
    remove_leftovers(folder).map_err(TrainError::io("removing temporary files of a killed process", folder))?;
    // A run that failed before its first stage may get other settings.
    let has_begun = TRAINING_STEPS.iter().any(|step| folder.join(step.name()).exists());
    let (mut file, mut extended) = (RunFile::new(options.overfit), Vec::<ExtensionRecord>::new());
    let written = folder.join("config.toml");
    if has_begun && !written.exists() {
        let reason = "missing from a run that has begun; restore the file, or start a new run with --fresh";
        return Err(TrainError::bad_file("config", &written)(reason));
    }
    if has_begun {
        let found = RunFile::read(folder)?;
        let extensions = compare_settings(folder, &found, config, options.overfit, options.extend)?;
        file.extended = found.extended;
        extended = extensions.into_iter().map(|extension| extension.check(config)).collect::<Result<_, _>>()?;
        file.extended.extend(&extended);
    }
    // Both files are on the disk before weights are renamed: a full disk changes nothing.
    let writing = "writing the settings of the run";
    let staged = StagedDir::new(folder).map_err(TrainError::io(writing, folder))?;
    file.write(staged.path())?;
    write_config(config, staged.path())?;
    for extension in extended {
        extension.keep_weights(config, sink)?;
    }
    staged.commit().map_err(TrainError::io(writing, folder))?;
    Ok(lock)
}

/// Locks the run that `path` is, or is the stage folder or the weight file of; `None` for other models.
///
/// # Errors
/// As for a run that another process has locked, and those of the file system.
pub fn lock_run(path: &Path, sink: &mut dyn Sink) -> Result<Option<RunLock>, TrainError> {
    let run = path.ancestors().take(3).find(|folder| folder.join(FILE).is_file());
    run.map(|folder| RunLock::take(folder, LockedFolder::FittedRun, sink)).transpose()
}

/// Checks that a run directory is still at its path: a process that has it open must not make a second one there.
pub(crate) fn require_run(folder: &Path) -> Result<(), TrainError> {
    if folder.join(FILE).exists() { Ok(()) } else { Err(TrainError::Moved { path: folder.into() }) }
}

/// Writes every key of a config to `config.toml` in a folder.
fn write_config(config: &Config, folder: &Path) -> Result<(), TrainError> {
    let path = folder.join("config.toml");
    let text = toml::to_string_pretty(config).map_err(TrainError::bad_file("config", &path))?;
    replace_file(&path, text.as_bytes()).map_err(TrainError::io("writing the config", &path))
}

/// Compares a config with the config of the run in `folder`. Returns the larger step counts that `extend` allows.
///
/// # Errors
/// [`TrainError::OtherRun`] for any other difference in keys that affect the result.
fn compare_settings(
    folder: &Path,
    found: &RunFile,
    config: &Config,
    overfit: Option<usize>,
    extend: bool,
) -> Result<Vec<StepExtension>, TrainError> {
    let path = folder.join("config.toml");
    let text = std::fs::read_to_string(&path).map_err(TrainError::io("reading the run's config", &path))?;
    let bad = || TrainError::bad_file("config", &path);
    let old: Config = toml::from_str(&text).map_err(|error| bad()(error.message().to_owned()))?;
    let old = toml::Table::try_from(&old).map_err(|error| bad()(error.to_string()))?;
    let new = toml::Table::try_from(config).map_err(|error| bad()(error.to_string()))?;
    let (mut old, mut new) = (flatten(old), flatten(new));
    let flag = |overfit: Option<usize>| overfit.map_or("off".into(), |count| count.to_string());
    old.insert("--overfit".into(), flag(found.overfit));
    new.insert("--overfit".into(), flag(overfit));

    let (mut differences, mut extensions) = (Vec::new(), Vec::new());
    let keys: std::collections::BTreeSet<_> = old.keys().chain(new.keys()).collect();
    let free = |key: &str| FREE_KEYS.iter().any(|free| key == *free || (free.ends_with('.') && key.starts_with(free)));
    for key in keys {
        let (from, to) = (old.get(key), new.get(key));
        if free(key) || from == to {
            continue;
        }
        let extension = extension(key, from, to);
        if !extend || extension.is_none() {
            let show = |value: Option<&String>| value.cloned().unwrap_or_else(|| "not set".into());
            differences.push(format!("  {key}: {} -> {}", show(from), show(to)));
        }
        extensions.extend(extension);
    }
    if differences.is_empty() {
        return Ok(extensions);
    }
    let is_all = !extend && differences.len() == extensions.len();
    let or = if is_all { "continue with --extend (which changes the following learning rates), " } else { "" };
    Err(TrainError::OtherRun { differences: differences.join("\n"), or, path: config.run_dir.clone() })
}

/// Returns the difference of a key as an extension if it is a larger step count.
fn extension(key: &str, from: Option<&String>, to: Option<&String>) -> Option<StepExtension> {
    let (_, stage) = *STEP_COUNTS.iter().find(|(name, _)| *name == key)?;
    let (from, to) = (from?.parse().ok()?, to?.parse().ok()?);
    (from < to).then_some(StepExtension { stage, from, to })
}

/// Returns dotted keys with their values as text.
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
    let mut number = 1;
    loop {
        let moved = folder.with_file_name(format!("{name}.{number}"));
        if !moved.exists() {
            return moved;
        }
        number += 1;
    }
}
