//! Sizes of the networks: the `[model]` section of a config.

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
    /// How attention knows the cameras: `plucker` (by the rays of the input alone), `gta` (by poses too) or `prope` (by poses and
    /// intrinsics too).
    pub camera_encoding: CameraEncoding,
    /// Frame of the rays of the input: `world`, or `camera` with camera-relative attention, which makes the network independent
    /// of the frame of the scene.
    pub rays: RayFrame,
    /// Most context views that the encoder reads together: more are divided, in their order, into the fewest equal groups. 0
    /// reads all views together.
    pub group_size: usize,
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
pub(crate) const SIZES: ModelConfig = ModelConfig {
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
    group_size: 0,
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
pub(crate) struct ModelSection {
    pub architecture: Architecture,
    pub variant: CliftVariant,
    pub num_latents: Option<usize>,
    pub dim: Option<usize>,
    pub num_heads: Option<usize>,
    pub feed_forward_dim: Option<usize>,
    pub num_encoder_blocks: Option<usize>,
    pub num_renderer_blocks: Option<usize>,
    pub patch_size: Option<usize>,
    pub camera_encoding: CameraEncoding,
    pub rays: RayFrame,
    pub group_size: usize,
    pub patch_grids: PatchGrids,
    pub condenser: CondenserSection,
}

/// [`CondenserConfig`] in a file.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct CondenserSection {
    pub num_blocks: Option<usize>,
    pub residual: Option<bool>,
    pub member_share: bool,
}

impl ModelConfig {
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

    /// Returns the number of groups of context views that the encoder reads one by one: the fewest equal groups of at most
    /// `group_size` views. Views that do not divide so are one group.
    pub fn num_groups(&self, num_views: usize) -> usize {
        let is_small = |groups: &usize| num_views.is_multiple_of(*groups) && num_views / groups <= self.group_size;
        (1..=num_views / 2).find(is_small).unwrap_or(1)
    }

    /// Whether a view can be rendered from the tokens of several groups: rays of cameras depend on no frame, so that all groups
    /// share one.
    pub fn joins_groups(&self) -> bool {
        self.rays == RayFrame::Camera
    }

    /// Returns the number of patches of every grid that an image of `width` by `height` pixels is the mean of.
    ///
    /// # Errors
    /// As [`num_patches`](Self::num_patches).
    pub(crate) fn drawn_patches(&self, height: usize, width: usize) -> Result<Vec<usize>, ModelError> {
        self.num_patches(1, height, width)?;
        let patches = self.patch_grids.patches(self.patch_size, [height, width].map(|side| side / self.patch_size));
        Ok(patches.map(|[rows, columns]| rows * columns).collect())
    }

    /// Whether the encoder's tokens have a norm.
    pub fn has_token_norm(&self) -> bool {
        self.variant.has_norms()
    }

    /// Checks the values that all architectures have.
    pub(crate) fn validate_sizes(&self) -> Result<(), ModelError> {
        check_count("model.dim", self.dim, 1 << 16)?;
        check_count("model.num_heads", self.num_heads, 1 << 10)?;
        check_count("model.feed_forward_dim", self.feed_forward_dim, 1 << 18)?;
        check_count("model.num_renderer_blocks", self.num_renderer_blocks, 1 << 10)?;
        check_count("model.patch_size", self.patch_size, 256)?;
        let Self { dim, num_heads, .. } = *self;
        if !dim.is_multiple_of(num_heads) {
            let fix = format!("write a divisor of model.dim = {dim}, such as {}", near_divisors(dim, num_heads));
            return bad("model.num_heads", num_heads, fix);
        }
        Ok(())
    }

    /// Checks camera-relative attention and patch grids.
    pub(crate) fn validate_cameras(&self) -> Result<(), ModelError> {
        let head_width = self.dim / self.num_heads;
        if self.camera_encoding != CameraEncoding::Plucker && !head_width.is_multiple_of(8) {
            let fix = format!("needs heads of a multiple of 8 channels, not {head_width}: change model.num_heads");
            return bad("model.camera_encoding", self.camera_encoding, fix);
        }
        if self.rays == RayFrame::Camera && self.camera_encoding == CameraEncoding::Plucker {
            let fix = "needs camera-relative attention: write model.camera_encoding = \"gta\"".into();
            return bad("model.rays", self.rays, fix);
        }
        if self.patch_grids != PatchGrids::One {
            let reason = match (self.camera_encoding, self.patch_size) {
                (CameraEncoding::Prope, _) => Some(
                    "model.camera_encoding = \"prope\" measures in units of the image size, which other grids change",
                ),
                (_, 1) => Some("patches of one pixel have no halves"),
                _ => None,
            };
            if let Some(reason) = reason {
                return bad("model.patch_grids", usize::from(self.patch_grids), format!("{reason}: write 1"));
            }
        }
        Ok(())
    }
}

/// Returns the error of a key.
pub(crate) fn bad(key: &'static str, value: impl Display, fix: String) -> Result<(), ModelError> {
    Err(ModelError::BadConfig { key, value: value.to_string(), fix })
}

