//! The forward pass of a model as a list of blocks: from context views to the tokens of the renderer, and from those to
//! images. Applied in order they are the plain pass; activation checkpointing applies them one by one.

use burn::tensor::Tensor;

use crate::network::camera_encoding::TokenTransforms;
use crate::network::model::Network;
use crate::network::render_tokens::{KeyValueCache, RenderTokens};
use crate::network::tokens::Tokens;
use crate::views::upload::{Cameras, Views};

/// Compresses or selects the tokens of the renderer from the encoder's tokens.
pub type TokenStep<'a, E> = &'a dyn Fn(&Network, Tokens) -> Result<RenderTokens, E>;

/// The forward pass of a batch of scenes.
pub struct Pass<'a, E> {
    model: &'a Network,
    context: &'a Views,
    targets: &'a Cameras,
    token_step: TokenStep<'a, E>,
    context_transforms: Option<TokenTransforms>,
    target_transforms: Option<TokenTransforms>,
}

/// The values between two blocks, on which the blocks after them depend.
#[derive(Clone, Debug, Default)]
pub struct PassState {
    /// Residual stream of the encoder or the renderer, `[.., rows, dim]`; `None` before the embedding of either.
    pub x: Option<Tensor<3>>,
    /// Tokens of the renderer; `None` before they are selected.
    pub tokens: Option<RenderTokens>,
}

impl<'a, E> Pass<'a, E> {
    /// Describes the pass of `model` from `context` to images of `targets`.
    pub fn new(model: &'a Network, context: &'a Views, targets: &'a Cameras, token_step: TokenStep<'a, E>) -> Self {
        let context_transforms = model.encoder.blocks().transforms(&context.cameras);
        let target_transforms = model.renderer.blocks().transforms(targets);
        Self { model, context, targets, token_step, context_transforms, target_transforms }
    }

    /// Returns the number of blocks of the encoder, its embedding included.
    pub fn num_encoder_blocks(&self) -> usize {
        1 + self.model.encoder.blocks().num_blocks()
    }

    /// Returns the number of blocks: encoder blocks, the selection of tokens, the embedding of the target rays, and the
    /// blocks of the renderer.
    pub fn num_blocks(&self) -> usize {
        self.num_encoder_blocks() + 2 + self.model.renderer.blocks().num_blocks()
    }

    /// Applies a block to the values after the block before it; the first one takes the default.
    ///
    /// # Errors
    /// Those of the token step.
    ///
    /// # Panics
    /// For the values of another block.
    pub fn block(&self, index: usize, state: PassState) -> Result<PassState, E> {
        let Self { model, context, targets, .. } = self;
        let PassState { x, tokens } = state;
        let take_x = || x.expect("the block before this one returns a residual stream");
        let select_at = self.num_encoder_blocks();
        if index == 0 {
            return Ok(PassState { x: Some(model.encoder.blocks().embed(context)), tokens });
        }
        if index < select_at {
            let x = model.encoder.blocks().block(index - 1, take_x(), self.context_transforms.as_ref());
            return Ok(PassState { x: Some(x), tokens });
        }
        if index == select_at {
            let features = Tokens { values: take_x(), transforms: self.context_transforms.clone() };
            let features = features.joined(context.cameras.dims()[0]);
            let tokens = (self.token_step)(model, model.normalize(features))?;
            return Ok(PassState { x: None, tokens: Some(model.renderer.accept(tokens)) });
        }
        let tokens = tokens.expect("tokens were selected");
        let (blocks, cache) = (model.renderer.blocks(), KeyValueCache::Tokens(tokens.clone()));
        let x = if index == select_at + 1 {
            blocks.embed(&cache, targets)
        } else {
            blocks.block(index - select_at - 2, take_x(), &cache, self.target_transforms.as_ref())
        };
        Ok(PassState { x: Some(x), tokens: Some(tokens) })
    }

    /// Decodes the values after the last block into RGB in `(0, 1)`, `[batch, views, height, width, 3]`.
    ///
    /// # Panics
    /// For the values of another block.
    pub fn to_image(&self, state: PassState) -> Tensor<5> {
        self.model.renderer.blocks().to_image(state.x.expect("the values after the last block"), self.targets)
    }

    /// Applies all blocks and returns the values after the last one.
    ///
    /// # Errors
    /// Those of the token step.
    pub fn forward(&self) -> Result<PassState, E> {
        (0..self.num_blocks()).try_fold(PassState::default(), |state, index| self.block(index, state))
    }
}
