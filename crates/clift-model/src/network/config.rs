//! Sizes of the networks: the `[model]` section of a config.
//!
//! The rest of the program asks what a network can do, such as [`ModelConfig::has_patch_tokens`], not which one it is.

use std::fmt::Display;

use serde::{Deserialize, Serialize};

use crate::error::ModelError;
use crate::network::architecture::{Architecture, CameraEncoding, CliftVariant};
use crate::views::patch_grids::PatchGrids;
use crate::views::rays::RayFrame;

/// Sizes of the encoder, the condenser and the renderer. The defaults are those of the network's paper, with six blocks each
/// in encoder and renderer.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "ModelSection")]
pub struct ModelConfig {
    /// Kind of the network: `clift` or `lvsm-ed`.
    pub architecture: Architecture,
    /// Variant of the network, which sets the default sizes: `paper`, `released-re10k` or `released-dl3dv`.
    pub variant: CliftVariant,
    /// Latents of LVSM, the tokens of a scene; 0 in `CLiFT`, which has a token per patch.
    pub num_latents: usize,
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
    /// How attention knows the cameras: `plucker` (by the rays of the input alone) or `gta` (by poses too).
    pub camera_encoding: CameraEncoding,
    /// Frame of the rays of the input: `world`, or `camera` with camera-relative attention, which makes the network independent
    /// of the frame of the scene.
    pub rays: RayFrame,
    /// Number of renderings, with patches shifted along the diagonal, whose mean is an image: 1, 2 or 4. Training renders an
    /// image once.
    pub patch_grids: PatchGrids,
    /// The condenser of stage 2.
    pub condenser: CondenserConfig,
}

/// Sizes of the neural condenser (paper section 3.2, equations 1 to 4).
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CondenserConfig {
    /// Condenser blocks: two in the paper, one in the released networks, none in LVSM.
    pub num_blocks: usize,
    /// Whether each step of a block adds its input to its output ("Add & `LayerNorm`" of the paper's text), or returns the
    /// output alone, as equations 1 to 3 print it.
    pub residual: bool,
    /// Whether equation 4 multiplies what it adds to a centroid by the share of members among the cluster's tokens,
    /// `(n - 1) / n` for `n` tokens: a cluster of one token keeps it as it is.
    pub member_share: bool,
}

/// The published size of `CLiFT`, without a condenser.
const SIZES: ModelConfig = ModelConfig {
    architecture: Architecture::Clift,
    variant: CliftVariant::Paper,
    num_latents: 0,
    dim: 768,
    num_heads: 8,
    feed_forward_dim: 2048,
    num_encoder_blocks: 6,
    num_renderer_blocks: 6,
    patch_size: 8,
    camera_encoding: CameraEncoding::Plucker,
    rays: RayFrame::World,
    patch_grids: PatchGrids::One,
    condenser: CondenserConfig::NONE,
};

impl Default for ModelConfig {
    fn default() -> Self {
        ModelSection::default().into()
    }
}

impl CondenserConfig {
    /// No condenser.
    pub const NONE: Self = Self { num_blocks: 0, residual: true, member_share: false };

    /// Returns the condenser of a variant.
    pub fn of(variant: CliftVariant) -> Self {
        Self { num_blocks: if variant.is_released() { 1 } else { 2 }, ..Self::NONE }
    }
}

/// [`ModelConfig`] in a file. Defaults of sizes depend on architecture and variant.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct ModelSection {
    architecture: Architecture,
    variant: CliftVariant,
    num_latents: Option<usize>,
    dim: Option<usize>,
    num_heads: Option<usize>,
    feed_forward_dim: Option<usize>,
    num_encoder_blocks: Option<usize>,
    num_renderer_blocks: Option<usize>,
    patch_size: Option<usize>,
    camera_encoding: CameraEncoding,
    rays: RayFrame,
    patch_grids: PatchGrids,
    condenser: CondenserSection,
}

/// [`CondenserConfig`] in a file.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct CondenserSection {
    num_blocks: Option<usize>,
    residual: Option<bool>,
    member_share: bool,
}

