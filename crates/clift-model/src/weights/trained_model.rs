//! A trained model, opened from a weight file or taken during training.

use std::path::Path;

use burn::module::Module;
use burn::store::PathFilter;
use burn::tensor::Device;
use clift_core::ClipViews;

use crate::cost::largest_tensor::check_encoding;
use crate::cost::parameters::Parameters;
use crate::device::adapter::max_tensor_bytes;
use crate::error::ModelError;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::model::{Network, is_condenser};
use crate::network::renderer::Renderer;
use crate::tokens::count::TokenCount;
use crate::views::upload::Views;
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
    pub fn open(path: &Path, device: &Device) -> Result<Self, ModelError> {
        let path = ModelPath::find(path)?;
        Self::open_with(&path, &path.config()?, device)
    }

    /// Reads the weights of either stage. The condenser is trained if the file has its parameters.
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

    /// Copies the context views of a scene to the device. Refuses views if encoding them, or storing one of the numbers of
    /// tokens, takes a tensor that is too large for the device.
    pub fn upload(&self, context: &ClipViews, stored_tokens: &[TokenCount]) -> Result<Views, ModelError> {
        if let Some(limit) = max_tensor_bytes(&self.device) {
            let sizes = [context.num_views().max(1), context.height, context.width];
            check_encoding(&self.config, sizes, stored_tokens, limit)?;
        }
        Views::upload(&[context], &self.device)
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
