//! Sizes of the networks: the `[model]` section of a config.

use serde::{Deserialize, Serialize};

use crate::error::ModelError;
use crate::network::architecture::CameraEncoding;
use crate::network::architecture::CliftVariant;

/// Sizes of the encoder, the condenser and the renderer. The defaults are the paper's.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "ModelSection")]
pub struct ModelConfig {
    /// Variant of the network.
    pub variant: CliftVariant,
    /// Width of a token.
    pub dim: usize,
    /// Attention heads in every block; divides `dim`.
    pub num_heads: usize,
    /// Hidden width of the feed-forward networks.
    pub feed_forward_dim: usize,
    /// Self-attention blocks of the encoder.
    pub num_encoder_blocks: usize,
    /// Decoder blocks of the renderer.
    pub num_renderer_blocks: usize,
    /// Side of a patch in pixels; every patch is one token.
    pub patch_size: usize,
    /// How attention knows the cameras.
    #[serde(skip_serializing_if = "CameraEncoding::is_plucker")]
    pub camera_encoding: CameraEncoding,
    /// The condenser of stage 2.
    pub condenser: CondenserConfig,
}

/// Sizes of the neural condenser (paper section 3.2, equations 1 to 4).
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CondenserConfig {
    /// Condenser blocks: two in the paper, one in the released networks.
    pub num_blocks: usize,
    /// Whether each step of a block adds its input to its output ("Add & `LayerNorm`" of the paper's text), or returns the
    /// output alone, as equations 1 to 3 print it.
    pub residual: bool,
}

impl Default for ModelConfig {
    fn default() -> Self {
        ModelSection::default().into()
    }
}

impl CondenserConfig {
    /// Returns the condenser of a variant.
    pub fn of(variant: CliftVariant) -> Self {
        Self { num_blocks: if variant.is_released() { 1 } else { 2 }, residual: true }
    }
}

/// [`ModelConfig`] in a file. Defaults of the condenser depend on the variant.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct ModelSection {
    variant: CliftVariant,
    dim: usize,
    num_heads: usize,
    feed_forward_dim: usize,
    num_encoder_blocks: usize,
    num_renderer_blocks: usize,
    patch_size: usize,
    camera_encoding: CameraEncoding,
    condenser: CondenserSection,
}

/// [`CondenserConfig`] in a file.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct CondenserSection {
    num_blocks: Option<usize>,
    residual: Option<bool>,
}

impl Default for ModelSection {
    fn default() -> Self {
        Self {
            variant: CliftVariant::Paper,
            dim: 768,
            num_heads: 8,
            feed_forward_dim: 2048,
            num_encoder_blocks: 6,
            num_renderer_blocks: 6,
            patch_size: 8,
            camera_encoding: CameraEncoding::Plucker,
            condenser: CondenserSection::default(),
        }
    }
}

impl From<ModelSection> for ModelConfig {
    fn from(section: ModelSection) -> Self {
        let defaults = CondenserConfig::of(section.variant);
        Self {
            variant: section.variant,
            dim: section.dim,
            num_heads: section.num_heads,
            feed_forward_dim: section.feed_forward_dim,
            num_encoder_blocks: section.num_encoder_blocks,
            num_renderer_blocks: section.num_renderer_blocks,
            patch_size: section.patch_size,
            camera_encoding: section.camera_encoding,
            condenser: CondenserConfig {
                num_blocks: section.condenser.num_blocks.unwrap_or(defaults.num_blocks),
                residual: section.condenser.residual.unwrap_or(defaults.residual),
            },
        }
    }
}

impl ModelConfig {
    /// Returns the values of one context patch: RGB and six ray coordinates per pixel (576 for 8 x 8).
    pub fn context_patch_len(&self) -> usize {
        self.patch_size * self.patch_size * 9
    }

    /// Returns the values of one target patch: six ray coordinates per pixel (384 for 8 x 8).
    pub fn ray_patch_len(&self) -> usize {
        self.patch_size * self.patch_size * 6
    }

    /// Returns the values of one rendered patch: RGB per pixel (192 for 8 x 8).
    pub fn rgb_patch_len(&self) -> usize {
        self.patch_size * self.patch_size * 3
    }

    /// Returns the number of patches of `num_views` views of `width` by `height` pixels.
    ///
    /// # Errors
    /// [`ModelError::NotDivisible`] if a side is not a positive multiple of the patch.
    pub fn num_patches(&self, num_views: usize, height: usize, width: usize) -> Result<usize, ModelError> {
        let patch_size = self.patch_size;
        if height == 0 || width == 0 || !height.is_multiple_of(patch_size) || !width.is_multiple_of(patch_size) {
            return Err(ModelError::NotDivisible { width, height, patch_size });
        }
        Ok(num_views * (height / patch_size) * (width / patch_size))
    }

    /// Returns the number of encoder tokens of `num_views` context views: one per patch.
    ///
    /// # Errors
    /// As [`num_patches`](Self::num_patches).
    pub fn num_tokens(&self, num_views: usize, height: usize, width: usize) -> Result<usize, ModelError> {
        self.num_patches(num_views, height, width)
    }

    /// Whether linear layers and layer norms have biases.
    pub(crate) fn has_biases(&self) -> bool {
        true
    }

    /// Whether the heads of queries and keys have norms.
    pub(crate) fn has_query_key_norms(&self) -> bool {
        self.variant.has_norms()
    }

