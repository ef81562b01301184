//! Settings of the encoding, and which frames are context views.

use clift_data::ViewSampler;
use clift_model::{Grouping, KMeans, ModelConfig, TokenCount};

/// Settings of [`encode`](crate::encode).
#[derive(Clone, Debug, PartialEq)]
pub struct EncodeOptions {
    /// Context views and their groups.
    pub context: ContextChoice,
    /// One frame of this many is held out: it is not a context view. 0 for none.
    pub hold_out: usize,
    /// Number of stored tokens of all groups; `None` for a quarter (of many groups down to an eighth), or for all tokens of a
    /// network without clusters.
    pub stored_tokens: Option<TokenCount>,
    /// Token groups that the model was trained on.
    pub grouping: Grouping,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Seed of the run.
    pub seed: u64,
    /// Path of the model for the scene file, see [`Scene::model_path_for`](crate::Scene::model_path_for).
    pub model_path: String,
}

impl Default for EncodeOptions {
    /// The options for the default config of a run.
    fn default() -> Self {
        Self {
            context: ContextChoice::Spread(ViewSampler::default().max_context),
            hold_out: 0,
            stored_tokens: None,
            grouping: Grouping::default(),
            kmeans: KMeans::default(),
            seed: 0,
            model_path: String::new(),
        }
    }
}

/// The context views of a scene, and which of them are encoded together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ContextChoice {
    /// These frames, encoded together.
    Frames(Vec<usize>),
    /// A number of frames at equal distances along the camera path, or all frames of a shorter path, encoded together.
    Spread(usize),
    /// A frame and those nearest to it, encoded together.
    Near {
        /// The frame.
        frame: usize,
        /// Number of views with the frame.
        num_views: usize,
    },
    /// All frames, or 128 along a longer path, in groups of neighbours.
    Neighbours {
        /// Views of a group.
        num_views: usize,
        /// Number of groups; few groups leave views out. `None`: of overlapping groups three for every four views, and more if
        /// these leave a view out; fewer if a number of stored tokens is less than 32 a group.
        num_groups: Option<usize>,
        /// Whether a view is rendered from the tokens of all groups ([`ModelConfig::joins_groups`]): the groups then share a
        /// frame and do not overlap.
        joined: bool,
    },
}

impl ContextChoice {
    /// Returns the choice for a captured scene and a network that was trained with up to `num_views` views: groups of
    /// neighbours; of learned tokens, which have no place, views along the path.
    pub fn for_capture(model: &ModelConfig, num_views: usize, num_groups: Option<usize>) -> Self {
        let num_views = if model.group_size > 0 { model.group_size } else { num_views };
        if model.has_patch_tokens() {
            Self::Neighbours { num_views, num_groups, joined: model.joins_groups() }
        } else {
            Self::Spread(num_views)
        }
    }
}
