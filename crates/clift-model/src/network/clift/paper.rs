//! Sizes, checks and layers of the paper's network.

use crate::error::ModelError;
use crate::network::architecture::CliftVariant;
use crate::network::config::{CondenserConfig, ModelConfig, SIZES, check_absent, check_count};
use crate::network::design::Design;
use crate::network::init::LayerStyle;
use crate::network::layers::{
    CONTEXT, GATHERING, Layer, LayerKind, LayerList, MEMBERS, Part, RENDER_TOKENS, STORED, TARGETS,
};

/// The network of the paper's equations.
pub(crate) struct PaperClift;

impl Design for PaperClift {
    fn defaults(&self, variant: CliftVariant) -> ModelConfig {
        ModelConfig { condenser: CondenserConfig::of(variant), ..SIZES }
    }

    fn validate(&self, config: &ModelConfig) -> Result<(), ModelError> {
        check_count("model.num_encoder_blocks", config.num_encoder_blocks, 1 << 10)?;
        check_absent("model.num_latents", config.num_latents, config)?;
        check_count("model.condenser.num_blocks", config.condenser.num_blocks, 64)
    }

    fn layers(&self, config: &ModelConfig) -> Vec<Layer> {
        let mut list = networks_without_condenser(config, self.layer_style(config));
        let (dim, residual) = (config.dim, config.condenser.residual);
        for i in 0..config.condenser.num_blocks {
            list.enter(Part::Condenser, Some(i), &format!("condenser.blocks.{i}"));
            list.self_attention("self_attn", STORED, STORED);
            list.norm("norm_self", STORED);
            if residual {
                list.norm("norm_cross", GATHERING);
            }
            // All blocks share one copy of the members.
            list.push("norm_memory", LayerKind::LayerNorm { width: dim, bias: true }, MEMBERS, false);
            list.norm("norm_ff", STORED);
            list.cross_attention(GATHERING, !residual, MEMBERS);
            list.feed_forward(STORED);
            list.push("gate", LayerKind::Linear { inputs: dim, outputs: dim, bias: false }, STORED, true);
        }
        list.layers
    }

    fn layer_style(&self, _config: &ModelConfig) -> LayerStyle {
        LayerStyle::PYTORCH
    }
}

/// Lists the layers of encoder, token norm and renderer.
pub(crate) fn networks_without_condenser(config: &ModelConfig, style: LayerStyle) -> LayerList<'_> {
    let mut list = LayerList::new(config, style);
    list.enter(Part::Encoder, None, "encoder");
    list.linear("patch_embed", [config.context_patch_len(), config.dim], CONTEXT, true);
    for i in 0..config.num_encoder_blocks {
        list.enter(Part::Encoder, Some(i), &format!("encoder.blocks.{i}"));
        list.encoder_block(CONTEXT, CONTEXT);
    }
    if config.has_token_norm() {
        list.enter(Part::TokenNorm, None, "lift_norm");
        list.norm("norm", CONTEXT);
    }
    list.enter(Part::Renderer, None, "renderer");
    list.linear("ray_embed", [config.ray_patch_len(), config.dim], TARGETS, true);
    for i in 0..config.num_renderer_blocks {
        list.enter(Part::Renderer, Some(i), &format!("renderer.blocks.{i}"));
        list.decoder_block(TARGETS, RENDER_TOKENS);
    }
    list.output_head();
    list
}
