//! A config as settings of an evaluation.

use clift_data::derive_seed;
use clift_eval::{Method, Sweep};
use clift_model::{DeviceName, TokenCount};

use crate::config::config::Config;

/// What an evaluation of a run does with every scene, without LPIPS and external methods.
pub(crate) fn sweep(config: &Config, storage: Vec<TokenCount>, methods: Vec<Method>) -> Sweep {
    let Config { seed, eval, clusters, model, device, .. } = config;
    Sweep {
        storage,
        render: eval.render.clone(),
        selection: eval.selection,
        tokens: eval.tokens.clone(),
        methods,
        kmeans: clusters.kmeans.clone(),
        model: model.clone(),
        lpips: None,
        external_methods: Vec::new(),
        is_cpu: matches!(device, DeviceName::Flex | DeviceName::Ndarray),
        seed: derive_seed(*seed, "eval"),
    }
}
