//! Self- and cross-attention layers: projections, norms of queries and keys, and heads.

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::Tensor;
use clift_kernels::HeadTransform;

use crate::network::blocks::norms::QkNorm;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::tokens::Tokens;
use crate::ops::attention::{cross_sdpa, self_sdpa};
use crate::ops::head_transform::{KEY_VALUE, OUTPUT, QUERY, QUERY_KEY_VALUE, transform_heads};
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
    pub fn forward(&self, norm: &LayerNorm, x: Tensor<3>, transforms: Option<&Tensor<3>>) -> Tensor<3> {
        let packed = norm_linear(norm, &self.in_proj, x);
        let packed = apply(self.qk_norm.as_ref(), packed, QkNorm::query_key_value);
        let packed = transform(packed, transforms, QUERY_KEY_VALUE, self.num_heads);
        let attended = self_sdpa(packed, self.num_heads);
        linear(&self.out_proj, transform(attended, transforms, OUTPUT, self.num_heads))
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
        let query = apply(self.qk_norm.as_ref(), query, QkNorm::query);
        let key_value = apply(self.qk_norm.as_ref(), packed.narrow(2, dim, 2 * dim), QkNorm::key_value);
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
        transforms: Option<&Tensor<3>>,
    ) -> Tensor<3> {
        let query = apply(self.qk_norm.as_ref(), project(norm, &self.q_proj, x), QkNorm::query);
        transform(query, transforms, QUERY, self.num_heads)
    }

    /// Projects tokens to keys and values side by side, `[batch, num_keys, 2 dim]`.
    pub(crate) fn project_key_value(&self, norm: Option<&LayerNorm>, tokens: Tokens) -> Tensor<3> {
        let key_value = project(norm, &self.kv_proj, tokens.values);
        let key_value = apply(self.qk_norm.as_ref(), key_value, QkNorm::key_value);
        transform(key_value, tokens.transforms.as_ref(), KEY_VALUE, self.num_heads)
    }

    pub(crate) fn project_out(&self, x: Tensor<3>, transforms: Option<&Tensor<3>>) -> Tensor<3> {
        linear(&self.out_proj, transform(x, transforms, OUTPUT, self.num_heads))
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

fn apply<T>(module: Option<&T>, x: Tensor<3>, f: impl Fn(&T, Tensor<3>) -> Tensor<3>) -> Tensor<3> {
    match module {
        Some(module) => f(module, x),
        None => x,
    }
}

/// Transforms the heads of tokens in camera-relative attention.
fn transform(
    x: Tensor<3>,
    transforms: Option<&Tensor<3>>,
    parts: &'static [HeadTransform],
    num_heads: usize,
) -> Tensor<3> {
    apply(transforms, x, |transforms, x| transform_heads(x, transforms.clone(), parts, num_heads))
}
