//! The architectures behind one interface: which one a config names, and what it answers.

use burn::tensor::Device;

use crate::error::ModelError;
use crate::network::architecture::{Architecture, CliftVariant};
use crate::network::clift::paper::PaperClift;
use crate::network::config::{CondenserConfig, ModelConfig, ModelSection};
use crate::network::design::Design;
use crate::network::init::Init;
use crate::network::layers::Layer;
use crate::network::lvsm_ed::LvsmEd;
use crate::network::released::ReleasedClift;

/// Returns the design of a variant of an architecture.
fn design(architecture: Architecture, variant: CliftVariant) -> &'static dyn Design {
    match architecture {
        Architecture::Clift if variant.is_released() => &ReleasedClift,
        Architecture::Clift => &PaperClift,
        Architecture::LvsmEd => &LvsmEd,
    }
}

impl Architecture {
    fn design(self) -> &'static dyn Design {
        design(self, CliftVariant::Paper)
    }

    /// Whether tokens can be clustered and condensed. Other networks are trained in stage 1 alone, and a scene of theirs is
    /// stored with all its tokens.
    pub fn supports_clusters(self) -> bool {
        self.design().supports_clusters()
    }

    /// Whether checkpoints of the published training program have names for the network's parameters.
    pub fn supports_export(self) -> bool {
        self.design().supports_export()
    }
}

impl From<ModelSection> for ModelConfig {
    fn from(section: ModelSection) -> Self {
        let ModelSection { architecture, variant, .. } = section;
        let defaults = design(architecture, variant).defaults(variant);
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
            group_size: section.group_size,
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
    fn design(&self) -> &'static dyn Design {
        design(self.architecture, self.variant)
    }

    /// Checks every value against its range.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] with the key, the value and a valid value.
    pub fn validate(&self) -> Result<(), ModelError> {
        self.validate_sizes()?;
        self.design().validate(self)?;
        self.validate_cameras()
    }

    /// Lists every layer in the order of published checkpoints: encoder, token norm, renderer, condenser; within a block
    /// attention, feed-forward network, norms.
    pub(crate) fn layers(&self) -> Vec<Layer> {
        self.design().layers(self)
    }

    /// Returns the number of encoder tokens of `num_views` context views.
    ///
    /// # Errors
    /// As [`num_patches`](Self::num_patches).
    pub fn num_tokens(&self, num_views: usize, height: usize, width: usize) -> Result<usize, ModelError> {
        let num_patches = self.num_patches(num_views, height, width)?;
        Ok(self.num_learned_tokens().unwrap_or(num_patches))
    }

    /// Returns the number of tokens of a scene that are learned and belong to no view; `None` for a token per patch.
    pub fn num_learned_tokens(&self) -> Option<usize> {
        self.design().num_learned_tokens(self)
    }

    /// Whether every token belongs to a patch of a context view: a scene file stores its place, and a view can select the
    /// tokens nearest to its camera.
    pub fn has_patch_tokens(&self) -> bool {
        self.num_learned_tokens().is_none()
    }
}

impl Init {
    /// Starts the stream of `seed` for the layers of a network.
    pub fn of(config: &ModelConfig, seed: u64, device: &Device) -> Self {
        Self::with_style(config.design().layer_style(config), seed, device)
    }
}
