//! Self- and cross-attention layers: projections, norms of queries and keys, and heads.

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::Tensor;

use crate::network::blocks::norms::QkNorm;
use crate::network::camera_encoding::TokenTransforms;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::tokens::Tokens;
use crate::ops::attention::{cross_sdpa, self_sdpa};
use crate::ops::linear::{linear, norm_linear};

/// Self-attention with a packed projection (paper section 3.1: eight heads).
#[derive(Module, Debug)]
pub struct SelfAttention {
    in_proj: Linear,
    out_proj: Linear,
    qk_norm: Option<QkNorm>,
    #[module(skip)]
    num_heads: usize,
}

impl SelfAttention {
    /// Makes the layer with PyTorch's initialization of multi-head attention.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        let ModelConfig { dim, num_heads, .. } = *config;
        Self {
            in_proj: init.attention_in(dim, 3),
            out_proj: init.attention_out(dim),
            qk_norm: QkNorm::new(config, init),
            num_heads,
        }
    }

    /// Applies `norm`, then attention among the tokens of a scene.
    ///
    /// # Shapes
    /// - `x` and the result: `[batch, count, dim]`
    pub fn forward(&self, norm: &LayerNorm, x: Tensor<3>, transforms: Option<&TokenTransforms>) -> Tensor<3> {
        let packed = norm_linear(norm, &self.in_proj, x);
        let packed = match &self.qk_norm {
            Some(qk_norm) => qk_norm.query_key_value(packed),
            None => packed,
        };
        let attended = match transforms {
            Some(transforms) => {
                let packed = transforms.query_key_value(packed, self.num_heads);
                transforms.output(self_sdpa(packed, self.num_heads), self.num_heads)
            }
            None => self_sdpa(packed, self.num_heads),
        };
        linear(&self.out_proj, attended)
    }

    /// Applies `norm`, then attention of the first `count` tokens of a scene to all of them.
    ///
    /// # Shapes
    /// - `x`: `[batch, num_tokens, dim]`
    /// - returns `[batch, count, dim]`, the first rows of [`forward`](Self::forward)
    pub fn forward_first(&self, norm: &LayerNorm, x: Tensor<3>, count: usize) -> Tensor<3> {
        let [_, _, dim] = x.dims();
        let packed = norm_linear(norm, &self.in_proj, x);
        let query = packed.clone().narrow(1, 0, count).narrow(2, 0, dim);
        let key_value = packed.narrow(2, dim, 2 * dim);
        let (query, key_value) = match &self.qk_norm {
            Some(qk_norm) => (qk_norm.query(query), qk_norm.key_value(key_value)),
            None => (query, key_value),
        };
        linear(&self.out_proj, cross_sdpa(query, key_value, self.num_heads))
    }
}

/// Attention from one set of tokens to another.
#[derive(Module, Debug)]
pub struct CrossAttention {
    q_proj: Linear,
    kv_proj: Linear,
    out_proj: Linear,
    qk_norm: Option<QkNorm>,
    #[module(skip)]
    num_heads: usize,
}

impl CrossAttention {
    /// Makes the layer with PyTorch's initialization of multi-head attention.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        let ModelConfig { dim, num_heads, .. } = *config;
        Self {
            q_proj: init.attention_in(dim, 1),
            kv_proj: init.attention_in(dim, 2),
            out_proj: init.attention_out(dim),
            qk_norm: QkNorm::new(config, init),
            num_heads,
        }
    }

    /// Projects queries, `[batch, num_queries, dim]`.
    pub(crate) fn project_query(
        &self,
        norm: Option<&LayerNorm>,
        x: Tensor<3>,
        transforms: Option<&TokenTransforms>,
    ) -> Tensor<3> {
        let query = project(norm, &self.q_proj, x);
        let query = match &self.qk_norm {
            Some(qk_norm) => qk_norm.query(query),
            None => query,
        };
        match transforms {
            Some(transforms) => transforms.query(query, self.num_heads),
            None => query,
        }
    }

    /// Projects tokens to keys and values side by side, `[batch, num_keys, 2 dim]`.
    pub(crate) fn project_key_value(&self, norm: Option<&LayerNorm>, tokens: Tokens) -> Tensor<3> {
        let key_value = project(norm, &self.kv_proj, tokens.values);
        let key_value = match &self.qk_norm {
            Some(qk_norm) => qk_norm.key_value(key_value),
            None => key_value,
        };
        match tokens.transforms {
            Some(transforms) => transforms.key_value(key_value, self.num_heads),
            None => key_value,
        }
    }

    /// Projects the concatenated heads of the queries.
    pub(crate) fn project_out(&self, x: Tensor<3>, transforms: Option<&TokenTransforms>) -> Tensor<3> {
        let x = match transforms {
            Some(transforms) => transforms.output(x, self.num_heads),
            None => x,
        };
        linear(&self.out_proj, x)
    }

    pub(crate) fn num_heads(&self) -> usize {
        self.num_heads
    }
}

fn project(norm: Option<&LayerNorm>, layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    match norm {
        Some(norm) => norm_linear(norm, layer, x),
        None => linear(layer, x),
    }
}