impl From<ModelSection> for ModelConfig {
    fn from(section: ModelSection) -> Self {
        let ModelSection { architecture, variant, .. } = section;
        let defaults = match architecture {
            Architecture::Clift => Self { condenser: CondenserConfig::of(variant), ..SIZES },
            Architecture::LvsmEd => Self { num_heads: 12, feed_forward_dim: 3072, num_latents: 3072, ..SIZES },
        };
        Self {
            architecture,
            variant,
            num_latents: section.num_latents.unwrap_or(defaults.num_latents),
            dim: section.dim.unwrap_or(defaults.dim),
            num_heads: section.num_heads.unwrap_or(defaults.num_heads),
            feed_forward_dim: section.feed_forward_dim.unwrap_or(defaults.feed_forward_dim),
            num_encoder_blocks: section.num_encoder_blocks.unwrap_or(defaults.num_encoder_blocks),
            num_renderer_blocks: section.num_renderer_blocks.unwrap_or(defaults.num_renderer_blocks),
            patch_size: section.patch_size.unwrap_or(defaults.patch_size),
            camera_encoding: section.camera_encoding,
            rays: section.rays,
            patch_grids: section.patch_grids,
            condenser: CondenserConfig {
                num_blocks: section.condenser.num_blocks.unwrap_or(defaults.condenser.num_blocks),
                residual: section.condenser.residual.unwrap_or(defaults.condenser.residual),
                member_share: section.condenser.member_share,
            },
        }
    }
}

impl ModelConfig {
    /// Returns a network of the default kind with a few thousand parameters, for checks.
    pub fn small() -> Self {
        let (dim, num_heads, feed_forward_dim) = (16, 2, 24);
        Self { dim, num_heads, feed_forward_dim, num_encoder_blocks: 1, num_renderer_blocks: 1, ..Self::default() }
    }

    /// Whether linear layers and layer norms have biases. Without them, matrices are normal at the start.
    pub(crate) fn has_biases(&self) -> bool {
        self.architecture != Architecture::LvsmEd
    }

    /// Whether the heads of queries and keys in encoder and renderer have norms.
    pub(crate) fn has_query_key_norms(&self) -> bool {
        self.architecture == Architecture::LvsmEd || self.variant.has_norms()
    }

    /// Whether the encoder's tokens have a norm.
    pub fn has_token_norm(&self) -> bool {
        self.variant.has_norms()
    }

    /// Returns the number of encoder tokens of `num_views` context views.
    pub fn num_tokens(&self, num_views: usize, height: usize, width: usize) -> Result<usize, ModelError> {
        let num_patches = self.num_patches(num_views, height, width)?;
        Ok(self.num_learned_tokens().unwrap_or(num_patches))
    }

    /// Returns the number of tokens of a scene that are learned and belong to no view; `None` for a token per patch.
    pub fn num_learned_tokens(&self) -> Option<usize> {
        (self.architecture == Architecture::LvsmEd).then_some(self.num_latents)
    }

    /// Whether every token belongs to a patch of a context view: a scene file stores its place, and a view can select the
    /// tokens nearest to its camera.
    pub fn has_patch_tokens(&self) -> bool {
        self.num_learned_tokens().is_none()
    }

    /// Returns the values of one context patch: RGB and the coordinates of the ray per pixel (576 for 8 x 8 in the world
    /// frame).
    pub fn context_patch_len(&self) -> usize {
        self.rgb_patch_len() + self.ray_patch_len()
    }

    /// Returns the values of one target patch: the coordinates of the ray per pixel (384 for 8 x 8 in the world frame).
    pub fn ray_patch_len(&self) -> usize {
        self.patch_size * self.patch_size * self.rays.num_coordinates()
    }

    /// Returns the values of one rendered patch: RGB per pixel (192 for 8 x 8).
    pub fn rgb_patch_len(&self) -> usize {
        self.patch_size * self.patch_size * 3
    }

    /// Returns the number of patches of `num_views` views of `width` by `height` pixels.
    pub fn num_patches(&self, num_views: usize, height: usize, width: usize) -> Result<usize, ModelError> {
        let patch_size = self.patch_size;
        if height == 0 || width == 0 || !height.is_multiple_of(patch_size) || !width.is_multiple_of(patch_size) {
            return Err(ModelError::NotDivisible { width, height, patch_size });
        }
        Ok(num_views * (height / patch_size) * (width / patch_size))
    }

    /// Returns the number of patches of every grid that an image of `width` by `height` pixels is the mean of.
    pub(crate) fn drawn_patches(&self, height: usize, width: usize) -> Result<Vec<usize>, ModelError> {
        self.num_patches(1, height, width)?;
        let patches = self.patch_grids.patches(self.patch_size, [height, width].map(|side| side / self.patch_size));
        Ok(patches.map(|[rows, columns]| rows * columns).collect())
    }

