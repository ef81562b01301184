//! Networks that are done training, to encode scenes with.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use clift_model::{Clift, Condenser, Encoder, LiftNorm, ModelConfig, Renderer, TokenKind, weights};

use crate::TrainError;
use crate::config::Config;
use crate::events::Stage;

/// A run or model directory, and one of its weight files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelPath {
    /// Directory with the `config.toml` of the run.
    pub run: PathBuf,
    /// The weights: those of the last stage that is done, unless a file was given.
    pub weights: PathBuf,
}

impl ModelPath {
    /// Finds the run and the weights of `RUN`, `RUN/stageN/model.safetensors`, or a model directory.
    ///
    /// # Errors
    /// [`TrainError::Missing`] for a run without weights and for no file, [`TrainError::NoConfig`] for a weight file
    /// without a config, [`TrainError::NotImported`] for a checkpoint of PyTorch.
    pub fn find(path: &Path) -> Result<Self, TrainError> {
        let missing = |path: &Path| TrainError::Missing {
            stage: "encoding",
            what: "a trained model",
            first: "clift train",
            path: path.into(),
        };
        let inside = path.join("model.safetensors");
        if path.is_dir() && inside.is_file() {
            // The folder of a stage has no config of its own.
            let has_config = path.join("config.toml").is_file();
            return if has_config { Ok(Self { run: path.into(), weights: inside }) } else { Self::find(&inside) };
        }
        if path.is_dir() {
            let weights = [Stage::Stage2, Stage::Stage1].map(|stage| weights_of(path, stage));
            let [_, first] = &weights;
            let found = weights.iter().find(|file| file.exists()).cloned();
            let weights = found.ok_or_else(|| missing(first))?;
            return Ok(Self { run: path.into(), weights });
        }
        if !path.exists() {
            return Err(missing(path));
        }
        refuse_checkpoint(path)?;
        let above = path.ancestors().skip(1).take(2);
        let run = above.map(|folder| if folder.as_os_str().is_empty() { Path::new(".") } else { folder });
        let run = run.into_iter().find(|folder| folder.join("config.toml").is_file());
        let run = run.ok_or_else(|| TrainError::NoConfig { path: path.into() })?;
        Ok(Self { run: run.into(), weights: path.into() })
    }
}

/// Refuses a file of PyTorch's where a model of this program is expected: by its name, or by its start, which is that of
/// a ZIP archive.
pub(crate) fn refuse_checkpoint(path: &Path) -> Result<(), TrainError> {
    if !path.is_file() {
        return Ok(());
    }
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    let mut start = [0; 4];
    let is_archive =
        File::open(path).is_ok_and(|mut file| file.read_exact(&mut start).is_ok() && start == *b"PK\x03\x04");
    if is_archive || matches!(&*extension, "ckpt" | "pt" | "pth") {
        return Err(TrainError::NotImported { path: path.into() });
    }
    Ok(())
}

/// Refuses to take the weights of a run or model directory for those of a network with other heads. No shape shows
/// heads: it would compute something else without a word.
pub(crate) fn check_heads(model: &ModelConfig, folder: &Path) -> Result<(), TrainError> {
    #[derive(serde::Deserialize)]
    struct Its {
        #[serde(default)]
        model: ModelConfig,
    }
    let path = folder.join("config.toml");
    if !path.exists() {
        return Ok(()); // nothing says what they are
    }
    let text = std::fs::read_to_string(&path).map_err(TrainError::io("reading the configuration", &path))?;
    let its: Its = toml::from_str(&text).map_err(TrainError::bad_file("configuration", &path))?;
    let num_heads = its.model.num_heads;
    if model.num_heads != num_heads {
        let fix = format!("the weights are those of a network with {num_heads} heads: write that: {}", path.display());
        return Err(TrainError::BadConfig { key: "model.num_heads".into(), value: model.num_heads.to_string(), fix });
    }
    Ok(())
}

/// The weight file of a run that draws tokens of this kind.
pub fn renderer_weights(run_or_file: &Path, kind: TokenKind) -> PathBuf {
    let stage = match kind {
        TokenKind::Clift => Stage::Stage2,
        TokenKind::Kmeans => Stage::Stage1,
    };
    let model = run_or_file.join("model.safetensors");
    match (run_or_file.is_dir(), model.is_file()) {
        (true, true) => model,
        (true, false) => weights_of(run_or_file, stage),
        (false, _) => run_or_file.into(),
    }
}

