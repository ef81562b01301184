//! A trained model with the data that a command reads: those of its run, or a folder.

use std::path::{Path, PathBuf};

use clift_data::{
    DataError, DatasetRoot, FileOptions, OpenedSource, SceneSource, SourceKind, SourceOptions, Split, open_dataset,
    open_source,
};
use clift_model::{ModelConfig, ModelError, ModelPath, TrainedModel};
use clift_scene::default_num_context;
use clift_train::{Config, Override};

use crate::commands::args::shared_args::{ConfigArgs, read_config};
use crate::exit_code::usage_bail;
use crate::output::counter::ScanCounter;
use crate::output::stdout::{print_note, print_warning};

/// The model that is used where none is named, trained on synthetic scenes.
const SHIPPED_MODEL: &str = "models/rooms";

/// Environment variable with the path of another model to use where none is named.
const MODEL_VARIABLE: &str = "CLIFT_MODEL";

/// A trained model, its config, and the folder of scenes that replaces the data of the config.
pub struct ModelArgs {
    /// The model as given, or the shipped one.
    pub given: PathBuf,
    pub path: ModelPath,
    pub config: Config,
    overrides: Vec<Override>,
    /// Data set or capture beside the model.
    pub folder: Option<PathBuf>,
}

impl ModelArgs {
    /// Takes `RUN`, `RUN DIR`, or `DIR` alone with the shipped model.
    pub fn find(first: &Path, folder: Option<&Path>, args: &ConfigArgs) -> anyhow::Result<Self> {
        if folder.is_none() && is_data(first) {
            let shipped = shipped_model()?;
            print_note(&format!("model: {}", shipped.display()));
            return Self::new(&shipped, Some(first), args);
        }
        Self::new(first, folder, args)
    }

    /// Reads the config of a model. The config of an imported model has no data.
    pub fn new(model: &Path, folder: Option<&Path>, args: &ConfigArgs) -> anyhow::Result<Self> {
        if !model.exists() {
            usage_bail!("{}: no such file or folder", model.display());
        }
        let path = ModelPath::find(model)?;
        let (mut config, overrides) = read_config(&path.dir.join("config.toml"), &args.set, |_| Ok(()))?;
        check_network(&config.model, &path)?;
        let sizes = overrides.iter().filter(|change| ["data.width", "data.height"].contains(&change.key.as_str()));
        for Override { key, from, to, .. } in sizes {
            if let Some(trained) = from.as_ref().filter(|from| *from != to) {
                print_warning(format!("--set {key}: the network was trained with {trained}; other sizes lose quality"));
            }
        }
        config.device = args.device.unwrap_or(config.device);
        let folder = folder.map(Path::to_path_buf);
        if folder.is_some() {
            config.data.source = SourceKind::Auto;
            config.data.root.clone_from(&folder);
        }
        config.validate()?;
        Ok(Self { given: model.into(), path, config, overrides, folder })
    }

    /// Opens one split of the folder, or of the data of the config.
    pub fn open_data(&self, split: Split) -> anyhow::Result<OpenedSource> {
        let Some(folder) = &self.folder else {
            let mut counter = ScanCounter::default();
            return Ok(open_dataset(&self.config.data, split, &mut |done, total| counter.set(done, total))?);
        };
        // The `data.files` keys of a run describe its own data: they apply only if `--set` sets one of them.
        let has_files = self.overrides.iter().any(|change| change.key.starts_with("data.files"));
        let files = if has_files { self.config.data.files.clone() } else { FileOptions::default() };
        // The filters are for training scenes; the user chooses this scene by its key.
        let background = self.config.data.background;
        let options = SourceOptions { files, background, ..SourceOptions::default() };
        let opened = open_source(&DatasetRoot::find(folder)?, split, &options)?;
        if opened.report.has_content() {
            print_note(&format!("{}: {}", folder.display(), opened.report));
        }
        Ok(opened)
    }

    /// Returns the default number of context views of a scene: as many as in training, or [`default_num_context`] of a scene
    /// of the folder.
    ///
    /// # Errors
    /// Those of counting the frames.
    pub fn num_context(&self, source: &dyn SceneSource, scene: usize) -> Result<usize, DataError> {
        let trained = self.config.data.views.max_context;
        if self.folder.is_none() {
            return Ok(trained);
        }
        default_num_context(&self.config.model, trained, source, scene)
    }

    /// Reads the weights.
    pub fn open(&self) -> Result<TrainedModel, ModelError> {
        TrainedModel::open_with(&self.path, &self.config.model, &self.config.device.open()?)
    }
}

/// Refuses another network than that of the weights. Tensor shapes do not determine the number of heads nor the camera
/// encoding: a wrong one would silently change the tokens.
pub fn check_network(model: &ModelConfig, path: &ModelPath) -> anyhow::Result<()> {
    if *model != (ModelConfig { patch_grids: model.patch_grids, ..path.config()? }) {
        usage_bail!("--set model: the weights were trained with another network; remove the override");
    }
    Ok(())
}

/// Whether a path is a data set, a capture or its `transforms.json`: neither a run, a model nor a scene file.
pub fn is_data(path: &Path) -> bool {
    let is_json = path.extension().is_some_and(|extension| extension == "json") && path.is_file();
    is_json || path.is_dir() && !path.join("config.toml").exists() && ModelPath::find(path).is_err()
}

/// Returns the model that ships with clift: that of `CLIFT_MODEL`, or `models/rooms` in the current folder or above the
/// program.
pub fn shipped_model() -> anyhow::Result<PathBuf> {
    if let Some(model) = std::env::var_os(MODEL_VARIABLE) {
        return Ok(model.into());
    }
    let program = std::env::current_exe().unwrap_or_default();
    let places = std::iter::once(Path::new("")).chain(program.ancestors().skip(1));
    let mut places = places.map(|place| place.join(SHIPPED_MODEL));
    let Some(model) = places.find(|place| place.is_dir()) else {
        usage_bail!(
            "no run or model is named, and {SHIPPED_MODEL}, which ships with clift, is not found; run from the repository, \
             or set {MODEL_VARIABLE} to its path"
        )
    };
    Ok(model)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_without_config_and_transforms_are_data() {
        let place = tempfile::tempdir().unwrap();
        let path = |name: &str| place.path().join(name);
        std::fs::create_dir_all(path("run/stage1")).unwrap();
        assert!(is_data(&path("run")));
        std::fs::write(path("run/config.toml"), "").unwrap();
        assert!(!is_data(&path("run")), "a run that is not trained yet");
        std::fs::write(path("run/stage1/model.safetensors"), "").unwrap();
        assert!(!is_data(&path("run/stage1")) && !is_data(&path("run/stage1/model.safetensors")));
        std::fs::create_dir_all(path("photos")).unwrap();
        std::fs::write(path("photos/transforms.json"), "{}").unwrap();
        assert!(is_data(&path("photos")) && is_data(&path("photos/transforms.json")));
        assert!(!is_data(&path("none")) && !is_data(&path("none.json")));
    }
}
