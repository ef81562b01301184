//! The paths of a trained model: its weight file and the directory of its config.

use std::fmt::Display;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use crate::error::ModelError;
use crate::network::config::ModelConfig;
use crate::tokens::kind::TokenKind;
use crate::weights::shipped_model::find_shipped;

/// A run or model directory, and one of its weight files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelPath {
    /// The directory with `config.toml`.
    pub dir: PathBuf,
    /// The weight file: the given one, or that of the last finished stage.
    pub weights: PathBuf,
}

impl ModelPath {
    /// Finds the weights of a run directory, a stage folder (`RUN/stage2`) or a model directory; or the config of a weight
    /// file in one of these; or the [shipped model](crate::find_shipped).
    pub fn find(path: &Path) -> Result<Self, ModelError> {
        let path = &*find_shipped(path)?;
        let inside = path.join(WEIGHTS);
        if path.is_dir() && inside.is_file() {
            // The config of a stage folder is in the run directory.
            let has_config = path.join("config.toml").is_file();
            return if has_config { Ok(Self { dir: path.into(), weights: inside }) } else { Self::find(&inside) };
        }
        if path.is_dir() {
            let stages = [TokenKind::Clift, TokenKind::Kmeans].map(|kind| weights_of(path, kind));
            let found = stages.iter().find(|file| file.exists()).cloned();
            let weights = found.ok_or_else(|| ModelError::NoModel { path: stages[1].clone() })?;
            return Ok(Self { dir: path.into(), weights });
        }
        if !path.exists() {
            return Err(ModelError::NoModel { path: path.into() });
        }
        refuse_checkpoint(path)?;
        let above = path.ancestors().skip(1).take(2);
        let mut above = above.map(|dir| if dir.as_os_str().is_empty() { Path::new(".") } else { dir });
        let dir = above.find(|dir| dir.join("config.toml").is_file());
        let dir = dir.ok_or_else(|| ModelError::NoConfig { path: path.into() })?;
        Ok(Self { dir: dir.into(), weights: path.into() })
    }

    /// Returns the weight file that renders tokens of a kind: that of stage 1 or 2 of a run directory, that of a model
    /// directory, or `path` itself if `path` is not a directory. The file need not exist.
    pub fn for_tokens(path: &Path, kind: TokenKind) -> Result<PathBuf, ModelError> {
        let path = &*find_shipped(path)?;
        let inside = path.join(WEIGHTS);
        Ok(match (path.is_dir(), inside.is_file()) {
            (true, true) => inside,
            (true, false) => weights_of(path, kind),
            (false, _) => path.into(),
        })
    }

    /// Reads `[model]` of `config.toml`; the other sections are ignored.
    pub fn config(&self) -> Result<ModelConfig, ModelError> {
        read_config(&self.dir)?.ok_or_else(|| ModelError::NoConfig { path: self.weights.clone() })
    }
}

const WEIGHTS: &str = "model.safetensors";

fn weights_of(run: &Path, kind: TokenKind) -> PathBuf {
    let stage = match kind {
        TokenKind::Clift => "stage2",
        TokenKind::Kmeans | TokenKind::All => "stage1",
    };
    run.join(stage).join(WEIGHTS)
}

/// Returns an error for a PyTorch checkpoint, recognised by its extension or as a ZIP archive.
pub fn refuse_checkpoint(path: &Path) -> Result<(), ModelError> {
    if !path.is_file() {
        return Ok(());
    }
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    let mut start = [0; 4];
    let is_archive =
        File::open(path).is_ok_and(|mut file| file.read_exact(&mut start).is_ok() && start == *b"PK\x03\x04");
    if is_archive || matches!(&*extension, "ckpt" | "pt" | "pth") {
        return Err(ModelError::NotImported { path: path.into() });
    }
    Ok(())
}

/// Checks that encoder and renderer of a network have the sizes in the config of its weights' directory, if there is one.
/// Tensor shapes do not determine heads and camera encoding, and a file may have more blocks than are read: another value
/// would silently change the output.
pub fn check_sizes(model: &ModelConfig, dir: &Path) -> Result<(), ModelError> {
    read_config(dir)?.map_or(Ok(()), |found| check_equal_sizes(model, &found, dir))
}

/// Checks that encoder and renderer of a network have the sizes `found` in the config of `dir`.
pub(crate) fn check_equal_sizes(model: &ModelConfig, found: &ModelConfig, dir: &Path) -> Result<(), ModelError> {
    check_equal("model.num_heads", model.num_heads, found.num_heads, dir)?;
    check_equal("model.architecture", model.architecture, found.architecture, dir)?;
    check_equal("model.camera_encoding", model.camera_encoding, found.camera_encoding, dir)?;
    check_equal("model.rays", model.rays, found.rays, dir)?;
    check_equal("model.patch_size", model.patch_size, found.patch_size, dir)?;
    check_equal("model.dim", model.dim, found.dim, dir)?;
    check_equal("model.feed_forward_dim", model.feed_forward_dim, found.feed_forward_dim, dir)?;
    check_equal("model.num_encoder_blocks", model.num_encoder_blocks, found.num_encoder_blocks, dir)?;
    check_equal("model.num_renderer_blocks", model.num_renderer_blocks, found.num_renderer_blocks, dir)?;
    check_equal("model.num_latents", model.num_latents, found.num_latents, dir)
}

