//! The host batch of one update.
// N tokens, K kept tokens, D width

use clift_data::{Clip, SkippedScene};
use clift_model::{Clusters, Condenser, RenderTokens, SceneClusters, Tokens};

use crate::error::TrainError;

/// Clips of an update, with equal numbers of views, and the tokens from which they are rendered.
#[derive(Clone, Debug)]
pub struct StageBatch {
    /// One clip per slot.
    pub clips: Vec<Clip>,
    /// Tokens of the renderer, per slot.
    pub tokens: TokenSelection,
    /// Scenes that were skipped while the batch was filled.
    pub skipped: Vec<SkippedScene>,
}

/// Tokens that the renderer receives.
#[derive(Clone, Debug, PartialEq)]
pub enum TokenSelection {
    /// Stage 1: a subset of the scene's tokens for every target view, `[slots][views][K]`.
    Subsets(Vec<Vec<Vec<u32>>>),
    /// Stage 1: every token.
    All,
    /// Stage 2: the condensed centroids of every scene.
    Clusters(Vec<SceneClusters>),
}

impl StageBatch {
    /// Splits the batch into `count` micro-batches of nearly equal size: clips and tokens.
    pub(crate) fn parts(&self, count: usize) -> impl Iterator<Item = (&[Clip], TokenSelection)> {
        let batch_size = self.clips.len();
        (0..count).map(move |part| {
            let range = part * batch_size / count..(part + 1) * batch_size / count;
            let tokens = match &self.tokens {
                TokenSelection::Subsets(subsets) => TokenSelection::Subsets(subsets[range.clone()].to_vec()),
                TokenSelection::All => TokenSelection::All,
                TokenSelection::Clusters(clusters) => TokenSelection::Clusters(clusters[range.clone()].to_vec()),
            };
            (&self.clips[range], tokens)
        })
    }
}

impl TokenSelection {
    /// Selects the tokens of the renderer from the encoder's tokens.
    pub(crate) fn apply(&self, condenser: &Condenser, lift: Tokens) -> Result<RenderTokens, TrainError> {
        Ok(match self {
            Self::All => lift.into(),
            Self::Subsets(subsets) => RenderTokens::subsets(lift, subsets),
            Self::Clusters(clusters) => {
                let index = Clusters::new(clusters.clone())?.upload(&lift.values.device());
                condenser.forward(lift, &index).into()
            }
        })
    }
}
