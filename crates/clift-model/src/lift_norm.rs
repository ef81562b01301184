//! What stands between the encoder and those who read its tokens.

use burn::module::Module;
use burn::nn::LayerNorm;
use burn::tensor::Tensor;

use crate::{Init, ModelConfig};

/// A layer norm of the encoder's tokens in the released DL3DV network, nothing in the others. The encoder is frozen
/// in stage 2, this norm is trained in both.
#[derive(Module, Debug)]
pub struct LiftNorm {
    norm: Option<LayerNorm>,
}

impl LiftNorm {
    /// Makes what the variant has.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self { norm: config.variant.has_norms().then(|| init.layer_norm(config.dim)) }
    }

    /// Whether tokens are changed at all.
    pub fn is_norm(&self) -> bool {
        self.norm.is_some()
    }

    /// The tokens that K-means, condenser and renderer read.
    ///
    /// # Shapes
    /// - `lift` and the result: `[batch, num_tokens, dim]`
    pub fn forward(&self, lift: Tensor<3>) -> Tensor<3> {
        match &self.norm {
            Some(norm) => norm.forward(lift),
            None => lift,
        }
    }
}
