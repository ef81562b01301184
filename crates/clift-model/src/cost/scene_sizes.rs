//! Numbers of tokens, patches and views of a scene, and the rows of a layer's input.

use crate::error::ModelError;
use crate::network::config::ModelConfig;
use crate::network::layers::{Part, Rows};

/// Sizes of one scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SceneSizes {
    /// Patches of all context views.
    pub num_context_patches: usize,
    /// Encoder tokens.
    pub num_tokens: usize,
    /// Storage tokens; `None` without a condenser.
    pub num_storage_tokens: Option<usize>,
    /// Tokens from which a view is rendered.
    pub num_render_tokens: usize,
    /// Whether every target view has its own render tokens.
    pub is_per_view: bool,
    /// Target views.
    pub num_targets: usize,
    /// Patches per view.
    pub num_patches: usize,
}

impl SceneSizes {
    /// Returns the sizes of a scene of one token per context patch, whose target views are rendered from all its tokens.
    pub fn new(num_tokens: usize, num_targets: usize, num_patches: usize) -> Self {
        Self {
            num_context_patches: num_tokens,
            num_tokens,
            num_storage_tokens: None,
            num_render_tokens: num_tokens,
            is_per_view: false,
            num_targets,
            num_patches,
        }
    }

    /// Returns the sizes of a scene of a network, with views of `height` by `width` pixels, whose target views are rendered
    /// from all its tokens.
    pub fn of(
        config: &ModelConfig,
        num_context: usize,
        num_targets: usize,
        [height, width]: [usize; 2],
    ) -> Result<Self, ModelError> {
        let num_tokens = config.num_tokens(num_context, height, width)?;
        let num_context_patches = config.num_patches(num_context, height, width)?;
        let num_patches = config.num_patches(1, height, width)?;
        Ok(Self { num_context_patches, ..Self::new(num_tokens, num_targets, num_patches) })
    }

    /// Returns the most rows of a layer of the encoder.
    pub fn num_encoder_rows(&self, config: &ModelConfig) -> usize {
        let layers = config.layers();
        let rows = layers.iter().filter(|layer| layer.part == Part::Encoder).map(|layer| self.num_rows(layer.rows));
        rows.max().unwrap_or_default() as usize
    }

    /// Tokens projected to keys and values: those of the scene, or the subsets of its views, whichever are fewer.
    fn num_projected(&self) -> usize {
        let all = self.num_storage_tokens.unwrap_or(self.num_tokens);
        if self.is_per_view { all.min(self.num_targets * self.num_render_tokens) } else { self.num_render_tokens }
    }

    /// Number of groups of rows. Attention stays inside a group: target views do not attend to each other.
    pub(crate) fn num_groups(&self, rows: &[Rows]) -> u64 {
        let is_per_view = |rows: &Rows| match rows {
            Rows::TargetPatches => true,
            Rows::RenderTokens => self.is_per_view,
            _ => false,
        };
        if rows.iter().any(is_per_view) { self.num_targets as u64 } else { 1 }
    }

    pub(crate) fn group_len(&self, rows: &[Rows]) -> u64 {
        let stored = self.num_storage_tokens.unwrap_or(0);
        let len = |rows: &Rows| match rows {
            Rows::ContextPatches => self.num_context_patches,
            Rows::Latents => self.num_tokens,
            Rows::Members => self.num_tokens.saturating_sub(stored),
            Rows::StoredTokens | Rows::GatheringTokens => stored,
            Rows::RenderTokens => self.num_render_tokens,
            Rows::TargetPatches => self.num_patches,
        };
        rows.iter().map(len).sum::<usize>() as u64
    }

    /// Number of rows of all groups, which attention reads.
    pub(crate) fn num_gathered(&self, rows: &[Rows]) -> u64 {
        self.num_groups(rows) * self.group_len(rows)
    }

    /// Number of rows of a layer's input. Keys and values of render tokens are projected before views gather theirs.
    pub(crate) fn num_rows(&self, rows: &[Rows]) -> u64 {
        if rows == [Rows::RenderTokens] { self.num_projected() as u64 } else { self.num_gathered(rows) }
    }
}
