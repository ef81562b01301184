//! A trained model with the data that a command reads: those of its run, or a folder.

use std::path::{Path, PathBuf};

use clift_data::{
    ClipOptions, DatasetRoot, FileOptions, OpenedSource, SceneSource, SourceKind, SourceOptions, Split, open_dataset,
    open_source,
};
use clift_model::{ModelConfig, ModelPath, SHIPPED_MODEL, TrainedModel, is_shipped};
use clift_scene::{ContextChoice, photo_size};
use clift_train::{Config, NewestCheckpoint, TrainError};

use crate::commands::args::shared_args::{ConfigArgs, read_config};
use crate::exit_code::usage_bail;
use crate::output::counter::scan_counter;
use crate::output::stdout::print_note;

/// Environment variable with the path of another model to use where none is named.
const MODEL_VARIABLE: &str = "CLIFT_MODEL";

/// A trained model, its config, and the folder of scenes that replaces the data of the config.
pub struct ModelArgs {
    /// The model as given, or the shipped one.
    pub given: PathBuf,
    pub path: ModelPath,
    pub config: Config,
    /// Keys that `--set` gives.
    set_keys: Vec<String>,
    /// Data set or capture beside the model.
    pub folder: Option<PathBuf>,
    /// The weights of a run in training, in place of those of `path`.
    checkpoint: Option<NewestCheckpoint>,
}

impl ModelArgs {
    /// Takes `RUN`, `RUN DIR`, or `DIR` alone with the shipped model.
    pub fn find(first: &Path, folder: Option<&Path>, args: &ConfigArgs) -> anyhow::Result<Self> {
        if folder.is_none() && is_data(first) {
            let shipped = default_model();
            print_note(&format!("model: {}", shipped.display()));
            return Self::new(&shipped, Some(first), args);
        }
        Self::new(first, folder, args)
    }

    /// Takes what [`find`](Self::find) takes; of a run in training, the weights of its newest checkpoint.
    pub fn find_newest(first: &Path, folder: Option<&Path>, args: &ConfigArgs) -> anyhow::Result<Self> {
        let Some(checkpoint) = NewestCheckpoint::find(first)? else { return Self::find(first, folder, args) };
        let NewestCheckpoint { stage, step, path } = &checkpoint;
        print_note(&format!("{} in training, step {step}: {}", stage.name(), path.display()));
        let path = ModelPath { dir: first.into(), weights: path.join("model.bpk") };
        Ok(Self { checkpoint: Some(checkpoint), ..Self::read(first, path, folder, args)? })
    }

    /// Reads the config of a model. The config of an imported model has no data.
    pub fn new(model: &Path, folder: Option<&Path>, args: &ConfigArgs) -> anyhow::Result<Self> {
        if !model.exists() && !is_shipped(model) {
            usage_bail!("{}: no such file or folder", model.display());
        }
        Self::read(model, ModelPath::find(model)?, folder, args)
    }

    fn read(model: &Path, path: ModelPath, folder: Option<&Path>, args: &ConfigArgs) -> anyhow::Result<Self> {
        let (mut config, set_keys) = read_config(&path.dir.join("config.toml"), &args.set, |_| Ok(()))?;
        check_network(&config.model, &path)?;
        if let Some(key) = set_keys.iter().find(|key| ["data.width", "data.height"].contains(&key.as_str())) {
            usage_bail!(
                "--set {key}: the network makes noise of images of another size than in training; remove the override, and \
                 choose the size of frames with `clift render --size`"
            );
        }
        config.device = args.device.unwrap_or(config.device);
        let folder = folder.map(Path::to_path_buf);
        if folder.is_some() {
            config.data.source = SourceKind::Auto;
            config.data.root.clone_from(&folder);
        }
        config.validate()?;
        Ok(Self { given: model.into(), path, config, set_keys, folder, checkpoint: None })
    }

    /// Opens one split of the folder, or of the data of the config.
    pub fn open_data(&self, split: Split) -> anyhow::Result<OpenedSource> {
        let Some(folder) = &self.folder else {
            return Ok(open_dataset(&self.config.data, split, &mut scan_counter())?);
        };
        // The `data.files` keys of a run describe its own data: they apply only if `--set` sets one of them.
        let has_files = self.set_keys.iter().any(|key| key.starts_with("data.files"));
        let files = if has_files { self.config.data.files.clone() } else { FileOptions::default() };
        // The filters are for training scenes; the user chooses this scene by its key.
        let background = self.config.data.background;
        let min_size = [self.config.data.width, self.config.data.height];
        let options = SourceOptions { files, background, min_size, ..SourceOptions::default() };
        let opened = open_source(&DatasetRoot::find(folder)?, split, &options, &mut scan_counter())?;
        if opened.report.has_content() {
            print_note(&format!("{}: {}", folder.display(), opened.report));
        }
        Ok(opened)
    }

    /// Returns the preparation of the views of a scene: a network that was trained with several image sizes sees whole photos
    /// of a folder, others see photos cropped to the size of the training.
    pub fn clip_options(&self, source: &dyn SceneSource, scene: usize) -> anyhow::Result<ClipOptions> {
        let options = self.config.data.clip_options();
        if self.folder.is_none() || self.config.stage1.further_sizes.is_empty() {
            return Ok(options);
        }
        let (trained, photo) = ([options.width, options.height], source.image_size(scene, 0)?);
        let [width, height] = photo_size(trained, self.config.model.patch_size, photo);
        Ok(ClipOptions { width, height, ..options })
    }

    /// Returns the default context views of a scene: as many as in training, or those of a captured scene of the folder.
    pub fn context(&self) -> ContextChoice {
        let trained = self.config.data.views.max_context;
        match self.folder {
            None => ContextChoice::Spread(trained),
            Some(_) => ContextChoice::for_capture(&self.config.model, trained),
        }
    }

    /// Reads the weights.
    pub fn open(&self) -> Result<TrainedModel, TrainError> {
        let device = self.config.device.open()?;
        match &self.checkpoint {
            Some(checkpoint) => checkpoint.open(&self.config, &self.path.dir, &device),
            None => Ok(TrainedModel::open_with(&self.path, &self.config.model, &device)?),
        }
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

/// Returns the model that is used where none is named: that of `CLIFT_MODEL`, or the one that ships with clift.
pub fn default_model() -> PathBuf {
    std::env::var_os(MODEL_VARIABLE).map_or_else(|| SHIPPED_MODEL.into(), PathBuf::from)
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
