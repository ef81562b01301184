//! The norm of the encoder's tokens, and the norms of queries and keys.

use burn::module::Module;
use burn::nn::{LayerNorm, RmsNorm};
use burn::tensor::Tensor;

use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::ops::rms_norm::rms_norm_heads;

/// A layer norm of the encoder's tokens in the released DL3DV network. Stage 2 freezes the encoder; both stages train this
/// norm.
#[derive(Module, Debug)]
pub struct LiftNorm {
    norm: LayerNorm,
}

impl LiftNorm {
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self { norm: init.layer_norm(config.dim) }
    }

    pub fn forward(&self, lift: Tensor<3>) -> Tensor<3> {
        self.norm.forward(lift)
    }
}

/// RMS norms of the heads of queries and keys, `x / sqrt(mean(x^2) + 1e-5) * gamma`; the heads share one gamma
/// `[head width]`.
#[derive(Module, Debug)]
pub struct QkNorm {
    query: RmsNorm,
    key: RmsNorm,
}

impl QkNorm {
    /// Makes the norms of an attention layer; `None` in networks without them.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Option<Self> {
        config.has_query_key_norms().then(|| {
            let head_width = config.dim / config.num_heads;
            Self { query: init.rms_norm(head_width), key: init.rms_norm(head_width) }
        })
    }

    /// Normalises queries, `[batch, count, dim]`.
    pub(crate) fn query(&self, query: Tensor<3>) -> Tensor<3> {
        rms_norm_heads(query, [&self.query], 1)
    }

    /// Normalises the keys of packed keys and values, `[batch, count, 2 dim]`.
    pub(crate) fn key_value(&self, key_value: Tensor<3>) -> Tensor<3> {
        rms_norm_heads(key_value, [&self.key], 2)
    }

    /// Normalises the queries and keys of packed queries, keys and values, `[batch, count, 3 dim]`.
    pub(crate) fn query_key_value(&self, query_key_value: Tensor<3>) -> Tensor<3> {
        rms_norm_heads(query_key_value, [&self.query, &self.key], 3)
    }
}
