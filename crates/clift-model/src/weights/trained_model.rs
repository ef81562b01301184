//! A trained model, opened from a weight file or taken during training.

use std::path::Path;

use burn::module::Module;
use burn::store::PathFilter;
use burn::tensor::Device;

use crate::cost::parameters::Parameters;
use crate::error::ModelError;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::model::{Network, is_condenser};
use crate::network::parts::renderer::Renderer;
use crate::weights::file::{load_module, load_part};
use crate::weights::hash::{renderer_hash, weights_hash};
use crate::weights::model_path::{ModelPath, check_condenser, check_sizes};

/// A network with trained weights, on a device without autodiff.
#[derive(Clone, Debug)]
pub struct TrainedModel {
    /// Sizes and variant of the network.
    pub config: ModelConfig,
    /// The network. Its condenser is untrained if `has_condenser` is false.
    pub network: Network,
    /// Whether the condenser is trained, as it is after stage 2.
    pub has_condenser: bool,
    /// The device of the weights.
    pub device: Device,
}

impl TrainedModel {
    /// Opens a run, a model directory or a weight file, with the config beside it; see [`ModelPath::find`].
    ///
    /// # Errors
    /// As [`ModelPath::find`], [`ModelPath::config`] and [`TrainedModel::open_with`].
    pub fn open(path: &Path, device: &Device) -> Result<Self, ModelError> {
        let path = ModelPath::find(path)?;
        Self::open_with(&path, &path.config()?, device)
    }

    /// Reads the weights of either stage. The condenser is trained if the file has its parameters.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] if the number of heads differs from the config of the weights' directory,
    /// [`ModelError::Weights`] for a file that cannot be read or has other names or shapes.
    pub fn open_with(path: &ModelPath, config: &ModelConfig, device: &Device) -> Result<Self, ModelError> {
        check_sizes(config, &path.dir)?;
        let mut network = Network::new(config, 0, device);
        let mut loaded = load_part(&mut network, &PathFilter::all(), &path.weights)?;
        let has_condenser = loaded.applied.iter().any(|name| is_condenser(name));
        if has_condenser {
            check_condenser(config, &path.dir)?;
        } else {
            loaded.missing.retain(|name| !is_condenser(name));
        }
        loaded.require_all(&path.weights)?;
        Ok(Self { config: config.clone(), network, has_condenser, device: device.clone() })
    }

    /// Copies a network during training; `network` is on a device without autodiff.
    pub fn snapshot(network: &Network, config: &ModelConfig, has_condenser: bool) -> Self {
        let device = network.devices().into_iter().next().unwrap_or_default();
        Self { config: config.clone(), network: network.clone(), has_condenser, device }
    }

    /// Whether both models have equal encoders, as the two stages of a run must.
    pub fn has_encoder_of(&self, other: &Self) -> bool {
        weights_hash(&self.network.encoder) == weights_hash(&other.network.encoder)
    }

    /// Replaces the encoder by the equal one of `other`, so that both models share its memory.
    pub fn share_encoder(&mut self, other: &Self) {
        self.network.encoder = other.network.encoder.clone();
    }

    /// Returns the hash of weights, variant and heads of the renderer that scene files contain.
    pub fn renderer_hash(&self) -> String {
        renderer_hash(&self.network.renderer, &self.config)
    }
}

/// Reads the renderer of a network from a weight file, whose sizes may come from a hostile scene file.
///
/// # Errors
/// [`ModelError::Weights`] for a file that cannot be read, is too small or lacks parameters of the renderer.
pub fn open_renderer(config: &ModelConfig, path: &Path, device: &Device) -> Result<Renderer, ModelError> {
    let refuse = |reason: String| ModelError::Weights { action: "reading", reason, path: path.into() };
    let size = std::fs::metadata(path).map_err(|error| refuse(error.to_string()))?.len();
    // No more memory is allocated than the weight file, which may be in f16, can fill.
    let needed = 2 * Parameters::of(config).renderer;
    if needed > size {
        return Err(refuse(format!("the scene's renderer needs at least {needed} bytes, the file has {size}")));
    }
    let mut renderer = Renderer::new(config, &mut Init::of(config, 0, device));
    let missing = load_module(&mut renderer, "renderer", path)?.missing;
    if let Some(name) = missing.first() {
        let count = missing.len();
        return Err(refuse(format!("{count} parameters of the scene's renderer are missing (renderer.{name})")));
    }
    Ok(renderer)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::architecture::CliftVariant;
    use crate::testing::small_config;
    use crate::weights::file::{save_part, save_part_f16, save_weights};

    #[test]
    fn both_stages_open_and_stage_1_has_no_condenser() {
        let folder = tempfile::tempdir().unwrap();
        let device = Device::flex();
        let config = small_config(CliftVariant::Paper);
        let network = Network::new(&config, 3, &device);
        let path = |name: &str| ModelPath { dir: folder.path().into(), weights: folder.path().join(name) };
        let [stage1, stage2] = ["stage1", "stage2"].map(path);
        save_part(&network, &Network::stage1_part(), &stage1.weights).unwrap();
        save_weights(&network, &stage2.weights).unwrap();
        let models = [&stage1, &stage2].map(|path| TrainedModel::open_with(path, &config, &device).unwrap());
        assert_eq!([0, 1].map(|i| models[i].has_condenser), [false, true]);
        assert!(models[0].has_encoder_of(&models[1]));
        assert_eq!(weights_hash(&models[1].network), weights_hash(&network));
        let other = TrainedModel::snapshot(&Network::new(&config, 4, &device), &config, false);
        assert!(!other.has_encoder_of(&models[0]));

        // A part of a file is read without the rest, which is unused; the condenser keeps its values.
        let mut read = Network::new(&config, 5, &device);
        let condenser = weights_hash(&read.condenser);
        let loaded = load_part(&mut read, &Network::stage1_part(), &stage2.weights).unwrap();
        assert!(loaded.missing.is_empty() && loaded.unused.iter().all(|name| is_condenser(name)), "{loaded:?}");
        assert_eq!(weights_hash(&read.condenser), condenser);
        let loaded = load_part(&mut read, &Network::stage1_part(), &stage1.weights).unwrap();
        loaded.require_all(&stage1.weights).unwrap();
    }

    #[test]
    fn renderers_open_from_f16_and_files_too_small_for_them_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let device = Device::flex();
        for variant in CliftVariant::ALL {
            let config = small_config(variant);
            let network = Network::new(&config, 3, &device);
            let path = folder.path().join(variant.as_str());
            // The smallest file with a renderer.
            let renderer = PathFilter::from_predicate(|name, _| name.starts_with("renderer."));
            save_part_f16(&network, &renderer, &path).unwrap();
            open_renderer(&config, &path, &device).unwrap();
            let larger = ModelConfig { num_renderer_blocks: 64, ..config };
            let message = open_renderer(&larger, &path, &device).unwrap_err().to_string();
            assert!(message.contains("the scene's renderer needs at least "), "{message}");
        }
    }
}