/// Checks that a count is at least 1 and at most `most`.
pub(crate) fn check_count(key: &'static str, value: usize, most: usize) -> Result<(), ModelError> {
    match value {
        0 => bad(key, value, "write at least 1".into()),
        _ if value > most => bad(key, value, format!("write at most {most}")),
        _ => Ok(()),
    }
}

/// Checks that a count of what the architecture lacks is 0.
pub(crate) fn check_absent(key: &'static str, value: usize, config: &ModelConfig) -> Result<(), ModelError> {
    let fix = || format!("model.architecture = \"{}\" has none: leave the key out", config.architecture);
    if value > 0 { bad(key, value, fix()) } else { Ok(()) }
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
        let shared = message(r#"{"variant": "released-re10k", "condenser": {"member_share": true}}"#);
        assert!(shared.starts_with("`model.condenser.member_share` = true"), "{shared}");
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
    fn lvsm_has_its_own_sizes_and_no_condenser() {
        let parse = |text: &str| serde_json::from_str::<ModelConfig>(text).expect("a model section");
        for (variant, sizes) in [("paper", [768, 12, 3072, 3072]), ("released-re10k", [512, 8, 2048, 3072])] {
            let config = parse(&format!(r#"{{"architecture": "lvsm-ed", "variant": "{variant}"}}"#));
            config.validate().expect("valid");
            assert_eq!([config.dim, config.num_heads, config.feed_forward_dim, config.num_latents], sizes);
            assert_eq!(config.num_tokens(4, 256, 256).expect("divides"), 3072);
            assert_eq!(config.num_patches(4, 256, 256).expect("divides"), 4096);
            assert_eq!(parse(&serde_json::to_string(&config).expect("JSON")), config);
        }
        let message = |text: &str| parse(text).validate().unwrap_err().to_string();
        let cases = [
            (r#"{"num_latents": 5}"#, "`model.num_latents` = 5: model.architecture = \"clift\" has none"),
            (r#"{"architecture": "lvsm-ed", "num_latents": 0}"#, "`model.num_latents` = 0: write at least 1"),
            (
                r#"{"architecture": "lvsm-ed", "condenser": {"num_blocks": 2}}"#,
                "`model.condenser.num_blocks` = 2: model.architecture = \"lvsm-ed\" has none",
            ),
            (
                r#"{"architecture": "lvsm-ed", "variant": "released-dl3dv"}"#,
                "`model.variant` = released-dl3dv: of LVSM, write \"paper\"",
            ),
            (
                r#"{"architecture": "lvsm-ed", "camera_encoding": "gta"}"#,
                "`model.camera_encoding` = gta: model.architecture = \"lvsm-ed\" has \"plucker\"",
            ),
        ];
        for (text, expected) in cases {
            assert!(message(text).starts_with(expected), "{}", message(text));
        }
    }

    #[test]
    fn images_are_drawn_on_one_two_or_four_patch_grids() {
        let parse = |text: &str| serde_json::from_str::<ModelConfig>(text);
        let gta = r#"{"camera_encoding": "gta", "patch_grids": 4}"#;
        let config = parse(gta).expect("a model section");
        config.validate().expect("valid");
        assert_eq!(config.drawn_patches(16, 24).expect("divides"), [6, 12, 12, 12]);
        let prope = parse(&gta.replace("gta", "prope")).expect("a model section").validate().unwrap_err().to_string();
        assert!(prope.starts_with("`model.patch_grids` = 4: model.camera_encoding = \"prope\""), "{prope}");
        let three = parse(&gta.replace('4', "3")).unwrap_err().to_string();
        assert!(three.contains("write 1, 2 or 4"), "{three}");
    }

    #[test]
    fn many_views_are_encoded_in_the_fewest_equal_groups() {
        let groups = |group_size, counts: &[usize]| {
            let config = ModelConfig { group_size, ..ModelConfig::default() };
            counts.iter().map(|&views| config.num_groups(views)).collect::<Vec<_>>()
        };
        assert_eq!(groups(0, &[0, 1, 4, 100]), [1; 4]);
        assert_eq!(groups(4, &[1, 2, 4, 6, 8, 9, 10, 12]), [1, 1, 1, 2, 2, 3, 5, 3]);
        assert_eq!(groups(4, &[5, 7, 11]), [1; 3], "a prime number is one group");
    }

    #[test]
    fn rays_of_cameras_need_camera_relative_attention() {
        let message = |text: &str| {
            let config = serde_json::from_str::<ModelConfig>(text).expect("a model section");
            config.validate().map(|()| config.context_patch_len()).map_err(|error| error.to_string())
        };
        let plucker = message(r#"{"rays": "camera"}"#).unwrap_err();
        assert!(plucker.starts_with("`model.rays` = camera: needs camera-relative attention"), "{plucker}");
        assert_eq!(message(r#"{"rays": "camera", "camera_encoding": "gta", "patch_size": 4}"#), Ok(96));
    }

    #[test]
    fn an_image_of_partial_patches_is_an_error() {
        let error = ModelConfig::default().num_patches(1, 250, 256).unwrap_err();
        assert_eq!(error.to_string(), "an image of 256 x 250 does not divide into patches of 8 x 8");
        assert!(ModelConfig::default().num_tokens(1, 0, 256).is_err());
        assert_eq!(ModelConfig::default().num_tokens(4, 256, 448).expect("divides"), 7168);
    }
}