fn weights_of(run: &Path, stage: Stage) -> PathBuf {
    run.join(stage.name()).join("model.safetensors")
}

/// The networks of a weight file, on a device without autodiff.
#[derive(Clone, Debug)]
pub struct Trained {
    /// Posed pictures to tokens.
    pub encoder: Encoder,
    /// A norm of those, in the variant that has one.
    pub lift_norm: LiftNorm,
    /// Where the file has one: stage 2.
    pub condenser: Option<Condenser>,
    /// The renderer trained with it.
    pub renderer: Renderer,
    /// Where they live.
    pub device: Device,
}

impl Trained {
    /// Reads a weight file of the model of `config`, of either stage.
    ///
    /// # Errors
    /// [`clift_model::ModelError::Weights`] for a file that cannot be read or holds another model, and what opening the
    /// device gives.
    pub fn load(config: &Config, path: &Path) -> Result<Self, TrainError> {
        let device = config.device.open()?;
        let mut model = Clift::new(&config.model, config.seed, &device);
        let loaded = weights::load(&mut model, path)?;
        let has_condenser = !loaded.missing.iter().any(|name| name.starts_with("condenser."));
        if has_condenser || loaded.missing.iter().any(|name| !name.starts_with("condenser.")) {
            loaded.require_all(path)?;
        }
        let Clift { encoder, lift_norm, condenser, renderer } = model;
        Ok(Self { encoder, lift_norm, condenser: has_condenser.then_some(condenser), renderer, device })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_gives_its_last_stage_and_a_file_its_run() {
        let place = tempfile::tempdir().unwrap();
        let run = place.path().join("run");
        let touch = |name: &str| {
            std::fs::create_dir_all(run.join(name).parent().unwrap()).unwrap();
            std::fs::write(run.join(name), "").unwrap();
            run.join(name)
        };
        touch("config.toml");
        let message = ModelPath::find(&run).unwrap_err().to_string();
        assert!(
            message.starts_with("encoding needs a trained model, which is not there; run clift train"),
            "{message}"
        );
        let stage1 = touch("stage1/model.safetensors");
        assert_eq!(ModelPath::find(&run).unwrap(), ModelPath { run: run.clone(), weights: stage1.clone() });
        let stage2 = touch("stage2/model.safetensors");
        assert_eq!(ModelPath::find(&run).unwrap().weights, stage2);
        assert_eq!(ModelPath::find(&stage1).unwrap(), ModelPath { run: run.clone(), weights: stage1.clone() });
        assert_eq!(ModelPath::find(&run.join("stage1")).unwrap(), ModelPath::find(&stage1).unwrap());
        assert_eq!(renderer_weights(&run, TokenKind::Kmeans), stage1);
        assert_eq!(renderer_weights(&stage2, TokenKind::Clift), stage2);

        let alone = place.path().join("alone.safetensors");
        let message = ModelPath::find(&alone).unwrap_err().to_string();
        assert!(message.starts_with("encoding needs a trained model, which is not there"), "{message}");
        std::fs::write(&alone, "").unwrap();
        let message = ModelPath::find(&alone).unwrap_err().to_string();
        assert!(message.contains("no config.toml beside it or above it") && !message.contains("  "), "{message}");
        // A checkpoint, by its name or by its start.
        for (name, bytes) in [("run/stage1/last.ckpt", "damaged"), ("alone.bin", "PK\u{3}\u{4}")] {
            let path = place.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            let message = ModelPath::find(&path).unwrap_err().to_string();
            assert!(message.contains(&format!("run `clift import {}", path.display())), "{message}");
        }
    }

    #[test]
    fn other_heads_than_a_directory_says_are_refused() {
        let place = tempfile::tempdir().unwrap();
        let check = |text: &str, num_heads| {
            std::fs::write(place.path().join("config.toml"), text).unwrap();
            let model = ModelConfig { num_heads, ..ModelConfig::default() };
            check_heads(&model, place.path()).map_err(|error| error.to_string())
        };
        assert_eq!(check("[model]\nnum_heads = 4\n[data]\nof_a_later_version = 1", 4), Ok(()));
        assert_eq!(check("seed = 3", 8), Ok(()), "the default");
        check_heads(&ModelConfig::default(), &place.path().join("none")).unwrap();
        let message = check("[model]\nnum_heads = 4", 8).unwrap_err();
        assert!(message.contains("`model.num_heads` = 8: ") && message.contains("with 4 heads"), "{message}");
    }
}