    /// Checks every value against its range.
    pub fn validate(&self) -> Result<(), ModelError> {
        check_count("model.dim", self.dim, 1 << 16)?;
        check_count("model.num_heads", self.num_heads, 1 << 10)?;
        check_count("model.feed_forward_dim", self.feed_forward_dim, 1 << 18)?;
        check_count("model.num_renderer_blocks", self.num_renderer_blocks, 1 << 10)?;
        check_count("model.patch_size", self.patch_size, 256)?;
        let Self { dim, num_heads, .. } = *self;
        let fix = format!("write a divisor of model.dim = {dim}, such as {}", near_divisors(dim, num_heads));
        check(dim.is_multiple_of(num_heads), "model.num_heads", num_heads, fix)?;
        check_count("model.num_encoder_blocks", self.num_encoder_blocks, 1 << 10)?;
        match self.architecture {
            Architecture::Clift => self.validate_clift()?,
            Architecture::LvsmEd => self.validate_lvsm_ed()?,
        }
        self.validate_cameras()
    }

    fn validate_clift(&self) -> Result<(), ModelError> {
        let CondenserConfig { num_blocks, residual, member_share } = self.condenser;
        self.check_absent("model.num_latents", self.num_latents)?;
        check_count("model.condenser.num_blocks", num_blocks, 64)?;
        if !self.variant.is_released() {
            return Ok(());
        }
        let name = format!("model.variant = \"{}\"", self.variant);
        let fix = format!("{name} has \"plucker\": leave the key out");
        check(!self.is_camera_relative(), "model.camera_encoding", self.camera_encoding, fix)?;
        let fix = format!("{name} has one: leave the key out");
        check(num_blocks == 1, "model.condenser.num_blocks", num_blocks, fix)?;
        let fix = format!("the block of {name} has residuals: leave the key out");
        check(residual, "model.condenser.residual", residual, fix)?;
        let fix = format!("the block of {name} adds the whole update: leave the key out");
        check(!member_share, "model.condenser.member_share", member_share, fix)
    }

    fn validate_lvsm_ed(&self) -> Result<(), ModelError> {
        check_count("model.num_latents", self.num_latents, 1 << 16)?;
        self.check_absent("model.condenser.num_blocks", self.condenser.num_blocks)?;
        let own = |value| format!("model.architecture = \"{}\" has \"{value}\": leave the key out", self.architecture);
        check(!self.is_camera_relative(), "model.camera_encoding", self.camera_encoding, own("plucker"))?;
        check(self.variant == CliftVariant::Paper, "model.variant", self.variant, own("paper"))
    }

    /// Checks that a count of what the architecture lacks is 0.
    fn check_absent(&self, key: &'static str, value: usize) -> Result<(), ModelError> {
        let fix = format!("model.architecture = \"{}\" has none: leave the key out", self.architecture);
        check(value == 0, key, value, fix)
    }

    fn validate_cameras(&self) -> Result<(), ModelError> {
        let (is_relative, head_width) = (self.is_camera_relative(), self.dim / self.num_heads);
        let fix = format!("needs heads of a multiple of 8 channels, not {head_width}: change model.num_heads");
        check(!is_relative || head_width.is_multiple_of(8), "model.camera_encoding", self.camera_encoding, fix)?;
        let fix = "needs camera-relative attention: write model.camera_encoding = \"gta\"".into();
        check(is_relative || self.rays != RayFrame::Camera, "model.rays", self.rays, fix)?;
        let has_halves = self.patch_size > 1 || self.patch_grids == PatchGrids::One;
        let fix = "patches of one pixel have no halves: write 1".into();
        check(has_halves, "model.patch_grids", usize::from(self.patch_grids), fix)
    }

    /// Returns whether attention depends on the cameras of tokens and queries.
    pub(crate) fn is_camera_relative(&self) -> bool {
        self.camera_encoding != CameraEncoding::Plucker
    }
}

fn check(is_right: bool, key: &'static str, value: impl Display, fix: String) -> Result<(), ModelError> {
    if is_right { Ok(()) } else { Err(ModelError::BadConfig { key, value: value.to_string(), fix }) }
}