    /// Whether the encoder's tokens have a norm.
    pub(crate) fn has_token_norm(&self) -> bool {
        self.variant.has_norms()
    }

    /// Checks every value against its range.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] with the key, the value and a valid value.
    pub fn validate(&self) -> Result<(), ModelError> {
        let bad = |key, value: String, fix| Err(ModelError::BadConfig { key, value, fix });
        for (key, value, most) in [
            ("model.dim", self.dim, 1 << 16),
            ("model.num_heads", self.num_heads, 1 << 10),
            ("model.feed_forward_dim", self.feed_forward_dim, 1 << 18),
            ("model.num_encoder_blocks", self.num_encoder_blocks, 1 << 10),
            ("model.num_renderer_blocks", self.num_renderer_blocks, 1 << 10),
            ("model.patch_size", self.patch_size, 256),
            ("model.condenser.num_blocks", self.condenser.num_blocks, 64),
        ] {
            if value == 0 {
                return bad(key, value.to_string(), "write at least 1".into());
            }
            if value > most {
                return bad(key, value.to_string(), format!("write at most {most}"));
            }
        }
        let Self { dim, num_heads, variant, .. } = *self;
        if !dim.is_multiple_of(num_heads) {
            let fix = format!("write a divisor of model.dim = {dim}, such as {}", near_divisors(dim, num_heads));
            return bad("model.num_heads", num_heads.to_string(), fix);
        }
        if self.camera_encoding != CameraEncoding::Plucker {
            let key = "model.camera_encoding";
            if variant.is_released() {
                let fix = format!("model.variant = \"{variant}\" has \"plucker\": leave the key out");
                return bad(key, self.camera_encoding.to_string(), fix);
            }
            if !(dim / num_heads).is_multiple_of(8) {
                let fix =
                    format!("needs heads of a multiple of 8 channels, not {}: change model.num_heads", dim / num_heads);
                return bad(key, self.camera_encoding.to_string(), fix);
            }
        }
        let CondenserConfig { num_blocks, residual } = self.condenser;
        if variant.is_released() && num_blocks != 1 {
            let fix = format!("model.variant = \"{variant}\" has one: leave the key out");
            return bad("model.condenser.num_blocks", num_blocks.to_string(), fix);
        }
        if variant.is_released() && !residual {
            let fix = format!("the block of model.variant = \"{variant}\" has residuals: leave the key out");
            return bad("model.condenser.residual", residual.to_string(), fix);
        }
        Ok(())
    }
}

/// Returns the divisors of `number` next to `wrong` as text.
fn near_divisors(number: usize, wrong: usize) -> String {
    let divides = |candidate: &usize| number.is_multiple_of(*candidate);
    let below = (1..wrong.min(number + 1)).rev().find(divides);
    let above = (wrong + 1..=number).find(divides);
    let near: Vec<String> = below.into_iter().chain(above).map(|divisor| divisor.to_string()).collect();
    near.join(" or ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_variant_sets_the_condenser_and_contradictions_are_errors() {
        let parse = |text: &str| serde_json::from_str::<ModelConfig>(text).expect("a model section");
        for variant in CliftVariant::ALL {
            let config = parse(&format!("{{\"variant\": \"{variant}\"}}"));
            assert_eq!(
                (config.variant, config.condenser.num_blocks),
                (variant, if variant.is_released() { 1 } else { 2 })
            );
            config.validate().expect("the variant alone is valid");
            assert_eq!(parse(&serde_json::to_string(&config).expect("JSON")), config);
        }
        assert_eq!(parse("{}"), ModelConfig::default());
        let message = |text: &str| parse(text).validate().unwrap_err().to_string();
        let two = message(r#"{"variant": "released-re10k", "condenser": {"num_blocks": 2}}"#);
        assert!(
            two.starts_with("`model.condenser.num_blocks` = 2: model.variant = \"released-re10k\" has one"),
            "{two}"
        );
        let plain = message(r#"{"variant": "released-dl3dv", "condenser": {"residual": false}}"#);
        assert!(plain.starts_with("`model.condenser.residual` = false"), "{plain}");
        assert!(serde_json::from_str::<ModelConfig>(r#"{"depth": 1}"#).is_err());
        assert!(serde_json::from_str::<ModelConfig>(r#"{"condenser": {"depth": 1}}"#).is_err());
    }

    #[test]
    fn heads_that_do_not_divide_the_width_are_an_error() {
        let message = ModelConfig { num_heads: 7, ..ModelConfig::default() }.validate().unwrap_err().to_string();
        assert_eq!(message, "`model.num_heads` = 7: write a divisor of model.dim = 768, such as 6 or 8");
        let message = ModelConfig { num_heads: 800, ..ModelConfig::default() }.validate().unwrap_err().to_string();
        assert!(message.ends_with("such as 768"), "{message}");
    }

    #[test]
    fn an_image_of_partial_patches_is_an_error() {
        let error = ModelConfig::default().num_patches(1, 250, 256).unwrap_err();
        assert_eq!(error.to_string(), "an image of 256 x 250 does not divide into patches of 8 x 8");
        assert!(ModelConfig::default().num_tokens(1, 0, 256).is_err());
        assert_eq!(ModelConfig::default().num_tokens(4, 256, 448).expect("divides"), 7168);
    }
}
