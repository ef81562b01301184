//! A trained model, ready to use: what a weight file or a step of training gives.

use std::path::Path;

use burn::module::Module;
use burn::tensor::Device;

use crate::error::ModelError;
use crate::network::clift::{Clift, is_condenser};
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::renderer::Renderer;
use crate::weights::model_path::{ModelPath, check_heads};
use crate::weights::{file, hash};

/// A network with trained weights, on a device without autodiff.
#[derive(Clone, Debug)]
pub struct TrainedModel {
    /// Sizes of the network.
    pub config: ModelConfig,
    /// The network. Its condenser is untrained if `has_condenser` is false.
    pub network: Clift,
    /// Whether the condenser is trained: after stage 2.
    pub has_condenser: bool,
    /// The device of the weights.
    pub device: Device,
}

impl TrainedModel {
    /// Reads the weights of a network of either stage.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] for other heads than those of the directory's config, [`ModelError::Weights`] for a file
    /// that cannot be read or has other names or shapes.
    pub fn open(path: &ModelPath, config: &ModelConfig, device: &Device) -> Result<Self, ModelError> {
        check_heads(config, &path.dir)?;
        let mut network = Clift::new(config, 0, device);
        let mut loaded = file::load(&mut network, &path.weights)?;
        let has_condenser = loaded.applied.iter().any(|name| is_condenser(name));
        if !has_condenser {
            loaded.missing.retain(|name| !is_condenser(name));
        }
        loaded.require_all(&path.weights)?;
        Ok(Self { config: config.clone(), network, has_condenser, device: device.clone() })
    }

    /// Takes a network as it is during training, on a device without autodiff.
    pub fn snapshot(network: &Clift, config: &ModelConfig, has_condenser: bool) -> Self {
        let device = network.devices().into_iter().next().unwrap_or_default();
        Self { config: config.clone(), network: network.clone(), has_condenser, device }
    }

    /// Whether both models have the same encoder, as those of the two stages of a run must.
    pub fn has_encoder_of(&self, other: &Self) -> bool {
        hash::weights_hash(&self.network.encoder) == hash::weights_hash(&other.network.encoder)
    }

    /// Replaces the encoder by that of `other`, which must be equal, so that its weights are in memory once.
    pub fn share_encoder(&mut self, other: &Self) {
        self.network.encoder = other.network.encoder.clone();
    }

    /// [`hash::renderer_hash`] of the renderer, which scene files hold.
    pub fn renderer_hash(&self) -> String {
        hash::renderer_hash(&self.network.renderer, &self.config)
    }
}

/// Reads the renderer alone out of a weight file.
///
/// # Errors
/// [`ModelError::Weights`] for a file that cannot be read or holds no such renderer.
pub fn open_renderer(config: &ModelConfig, path: &Path, device: &Device) -> Result<Renderer, ModelError> {
    let refuse = |reason: String| ModelError::Weights { action: "reading", reason, path: path.into() };
    let size = std::fs::metadata(path).map_err(|error| refuse(error.to_string()))?.len();
    // The sizes may come from a hostile scene file: nothing is allocated that the weight file cannot fill.
    let needed = min_renderer_bytes(config);
    if needed > size {
        return Err(refuse(format!("the scene's renderer takes {needed} bytes at least, the file has {size}")));
    }
    let mut renderer = Renderer::new(config, &mut Init::new(0, device));
    let missing = file::load_module(&mut renderer, "renderer", path)?.missing;
    if let Some(name) = missing.first() {
        let count = missing.len();
        return Err(refuse(format!("{count} parameters of the scene's renderer are missing (renderer.{name})")));
    }
    Ok(renderer)
}

/// Bytes of the matrices of a renderer's blocks.
fn min_renderer_bytes(config: &ModelConfig) -> u64 {
    let [dim, hidden, blocks] = [config.dim, config.feed_forward_dim, config.num_renderer_blocks].map(|n| n as u64);
    // Four matrices each for self- and cross-attention, two for the feed-forward network, in f32. The largest sizes that
    // a config may have do not overflow.
    4 * blocks * (8 * dim * dim + 2 * dim * hidden)
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONFIG: ModelConfig = ModelConfig {
        variant: crate::network::architecture::CliftVariant::Paper,
        dim: 16,
        num_heads: 2,
        feed_forward_dim: 24,
        num_encoder_blocks: 1,
        num_renderer_blocks: 1,
        patch_size: 8,
        condenser: crate::network::config::CondenserConfig { num_blocks: 1, residual: true },
    };

    #[test]
    fn weights_of_both_stages_open_and_those_of_stage_1_hold_no_condenser() {
        let place = tempfile::tempdir().unwrap();
        let device = Device::flex();
        let network = Clift::new(&CONFIG, 3, &device);
        let path = |name: &str| ModelPath { dir: place.path().into(), weights: place.path().join(name) };
        let [stage1, stage2] = ["stage1", "stage2"].map(path);
        file::save_part(&network, &Clift::stage1_part(), &stage1.weights).unwrap();
        file::save_weights(&network, &stage2.weights).unwrap();
        let names = |path: &ModelPath| {
            let bytes = std::fs::read(&path.weights).unwrap();
            let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
            file.names().into_iter().map(String::from).collect::<std::collections::BTreeSet<_>>()
        };
        let mut trained_in_stage1 = names(&stage2);
        trained_in_stage1.retain(|name| !is_condenser(name));
        assert_eq!(names(&stage1), trained_in_stage1);
        assert!(trained_in_stage1.len() < names(&stage2).len());

        let models = [&stage1, &stage2].map(|path| TrainedModel::open(path, &CONFIG, &device).unwrap());
        assert_eq!([0, 1].map(|i| models[i].has_condenser), [false, true]);
        assert!(models[0].has_encoder_of(&models[1]));
        assert_eq!(hash::weights_hash(&models[1].network), hash::weights_hash(&network));
        let other = TrainedModel::snapshot(&Clift::new(&CONFIG, 4, &device), &CONFIG, false);
        assert!(!other.has_encoder_of(&models[0]));

        // A part is read without the rest, and what the file has beside it is unused.
        let mut read = Clift::new(&CONFIG, 5, &device);
        let loaded = file::load_part(&mut read, &Clift::stage1_part(), &stage2.weights).unwrap();
        assert!(loaded.missing.is_empty() && loaded.unused.iter().all(|name| is_condenser(name)), "{loaded:?}");
        assert_eq!(loaded.unused.len() + trained_in_stage1.len(), names(&stage2).len());
        assert_eq!(hash::weights_hash(&read.condenser), hash::weights_hash(&Clift::new(&CONFIG, 5, &device).condenser));
        file::load_part(&mut read, &Clift::stage1_part(), &stage1.weights)
            .unwrap()
            .require_all(&stage1.weights)
            .unwrap();
    }
}