/// Checks that a count is at least 1 and at most `most`.
fn check_count(key: &'static str, value: usize, most: usize) -> Result<(), ModelError> {
    check(value > 0, key, value, "write at least 1".into())?;
    check(value <= most, key, value, format!("write at most {most}"))
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

    fn parse(text: &str) -> ModelConfig {
        serde_json::from_str(text).expect("a model section")
    }

    #[test]
    fn variant_and_architecture_set_the_sizes() {
        assert_eq!(parse("{}"), ModelConfig::default());
        for variant in CliftVariant::ALL {
            let config = parse(&format!("{{\"variant\": \"{variant}\"}}"));
            let num_blocks = if variant.is_released() { 1 } else { 2 };
            assert_eq!((config.variant, config.condenser.num_blocks), (variant, num_blocks));
            config.validate().expect("the variant alone is valid");
            assert_eq!(parse(&serde_json::to_string(&config).expect("JSON")), config);
        }
        let config = parse(r#"{"architecture": "lvsm-ed"}"#);
        config.validate().expect("valid");
        let sizes = [config.dim, config.num_heads, config.feed_forward_dim, config.num_latents];
        assert_eq!(sizes, [768, 12, 3072, 3072]);
        assert_eq!(config.num_tokens(4, 256, 256).expect("divides"), 3072);
        assert_eq!(config.num_patches(4, 256, 256).expect("divides"), 4096);
        assert_eq!(parse(&serde_json::to_string(&config).expect("JSON")), config);
        for text in [r#"{"depth": 1}"#, r#"{"condenser": {"depth": 1}}"#, r#"{"patch_grids": 3}"#] {
            assert!(serde_json::from_str::<ModelConfig>(text).is_err(), "{text}");
        }
    }

    #[test]
    fn contradictions_are_errors_with_key_and_remedy() {
        let cases = [
            (r#""num_heads": 7"#, "num_heads` = 7: write a divisor of model.dim = 768, such as 6 or 8"),
            (r#""num_heads": 800"#, "num_heads` = 800: write a divisor of model.dim = 768, such as 768"),
            (r#""num_latents": 5"#, r#"num_latents` = 5: model.architecture = "clift" has none"#),
            (r#""patch_size": 1, "patch_grids": 4"#, "patch_grids` = 4: patches of one pixel have no halves: write 1"),
            (r#""rays": "camera""#, "rays` = camera: needs camera-relative attention"),
        ];
        let released = [
            (r#""num_blocks": 2"#, r#"num_blocks` = 2: model.variant = "released-re10k" has one"#),
            (r#""residual": false"#, "residual` = false: the block of"),
            (r#""member_share": true"#, "member_share` = true: the block of"),
        ];
        let lvsm = [
            (r#""num_latents": 0"#, "num_latents` = 0: write at least 1"),
            (
                r#""condenser": {"num_blocks": 2}"#,
                r#"condenser.num_blocks` = 2: model.architecture = "lvsm-ed" has none"#,
            ),
            (
                r#""variant": "released-re10k""#,
                r#"variant` = released-re10k: model.architecture = "lvsm-ed" has "paper""#,
            ),
            (r#""camera_encoding": "gta""#, r#"camera_encoding` = gta: model.architecture = "lvsm-ed" has "plucker""#),
        ];
        let check = |text: &str, expected: &str| {
            let message = parse(text).validate().unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        };
        for (text, expected) in cases {
            check(&format!("{{{text}}}"), &format!("`model.{expected}"));
        }
        for (text, expected) in released {
            let text = format!(r#"{{"variant": "released-re10k", "condenser": {{{text}}}}}"#);
            check(&text, &format!("`model.condenser.{expected}"));
        }
        for (text, expected) in lvsm {
            check(&format!(r#"{{"architecture": "lvsm-ed", {text}}}"#), &format!("`model.{expected}"));
        }
    }

    #[test]
    fn patches_of_images_are_counted() {
        let config = parse(r#"{"camera_encoding": "gta", "patch_grids": 4, "rays": "camera", "patch_size": 4}"#);
        config.validate().expect("valid");
        assert_eq!(config.context_patch_len(), 96);
        assert_eq!(parse(r#"{"patch_grids": 4}"#).drawn_patches(16, 24).expect("divides"), [6, 12, 12, 12]);
        let error = ModelConfig::default().num_patches(1, 250, 256).unwrap_err();
        assert_eq!(error.to_string(), "an image of 256 x 250 does not divide into patches of 8 x 8");
        assert!(ModelConfig::default().num_tokens(1, 0, 256).is_err());
        assert_eq!(ModelConfig::default().num_tokens(4, 256, 448).expect("divides"), 7168);
    }
}
