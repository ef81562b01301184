//! The trained models of an evaluation, one per rendering method.

use std::sync::Arc;

use clift_model::{Grouping, TrainedModel};
use clift_scene::TokenCodec;

use crate::config::method::Method;

/// The models of both stages, which have one encoder, and networks without clusters.
#[derive(Clone, Debug)]
pub struct EvalModels {
    /// Renders random subsets and cluster centroids, or is a network without clusters.
    pub stage1: TrainedModel,
    /// Condenses and renders K-means clusters.
    pub stage2: Option<TrainedModel>,
    /// Condenses and renders tiles.
    pub stage2_tiles: Option<TrainedModel>,
    /// Codec of the tokens of `stage2`.
    pub codec: Option<Arc<TokenCodec>>,
    /// Networks without clusters, of distinct numbers of tokens: `stage1`, if it is one, or networks beside it.
    pub whole: Vec<TrainedModel>,
}

impl EvalModels {
    /// Starts with the model of stage 1.
    pub fn new(stage1: TrainedModel) -> Self {
        let whole = Some(&stage1).filter(|model| !model.config.architecture.supports_clusters()).cloned();
        Self { stage1, stage2: None, stage2_tiles: None, codec: None, whole: whole.into_iter().collect() }
    }

    /// Sets a model of stage 2, trained on such groups of tokens and on the encoder of stage 1.
    pub fn set_stage2(&mut self, grouping: Grouping, mut model: TrainedModel) {
        model.share_encoder(&self.stage1);
        match grouping {
            Grouping::Kmeans => self.stage2 = Some(model),
            Grouping::Tile => self.stage2_tiles = Some(model),
        }
    }

    /// Returns the model that renders a method, the first of several; `None` without one and for baselines.
    pub fn for_method(&self, method: Method) -> Option<&TrainedModel> {
        let can_cluster = |model: &&TrainedModel| model.config.architecture.supports_clusters();
        match method {
            Method::Random | Method::Tile | Method::Kmeans => Some(&self.stage1).filter(can_cluster),
            Method::Whole(network) => self.whole.iter().find(|model| model.config.architecture == network),
            Method::Clift => self.stage2.as_ref(),
            Method::TileClift => self.stage2_tiles.as_ref(),
            Method::NearestView | Method::MeanImage => None,
        }
    }

    /// Returns the default methods: every method with a model. Uncondensed tiles need condensed tiles beside them.
    pub fn methods(&self) -> Vec<Method> {
        let clustered = [Method::Random, Method::Tile, Method::TileClift, Method::Kmeans, Method::Clift];
        let all = clustered.into_iter().chain(Method::whole());
        let is_wanted = |method: &Method| *method != Method::Tile || self.stage2_tiles.is_some();
        all.filter(|method| self.for_method(*method).is_some()).filter(is_wanted).collect()
    }
}
