//! The interface of every architecture: context views to tokens, tokens to images.

use burn::tensor::Tensor;

use crate::network::render_tokens::RenderTokens;
use crate::network::tokens::Tokens;
use crate::tokens::clusters::ClusterIndex;
use crate::views::upload::{Cameras, Views};

/// A network that encodes context views into tokens and renders target views from tokens.
///
/// Evaluation, encoding and training use networks through this interface, so that they work with every architecture.
pub trait SceneModel {
    /// Returns the encoder's output. Stage 2 freezes the encoder, so that both stages of a run have equal features.
    ///
    /// # Shapes
    /// - returns `[batch, num_tokens, dim]`
    fn features(&self, context: &Views) -> Tokens;

    /// Whether [`normalize`](Self::normalize) changes the features.
    fn has_token_norm(&self) -> bool;

    /// Returns the tokens that this model compresses and renders.
    ///
    /// # Shapes
    /// - `features` and the result: `[batch, num_tokens, dim]`
    fn normalize(&self, features: Tokens) -> Tokens;

    /// Returns the tokens of context views: [`normalize`](Self::normalize) of the [`features`](Self::features).
    ///
    /// # Shapes
    /// - returns `[batch, num_tokens, dim]`
    fn encode(&self, context: &Views) -> Tokens {
        self.normalize(self.features(context))
    }

    /// Writes the tokens of every cluster into one token.
    ///
    /// # Shapes
    /// - `tokens`: `[batch, num_tokens, dim]`
    /// - returns `[batch, num_storage_tokens, dim]`
    fn compress(&self, tokens: Tokens, clusters: &ClusterIndex) -> Tokens;

    /// Renders target views, each the mean of its patch grids.
    ///
    /// # Shapes
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    fn render(&self, tokens: impl Into<RenderTokens>, targets: &Cameras) -> Tensor<5>;

    /// Whether a view can be rendered from a subset of the stored tokens.
    fn supports_selection(&self) -> bool;
}