/// Checks what tensor shapes do not determine in the condenser, for weights with a trained one.
pub fn check_condenser(model: &ModelConfig, dir: &Path) -> Result<(), ModelError> {
    let Some(found) = read_config(dir)? else { return Ok(()) };
    let [own, other] = [model, &found].map(|config| config.condenser.member_share);
    check_equal("model.condenser.member_share", own, other, dir)
}

fn check_equal<T: PartialEq + Display>(key: &'static str, own: T, other: T, dir: &Path) -> Result<(), ModelError> {
    if own == other {
        return Ok(());
    }
    let path = dir.join("config.toml");
    let fix = format!("the weights are of a network with {other}; write the same: {}", path.display());
    Err(ModelError::BadConfig { key, value: own.to_string(), fix })
}

pub(crate) fn read_config(dir: &Path) -> Result<Option<ModelConfig>, ModelError> {
    #[derive(serde::Deserialize)]
    struct Sections {
        #[serde(default)]
        model: ModelConfig,
    }
    let path = dir.join("config.toml");
    if !path.exists() {
        return Ok(None);
    }
    let bad = |reason: String| ModelError::BadConfigFile { reason, path: path.clone() };
    let text = std::fs::read_to_string(&path).map_err(|error| bad(error.to_string()))?;
    let sections: Sections = toml::from_str(&text).map_err(|error| bad(error.to_string()))?;
    Ok(Some(sections.model))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_lead_to_their_last_stage_and_files_to_their_run() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        let touch = |name: &str| {
            std::fs::create_dir_all(run.join(name).parent().unwrap()).unwrap();
            std::fs::write(run.join(name), "").unwrap();
            run.join(name)
        };
        touch("config.toml");
        assert!(matches!(ModelPath::find(&run), Err(ModelError::NoModel { .. })));
        let stage1 = touch("stage1/model.safetensors");
        let found = ModelPath::find(&run).unwrap();
        assert_eq!(found, ModelPath { dir: run.clone(), weights: stage1.clone() });
        assert_eq!(found.config().unwrap(), ModelConfig::default());
        let stage2 = touch("stage2/model.safetensors");
        assert_eq!(ModelPath::find(&run).unwrap().weights, stage2);
        assert_eq!(ModelPath::find(&stage1).unwrap(), ModelPath { dir: run.clone(), weights: stage1.clone() });
        assert_eq!(ModelPath::find(&run.join("stage1")).unwrap(), ModelPath::find(&stage1).unwrap());
        assert_eq!(ModelPath::for_tokens(&run, TokenKind::Kmeans).unwrap(), stage1);
        assert_eq!(ModelPath::for_tokens(&stage2, TokenKind::Clift).unwrap(), stage2);

        let alone = folder.path().join("alone.safetensors");
        assert!(matches!(ModelPath::find(&alone), Err(ModelError::NoModel { .. })));
        std::fs::write(&alone, "").unwrap();
        assert!(matches!(ModelPath::find(&alone), Err(ModelError::NoConfig { .. })));
        // A checkpoint, recognised by its name or by its first bytes.
        for (name, bytes) in [("run/stage1/last.ckpt", "damaged"), ("alone.bin", "PK\u{3}\u{4}")] {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            let message = ModelPath::find(&path).unwrap_err().to_string();
            assert!(message.contains(&format!("run `clift import {}", path.display())), "{message}");
        }
    }

    #[test]
    fn sizes_must_equal_those_of_the_config() {
        let folder = tempfile::tempdir().unwrap();
        let check = |text: &str, num_heads| {
            std::fs::write(folder.path().join("config.toml"), text).unwrap();
            let model = ModelConfig { num_heads, ..ModelConfig::default() };
            check_sizes(&model, folder.path()).map_err(|error| error.to_string())
        };
        assert_eq!(check("[model]\nnum_heads = 4\n[data]\nof_a_later_version = 1", 4), Ok(()));
        assert_eq!(check("seed = 3", 8), Ok(()), "the default");
        check_sizes(&ModelConfig::default(), &folder.path().join("none")).unwrap();
        let message = check("[model]\nnum_heads = 4", 8).unwrap_err();
        assert!(message.contains("`model.num_heads` = 8: ") && message.contains("a network with 4; "), "{message}");
        let message = check("[model]\nnum_encoder_blocks = 7", 8).unwrap_err();
        assert!(message.contains("`model.num_encoder_blocks` = 6: "), "{message}");
        assert!(check("[model]\ncamera_encoding = \"gta\"", 8).unwrap_err().contains("a network with gta; "));
        assert_eq!(check("[model.condenser]\nmember_share = true", 8), Ok(()), "stage 2 may have another condenser");
        let message = check_condenser(&ModelConfig::default(), folder.path()).unwrap_err().to_string();
        assert!(message.contains("`model.condenser.member_share` = false: "), "{message}");
    }
}
