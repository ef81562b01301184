//! The host batch of one update.
// N tokens, K kept tokens, D width

use clift_data::{Clip, SkippedScene};
use clift_model::{Clusters, Network, RenderTokens, SceneClusters, Tokens};

use crate::distributed::parts::BatchParts;
use crate::error::TrainError;

/// Clips of an update, with equal numbers of views, and the tokens from which they are rendered. A rank has those of its
/// slots.
#[derive(Clone, Debug)]
pub struct StageBatch {
    /// Update of the stage, counted from 0.
    pub step: u64,
    /// One clip per slot.
    pub clips: Vec<Clip>,
    /// Tokens of the renderer, per slot.
    pub tokens: BatchTokens,
    /// Scenes that were skipped while a slot was filled, with the slot.
    pub skipped: Vec<(usize, SkippedScene)>,
}

pub(crate) struct MicroBatch<'a> {
    pub clips: &'a [Clip],
    pub tokens: BatchTokens,
    /// Share of the whole batch.
    pub share: f64,
}

/// Tokens that the renderer receives.
#[derive(Clone, Debug, PartialEq)]
pub enum BatchTokens {
    /// Stage 1: a subset of the scene's tokens for every target view, `[slots][views][K]`.
    Subsets(Vec<Vec<Vec<u32>>>),
    /// Stage 1: every token.
    All,
    /// Stage 2: the condensed centroids of every scene.
    Clusters(Vec<SceneClusters>),
}

impl StageBatch {
    /// Returns the part of every round; `None` where this rank has none.
    pub(crate) fn rounds(&self, parts: BatchParts) -> impl Iterator<Item = Option<MicroBatch<'_>>> {
        let mut start = 0;
        (0..parts.num_rounds()).map(move |round| {
            let count = parts.slots_of_round(round).len();
            let range = start..start + count;
            start = range.end;
            let tokens = match &self.tokens {
                BatchTokens::Subsets(subsets) => BatchTokens::Subsets(subsets[range.clone()].to_vec()),
                BatchTokens::All => BatchTokens::All,
                BatchTokens::Clusters(clusters) => BatchTokens::Clusters(clusters[range.clone()].to_vec()),
            };
            let share = count as f64 / parts.batch_size() as f64;
            (count > 0).then(|| MicroBatch { clips: &self.clips[range], tokens, share })
        })
    }
}

impl BatchTokens {
    /// Selects the tokens of the renderer from the encoder's tokens.
    pub(crate) fn select(&self, model: &Network, lift: Tokens) -> Result<RenderTokens, TrainError> {
        Ok(match self {
            Self::All => lift.into(),
            Self::Subsets(subsets) => RenderTokens::subsets(lift, subsets),
            Self::Clusters(clusters) => {
                let index = Clusters::new(clusters.clone())?.upload(&lift.values.device());
                model.compress(lift, &index).into()
            }
        })
    }
}
